"""``stereophd track``, ``watch`` (of a live run) and ``compile`` (its kernels)."""

from pathlib import Path
from typing import Annotated

import typer

from stereophd.cli.batch import are_many, finish_batch, say_what_is_kept
from stereophd.cli.options import ConfigWords, Session, Strict, argument
from stereophd.cli.options import option as shared_option
from stereophd.cli.terminal import exit_if_strict, load, print_report, progress_bar
from stereophd.cli.unused_options import refuse, report, report_jobs_beside_dask
from stereophd.commands.options import LiveOptions, TrackOptions
from stereophd.errors import InputError

Logs = Annotated[
    list[Path] | None,
    argument(
        "LOG...",
        "Detection logs (Parquet), or patterns such as 'day1/*.parquet'; - : frames from standard input, live.",
    ),
]
Out = Annotated[
    Path | None, shared_option("--out", "DIR", "Output folder; created if missing. A live run may do without.")
]
Smooth = Annotated[bool, typer.Option("--smooth", help="Smooth every track over the whole log (report.smooth).")]
Associations = Annotated[
    bool, typer.Option("--associations", help="Write which detection belongs to which track (report.associations).")
]
Address = Annotated[str, argument("ADDRESS", "Where `track --publish` sends, such as tcp://127.0.0.1:5556.")]
Host = Annotated[str, typer.Option("--host", metavar="HOST", help="Whose browsers may open the page.")]
Port = Annotated[int, typer.Option("--port", metavar="N", min=0, max=65535, help="Port of the page; 0: any.")]
Jobs = Annotated[int, typer.Option("--jobs", metavar="N", min=1, help="Processes; the results do not depend on it.")]


def track_command(
    session: Session,
    words: ConfigWords,
    options: TrackOptions,
    live: LiveOptions,
    log: Logs = None,
    out: Out = None,
    smooth: Smooth = False,
    associations: Associations = False,
    strict: Strict = False,
) -> None:
    """Estimate 3-D tracks from detection logs: tracks.parquet, scans.parquet and report.json.

    With several logs, each has a folder in DIR, and DIR/summary.parquet has a row for each. With - as LOG, --follow or
    --listen the recording is still running: a line of JSON for each event on standard output, the files at its end.
    """
    if live.follow is not None or live.listen is not None or log == [Path("-")]:
        from stereophd.cli.track_live import run_live

        run_live(session, load(words), live, log or [], out, options)
        return
    if not log:
        raise InputError("LOG: expected a detection log, found none (- reads frames from standard input)")
    if out is None:
        raise InputError("--out: expected a folder, found none (see 'stereophd track --help')")
    refuse(
        session,
        ("record", "publish", "arrow", "mcap"),
        "with -, --follow or --listen, found a recording that has ended",
    )
    if options.overlap_s is not None and options.pieces_s is None:
        raise InputError("--overlap: expected --pieces SECONDS too, found none")
    from stereophd.commands.track import track, with_reports

    loaded = with_reports(load(words), smooth, associations or options.plots)
    many = are_many(log)
    if options.dask is not None and not many and options.pieces_s is None:
        raise InputError(
            "--dask: expected several logs, or one in pieces (--pieces SECONDS), found one log in one piece"
        )
    report_jobs_beside_dask(session, options.dask)
    if options.jobs > 1 and not many and options.pieces_s is None:
        report(session, ("jobs",), "with several logs, or with one in pieces (--pieces SECONDS)")
    if options.threads > 1 and loaded.config.filter is not None and loaded.config.filter.kind == "single":
        report(session, ("threads",), "with filters of several objects; filter.kind is single")
    try:
        with progress_bar(session, "track") as progress:
            if many:
                from stereophd.commands.batches import track_logs

                done = track_logs(loaded, log, out, options=options, progress=progress)
            else:
                from stereophd.pipeline.batch.names import expand

                done = track(loaded, expand(log)[0], out, options=options, progress=progress)
    except (KeyboardInterrupt, SystemExit):
        say_what_is_kept(out)
        raise
    if many:
        finish_batch(session, done, strict)
    else:
        from stereophd.report.summaries import summary_text

        print_report(session, done, lambda: summary_text(done))
        exit_if_strict(strict, done)


def watch_command(session: Session, address: Address, host: Host = "127.0.0.1", port: Port = 0) -> None:
    """Show a live run in a browser: cameras, tracks with tails, residuals, delay, frames that were too late.

    The address of the page is printed. It holds a token: nobody else can open the page. Ctrl-C ends it.
    """
    from stereophd.commands.watch import Watch

    watch = Watch(address, host, port)
    typer.echo(watch.url)
    try:
        watch.run()
    finally:
        watch.close()


def compile_command(session: Session, jobs: Jobs = 1) -> None:
    """Compile the kernels of `track` and keep them: for images of containers and the cache of a CI job."""
    from stereophd.commands.compile import compile_kernels

    report = compile_kernels(jobs)
    print_report(session, report, lambda: f"kernels of {', '.join(report['filters'])}: kept in {report['folder']}")
