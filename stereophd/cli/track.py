"""``stereophd track``."""

from __future__ import annotations

from typing import Annotated

import typer

from stereophd.cli import options
from stereophd.cli.batch import are_many, finish_batch, say_what_is_kept
from stereophd.cli.terminal import begin, exit_if_strict, load, print_run, progress_bar
from stereophd.errors import InputError


def track_command(
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
            min=1,
            help="Processes for several logs, or for the pieces of one; the results do not depend on it.",
        ),
    ] = 1,
    dask: options.Dask = None,
    threads: Annotated[
        int, typer.Option("--threads", metavar="N", min=1, help="Threads; the outputs do not depend on it.")
    ] = 1,
    pieces: Annotated[
        float | None,
        options.option(
            "--pieces",
            "S",
            "Cut the log into pieces of S seconds, track them independently, and join their tracks. The last piece is "
            "shorter, or longer by up to the overlap.",
        ),
    ] = None,
    overlap: Annotated[
        float | None,
        options.option("--overlap", "S", "Seconds before its own span that each piece also tracks [60]."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run; keep what is finished.")
    ] = False,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Smooth every track over the whole log (report.smooth).")
    ] = False,
    associations: Annotated[
        bool, typer.Option("--associations", help="Write which detection belongs to which track (report.associations).")
    ] = False,
    plots: Annotated[
        bool,
        typer.Option("--plots", help="Draw views, timelines, residuals (needs the extra 'plot'; adds --associations)."),
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
    """Estimate 3-D tracks from detection logs: tracks.parquet, scans.parquet and report.json.

    With several logs, each has a folder in DIR, and DIR/summary.parquet has a row for each.
    """
    session = begin(context)
    if overlap is not None and pieces is None:
        raise InputError("--overlap: expected --pieces S too, found none")
    loaded = load(config, overrides, seed, cameras)
    wanted = ["report.smooth={}"] if smooth and loaded.config.report.smooth is None else []
    wanted += ["report.associations=true"] if associations or plots else []
    if wanted:
        loaded = load(config, [*(overrides or []), *wanted], seed, cameras)
    many = are_many(log)
    if dask is not None and not many and pieces is None:
        raise InputError("--dask: expected several logs, or --pieces S for one, found one log without")
    try:
        with progress_bar(session, "track") as progress:
            if many:
                from stereophd.commands.track_logs import track_logs

                report = track_logs(
                    loaded, log, out, force, threads, progress, resume, jobs, dask, pieces, overlap, plots
                )
            else:
                from stereophd.commands.track import track
                from stereophd.pipeline.batch.names import expand

                path = expand(log)[0]
                report = track(loaded, path, out, force, threads, progress, resume, pieces, overlap, jobs, dask, plots)
    except (KeyboardInterrupt, SystemExit):
        say_what_is_kept(out)
        raise
    if many:
        finish_batch(session, report, strict)
    else:
        print_run(session, report)
        exit_if_strict(strict, report)
