"""``stereophd evaluate``: tracks against the truth; ``stereophd evaluate-cameras``: cameras against true ones."""

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli.batch import finish_batch
from stereophd.cli.options import ConfigWords, Seed, Session, option
from stereophd.cli.terminal import load, print_scored, progress_bar
from stereophd.cli.unused_options import refuse, report, report_jobs_beside_dask
from stereophd.commands.options import FOLDERS, EvaluateCamerasOptions, EvaluateOptions
from stereophd.errors import InputError
from stereophd.options import names_of_use

Tracks = Annotated[Path, typer.Argument(metavar="TRACKS", help="tracks.parquet, or a folder of runs.")]
Truth = Annotated[Path, typer.Argument(metavar="TRUTH", help="truth.parquet (or CSV), or a folder of truths.")]
ScoresOut = Annotated[Path | None, option("--out", "DIR", "Folder of report.json, per_scan.parquet and plots.")]
Estimated = Annotated[Path, typer.Argument(metavar="EST", help="Estimated cameras (YAML).")]
TrueCameras = Annotated[Path, typer.Argument(metavar="TRUE", help="True cameras (YAML).")]
ErrorsOut = Annotated[Path | None, option("--out", "DIR", "Folder of report.json.")]
Scenario = Annotated[
    Path | None, option("--config", "CONFIG", "Simulated scenario and priors whose Cramer-Rao bound is reported.")
]


def evaluate_command(
    session: Session, tracks: Tracks, truth: Truth, options: EvaluateOptions, out: ScoresOut = None, seed: Seed = None
) -> None:
    """Score tracks against the truth (OSPA, RMSE, identities, NEES).

    With folders of runs as TRACKS and TRUTH, each NAME/tracks.parquet is scored against NAME/truth.parquet or
    NAME.parquet, and DIR/summary.parquet has a row for each. A truth without tracks is a warning; with limits it fails
    (exit code 2).
    """
    report(session, ("seed",), "for the scores of cameras (evaluate-cameras), with --config CONFIG")
    _report_without_out(session, out)
    if options.log_path is None and (out is None or options.plots is False):
        refuse(
            session, ("cameras_path",), "with --log, whose clocks they have, or with plots (--out DIR), found neither"
        )
    if options.plots and out is None:
        raise InputError("--plots: expected --out DIR to put the plots in, found none")
    if tracks.is_dir():
        report_jobs_beside_dask(session, options.dask)
        _score_runs(session, tracks, truth, out, options)
        return
    refuse(session, names_of_use(EvaluateOptions, FOLDERS), f"for {FOLDERS}, found one run")
    from stereophd.commands.evaluate import evaluate
    from stereophd.report.scores import scores_text

    print_scored(session, lambda: evaluate(tracks, truth, out, options=options), scores_text)


def evaluate_cameras_command(
    session: Session,
    estimated: Estimated,
    true: TrueCameras,
    options: EvaluateCamerasOptions,
    out: ErrorsOut = None,
    config: Scenario = None,
    seed: Seed = None,
) -> None:
    """Score calibrated cameras against true ones: errors, the posterior beside EST, Cramer-Rao bounds."""
    if config is None:
        report(session, ("seed",), "with --config CONFIG")
    _report_without_out(session, out)
    from stereophd.commands.evaluate_cameras import evaluate_calibration
    from stereophd.report.camera_scores import camera_scores_text

    loaded = None if config is None else load(ConfigWords(config, None, seed, true))
    print_scored(
        session, lambda: evaluate_calibration(estimated, true, out, loaded, options=options), camera_scores_text
    )


def _score_runs(session: Session, tracks: Path, truth: Path, out: Path | None, options: EvaluateOptions) -> None:
    if out is None:
        raise InputError("expected --out DIR for the scores of a folder of runs, found none")
    from stereophd.commands.batches import evaluate_runs

    with progress_bar(session, "evaluate") as progress:
        summary = evaluate_runs(tracks, truth, out, options=options, progress=progress)
    finish_batch(session, summary)


def _report_without_out(session: Session, out: Path | None) -> None:
    """Warn of what concerns files where none is written."""
    if out is None:
        report(session, ("force",), "with --out DIR")
