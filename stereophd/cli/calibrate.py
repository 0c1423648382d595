"""``stereophd calibrate``."""

from typing import Any

from stereophd.cli.batch import are_many, finish_batch
from stereophd.cli.options import ConfigWords, Logs, Out, Session, Strict
from stereophd.cli.terminal import exit_if_strict, load, print_scored, progress_bar
from stereophd.cli.unused_options import report_jobs_beside_dask
from stereophd.commands.options import CalibrateOptions
from stereophd.errors import InputError


def calibrate_command(
    session: Session, words: ConfigWords, log: Logs, out: Out, options: CalibrateOptions, strict: Strict = False
) -> None:
    """Estimate cameras (poses, and lenses and clocks if they have priors) from a detection log of moving objects.

    Writes cameras.yaml, posterior.parquet, history.parquet, report.json, and the tracks made with these cameras.

    With several logs, each is calibrated separately and has a folder in DIR; DIR/summary.parquet has a row for each.
    """
    loaded = load(words)
    if are_many(log):
        from stereophd.commands.batches import calibrate_logs

        report_jobs_beside_dask(session, options.dask)
        with progress_bar(session, "calibrate") as progress:
            summary = calibrate_logs(loaded, log, out, options=options, progress=progress)
        finish_batch(session, summary, strict)
        return
    if options.dask is not None:
        raise InputError("--dask: expected several logs, found one; its starts run on the processes of --jobs")
    from stereophd.commands.calibrate import calibrate
    from stereophd.pipeline.batch.names import expand
    from stereophd.report.summaries import summary_text

    def run() -> dict[str, Any]:
        with progress_bar(session, "calibrate") as progress:
            return calibrate(loaded, expand(log)[0], out, options=options, progress=progress)

    exit_if_strict(strict, print_scored(session, run, summary_text))
