"""``stereophd experiment``."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import begin, load, print_data, progress_bar, quiet_pipe, to_json
from stereophd.cli.unused_options import report_jobs_beside_dask

# Characters of a line of the table where no terminal limits it.
PIPED_WIDTH = 180


def experiment_command(
    context: typer.Context,
    config: options.Config,
    out: options.Out,
    jobs: options.Jobs = 1,
    dask: options.Dask = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted experiment.")] = False,
    overrides: options.Set = None,
    seed: options.Seed = None,
    force: options.Force = False,
    force_size: options.ForceSize = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Run a scenario many times with several methods: runs.parquet, summary.parquet and a figure."""
    session = begin(context)
    report_jobs_beside_dask(context, dask)
    loaded = load(config, overrides, seed, None)
    from stereophd.commands.experiment import experiment, finished_runs

    try:
        with progress_bar(session, "experiment") as progress:
            results = experiment(loaded, out, jobs, dask, resume, force, progress, force_size)
    except (KeyboardInterrupt, SystemExit):
        count = finished_runs(loaded, out)
        if count:
            print(f"finished runs are kept in {out} ({count}); --resume runs the others", file=sys.stderr)
        raise
    from stereophd.cli.experiment_table import print_results
    from stereophd.experiments.engine.results import report_of

    if session.json:
        print_data(to_json(report_of(results)))
    elif not session.quiet:
        from rich.console import Console

        with quiet_pipe():
            print_results(results, Console(width=None if sys.stdout.isatty() else PIPED_WIDTH))
