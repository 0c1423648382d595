"""``stereophd track`` of a recording that is still running."""

import sys
from pathlib import Path

import typer

from stereophd.cli.options import Session
from stereophd.cli.terminal import quiet_pipe
from stereophd.cli.unused_options import refuse
from stereophd.commands.options import LiveOptions, TrackOptions
from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError
from stereophd.io.streams.sources import Arrivals

WHOLE_LOGS = ("jobs", "dask", "threads", "pieces_s", "overlap_s", "plots")


def run_live(
    session: Session, loaded: LoadedConfig, live: LiveOptions, log: list[Path], out: Path | None, options: TrackOptions
) -> None:
    """Track frames as they arrive; lines on standard output, a summary on standard error."""
    from stereophd.commands.track_live import LiveOutputs, track_live
    from stereophd.io.streams.mcap import McapRows
    from stereophd.io.streams.rows import ArrowRows, JsonLines, Publisher, RowSink

    refuse(session, WHOLE_LOGS, "for a recording that has ended, found one that is still running")
    if live.follow is not None:
        refuse(session, ("resume",), "with - or --listen, found a log that is followed: it holds all frames still")
    if options.resume and out is None and live.record is None:
        raise InputError("--resume: expected --out or --record too, which say where the frames were recorded")
    arrivals, source = _source(log, live)
    events = None if session.quiet else sys.stderr
    lines = sys.stdout.buffer
    rows: list[RowSink] = [ArrowRows(lines, events) if live.arrow else JsonLines(lines, events)]
    if live.publish is not None:
        rows.append(Publisher(live.publish))
    mcap = None if live.mcap is None else McapRows(live.mcap)
    rows += [] if mcap is None else [mcap]
    outputs = LiveOutputs(rows, out, live.record, options.force, options.resume)
    try:
        with quiet_pipe():
            done = track_live(loaded, arrivals, source, outputs)
    finally:
        if mcap is not None:
            mcap.close()
    if session.quiet:
        return
    if not done["frames"]["frames"]:
        typer.echo("no frame was used", err=True)
        return
    latency, processor = done["latency_ms"], done["processor_ms"]
    typer.echo(
        f"{done['frames']['frames']} frames, {done['late_frames']} of them late ({done['revised_events']} events "
        f"revised), {done['frames']['too_late']} too late; from frame to row {latency['p50']:.1f} ms in the median, "
        f"{latency['p99.9']:.1f} ms for 99.9 % (CPU time {processor['p50']:.1f} and {processor['p99.9']:.1f} ms)",
        err=True,
    )


def _source(log: list[Path], live: LiveOptions) -> tuple[Arrivals, str]:
    """Return the one source that is stated."""
    from stereophd.io.streams.sources import follow, from_stream, listen

    choices = {"LOG": log, "--follow": live.follow, "--listen": live.listen}
    stated = [name for name, value in choices.items() if value]
    if len(stated) != 1 or (log and log != [Path("-")]):
        raise InputError(f"expected one of -, --follow and --listen, found {' and '.join(stated)}")
    if live.follow is not None:
        return follow(live.follow), str(live.follow)
    if live.listen is not None:
        return listen(live.listen), live.listen
    return from_stream(sys.stdin.buffer), "standard input"
