"""``stereophd track``."""

from __future__ import annotations

import typer

from stereophd.cli import options
from stereophd.cli import track_options as of
from stereophd.cli.batch import are_many, finish_batch, say_what_is_kept
from stereophd.cli.terminal import begin, exit_if_strict, load, print_run, progress_bar
from stereophd.cli.unused_options import report, report_jobs_beside_dask
from stereophd.errors import InputError


def track_command(
    context: typer.Context,
    config: options.Config,
    log: options.Logs,
    out: options.Out,
    cameras: options.Cameras = None,
    jobs: of.Jobs = 1,
    dask: options.Dask = None,
    threads: of.Threads = 1,
    pieces: of.Pieces = None,
    overlap: of.Overlap = None,
    resume: of.Resume = False,
    smooth: of.Smooth = False,
    associations: of.Associations = False,
    plots: of.Plots = False,
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
    report_jobs_beside_dask(context, dask)
    if jobs > 1 and not many and pieces is None:
        report(context, ("jobs",), "with several logs, or with --pieces S for one")
    if threads > 1 and loaded.config.filter is not None and loaded.config.filter.kind == "single":
        report(context, ("threads",), "with filters of several objects; filter.kind is single")
    try:
        with progress_bar(session, "track") as progress:
            if many:
                from stereophd.commands.track_logs import track_logs

                found = track_logs(
                    loaded, log, out, force, threads, progress, resume, jobs, dask, pieces, overlap, plots
                )
            else:
                from stereophd.commands.track import track
                from stereophd.pipeline.batch.names import expand

                path = expand(log)[0]
                found = track(loaded, path, out, force, threads, progress, resume, pieces, overlap, jobs, dask, plots)
    except (KeyboardInterrupt, SystemExit):
        say_what_is_kept(out)
        raise
    if many:
        finish_batch(session, found, strict)
    else:
        print_run(session, found)
        exit_if_strict(strict, found)
