"""Recorded frames, lines of JSON in the order of their arrival, as a detection log in the order of their times."""

import heapq
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

from stereophd.config.loading import LoadedConfig
from stereophd.io.logs.rows import OPTIONAL, LogWriter
from stereophd.io.outputs.provenance import provenance, to_metadata
from stereophd.io.streams.messages import Message, parse_line


def write_log(loaded: LoadedConfig, recording: Path, log: Path) -> None:
    """Write recorded frames (lines of JSON) as a detection log, in order of time.

    A frame that is more than ``live.span_s`` older than one before it was too late for the run, and is left out. Raises
    InputError if a line is no frame; a last line that a killed run left incomplete is passed over.
    """
    present = {name for message in read_recording(recording) for name in message.columns}
    columns = [name for name in OPTIONAL if name in present]
    with LogWriter(log, to_metadata(provenance("track", loaded.record)), columns) as table:
        for message in _in_order(loaded, read_recording(recording)):
            table.write(message.time_s, message.camera, message.frame, message.pixels, message.columns)


def read_recording(recording: Path) -> Iterator[Message]:
    """Yield recorded frames, as far as their lines are complete."""
    with open(recording, encoding="utf-8") as stream:
        for number, line in enumerate(stream, start=1):
            if line.endswith("\n"):
                yield parse_line(line, f"{recording}: line {number}")


def _in_order(loaded: LoadedConfig, messages: Iterable[Message]) -> Iterator[Message]:
    """Yield messages in order of true time, then of the cameras; memory holds those of ``live.span_s``."""
    span_s = loaded.config.live.span_s
    cameras = {camera.name: (index, camera.clock) for index, camera in enumerate(loaded.build_cameras())}
    waiting: list[tuple[float, int, int, int, Message]] = []
    written: tuple[float, int, int] = (-math.inf, 0, 0)
    newest = -math.inf
    for number, message in enumerate(messages):
        index, clock = cameras[message.camera]
        key = (clock.to_true(message.time_s), index, message.frame)
        if key < written:
            continue
        newest = max(newest, key[0])
        heapq.heappush(waiting, (*key, number, message))
        while waiting and waiting[0][0] < newest - span_s:
            time_s, camera, frame, _, oldest = heapq.heappop(waiting)
            written = (time_s, camera, frame)
            yield oldest
    yield from (entry[-1] for entry in sorted(waiting, key=lambda entry: entry[:4]))
