"""``stereophd track``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.terminal import begin, exit_if_strict, load, print_report, progress_bar


def track_command(
    context: typer.Context,
    config: options.Config,
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Detection log (Parquet).", show_default=False)],
    out: options.Out,
    cameras: options.Cameras = None,
    threads: Annotated[
        int,
        typer.Option("--threads", metavar="N", min=1, help="Threads; the outputs do not depend on it."),
    ] = 1,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Smooth every track over the whole log (report.smooth).")
    ] = False,
    associations: Annotated[
        bool,
        typer.Option("--associations", help="Write which detection belongs to which track: associations.parquet."),
    ] = False,
    strict: options.Strict = False,
    overrides: options.Set = None,
    seed: options.Seed = None,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = 0,
    debug: options.Debug = False,
) -> None:
    """Turn a detection log into 3-D tracks: tracks.parquet, scans.parquet and report.json."""
    session = begin(context)
    loaded = load(config, overrides, seed, cameras)
    if smooth and loaded.config.report.smooth is None:
        loaded = load(config, [*(overrides or []), "report.smooth={}"], seed, cameras)
    from stereophd.commands.track import track

    with progress_bar(session, "track") as progress:
        report = track(loaded, log, out, force=force, threads=threads, progress=progress, associations=associations)
    print_report(session, report)
    exit_if_strict(strict, report)
