"""``stereophd experiment``."""

import sys

from stereophd.cli.options import Out, SceneWords, Session
from stereophd.cli.terminal import load, print_report, progress_bar
from stereophd.cli.unused_options import report_jobs_beside_dask
from stereophd.commands.options import ExperimentOptions


def experiment_command(session: Session, words: SceneWords, out: Out, options: ExperimentOptions) -> None:
    """Run a scenario many times with several methods: runs.parquet, summary.parquet and a figure."""
    report_jobs_beside_dask(session, options.dask)
    loaded = load(words)
    from stereophd.commands.experiment import experiment, finished_runs

    try:
        with progress_bar(session, "experiment") as progress:
            results = experiment(loaded, out, options=options, progress=progress)
    except (KeyboardInterrupt, SystemExit):
        count = finished_runs(loaded, out)
        if count:
            print(f"finished runs are kept in {out} ({count}); --resume runs the others", file=sys.stderr)
        raise
    from stereophd.experiments.engine.results import report_of
    from stereophd.report.experiment_table import results_text

    print_report(session, report_of(results), lambda: results_text(results))
