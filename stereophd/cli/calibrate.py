"""``stereophd calibrate``."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

import typer

from stereophd.cli import options
from stereophd.cli.batch import are_many, finish_batch
from stereophd.cli.terminal import begin, exit_if_strict, load, print_run, progress_bar
from stereophd.cli.unused_options import report_jobs_beside_dask
from stereophd.errors import GateError, InputError


class Require(StrEnum):
    """How much of the cameras the data must determine."""

    DETERMINED = "determined"
    PARTLY = "partly"


def calibrate_command(
    context: typer.Context,
    config: options.Config,
    log: options.Logs,
    out: options.Out,
    cameras: options.Cameras = None,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs",
            metavar="N",
            help="Processes; the results do not depend on it. The default is all cores (-1), because a calibration may "
            "take minutes.",
            show_default=False,
        ),
    ] = -1,
    dask: options.Dask = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run from what it has kept (DIR/partial-HASH).")
    ] = False,
    plots: options.Plots = None,
    require: Annotated[
        Require | None,
        typer.Option(
            "--require", help="Exit with 1 if the data determine the cameras less than this.", show_default=False
        ),
    ] = None,
    strict: options.Strict = False,
    overrides: options.Set = None,
    seed: options.Seed = None,
    force: options.Force = False,
    force_size: options.ForceSize = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Estimate cameras (poses, and lenses and clocks if they have priors) from a detection log of moving objects.

    Writes cameras.yaml, posterior.parquet, history.parquet, report.json, and the tracks made with these cameras.

    With several logs, each is calibrated separately and has a folder in DIR; DIR/summary.parquet has a row for each.
    """
    session = begin(context)
    loaded = load(config, overrides, seed, cameras)
    least: Literal["determined", "partly"] | None = None if require is None else require.value
    if are_many(log):
        from stereophd.commands.calibrate_logs import calibrate_logs

        report_jobs_beside_dask(context, dask)
        with progress_bar(session, "calibrate") as progress:
            found = calibrate_logs(
                loaded, log, out, force, jobs, resume, progress, dask, plots=plots, require=least,
                force_size=force_size,
            )  # fmt: skip
        finish_batch(session, found, strict)
        return
    if dask is not None:
        raise InputError("--dask: expected several logs, found one; its starts run on the processes of --jobs")
    from stereophd.commands.calibrate import calibrate
    from stereophd.pipeline.batch.names import expand

    try:
        with progress_bar(session, "calibrate") as progress:
            report = calibrate(
                loaded, expand(log)[0], out, force=force, jobs=jobs, resume=resume, plots=plots, progress=progress,
                require=least, force_size=force_size,
            )  # fmt: skip
    except GateError as error:
        if error.report is not None:
            print_run(session, error.report)
        raise
    print_run(session, report)
    exit_if_strict(strict, report)
