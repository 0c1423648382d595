"""One message is one frame of one camera, as a line of JSON or as rows of a log that belong together.

::

    {"camera": "left", "frame": 7, "time_s": 0.28, "detections": [[612.5, 301.2], [88.0, 240.9]]}

A frame without detections has an empty list. ``"columns"`` names further values of each detection, such as
``["sigma_u_px", "sigma_v_px"]``: they follow u and v in every row. Keys that are not named here are ignored.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from time import perf_counter

import msgspec
import numpy as np
import pyarrow as pa

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.streams.documents import FURTHER, FrameDocument

_decode = msgspec.json.Decoder(FrameDocument).decode


@dataclass(frozen=True)
class Message:
    """One frame as it arrives, not yet checked against the cameras."""

    camera: str
    frame: int
    time_s: float  # On the camera's own clock
    pixels: Array  # (m, 2), distorted px
    columns: Mapping[str, Array] = field(default_factory=dict)  # Further values (m,), by column of the log
    arrived_s: float = field(default_factory=perf_counter, compare=False)  # When it came, on the clock of the process

    def to_line(self) -> str:
        """Return the line of JSON, without its end; numbers have all their digits."""
        names = list(self.columns)
        rows = np.column_stack([self.pixels, *(self.columns[name] for name in names)])
        document = {"camera": self.camera, "frame": self.frame, "time_s": self.time_s, "detections": rows.tolist()}
        return msgspec.json.encode(document | ({"columns": names} if names else {})).decode()


def parse_line(line: bytes | str, where: str, arrived_s: float | None = None) -> Message:
    """Return the frame of a line of JSON that arrived at `arrived_s` (`time.perf_counter`; default now).

    `where` is the source and the number of the line, for messages. Raises InputError when the line is no frame; the
    message names the key, what was expected and what was found.
    """
    arrived_s = perf_counter() if arrived_s is None else arrived_s
    try:
        frame = _decoded(line)
    except msgspec.ValidationError as error:
        what, _, place = str(error).replace(", got", ", found").partition(" - at `$")
        if place or "missing" in what:
            key = f"{place.strip('.`')}: " if place else ""
            raise InputError(f"{where}: {key}{what[0].lower()}{what[1:].replace('`', '')}") from error
        raise InputError(f"{where}: expected a frame as one line of JSON, found {_shown(line)}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: expected a frame as one line of JSON, found {_shown(line)}") from error
    rows, names = frame.detections, frame.columns
    width = 2 + len(names)
    try:
        values = np.array(rows, dtype=np.float64).reshape(-1, width) if rows else np.empty((0, width))
        if len(values) != len(rows):
            raise ValueError("rows of another length")
    except ValueError as error:
        raise InputError(
            f"{where}: detections: expected rows of {width} numbers (u_px, v_px{''.join(f', {n}' for n in names)}), "
            f"found {_shown(rows)}"
        ) from error
    further = {name: values[:, 2 + k] for k, name in enumerate(names) if name in FURTHER}
    # kernels have a form for each layout
    return Message(frame.camera, frame.frame, frame.time_s, np.ascontiguousarray(values[:, :2]), further, arrived_s)


def _decoded(line: bytes | str) -> FrameDocument:
    try:
        return _decode(line)
    except msgspec.ValidationError:
        raise
    except msgspec.DecodeError:  # NaN is no JSON, and Python writes it
        return msgspec.convert(json.loads(line), FrameDocument)


def _shown(value: object) -> str:
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


def messages_of_rows(batch: pa.RecordBatch, where: str) -> Iterator[Message]:
    """Yield the frames of rows of a log; rows of one (camera, frame) that follow each other are one frame.

    Raises InputError when a required column is missing or null, or a column is of another type.
    """
    missing = [name for name in ("time_s", "camera", "frame", "u_px", "v_px") if name not in batch.schema.names]
    if missing:
        raise InputError(f"{where}: expected the columns of a detection log, found none named {', '.join(missing)}")
    try:
        camera = np.asarray(batch.column("camera").to_pylist(), dtype=object)
        numbers = {
            name: np.array(batch.column(name).to_pylist(), dtype=np.float64)
            for name in ("time_s", "frame", "u_px", "v_px", *FURTHER)
            if name in batch.schema.names
        }
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: expected the columns of a detection log, found: {error}") from error
    if any(name is None for name in camera) or not np.isfinite(numbers["frame"]).all():
        raise InputError(f"{where}: expected a camera and a frame in every row, found a row without")
    new = np.ones(len(camera), dtype=bool)
    new[1:] = (camera[1:] != camera[:-1]) | (numbers["frame"][1:] != numbers["frame"][:-1])
    starts = np.flatnonzero(new).tolist()
    for i, j in zip(starts, [*starts[1:], len(camera)], strict=True):
        pixels = np.stack([numbers["u_px"][i:j], numbers["v_px"][i:j]], axis=1)
        seen = ~np.isnan(pixels).all(axis=1)
        further = {name: numbers[name][i:j][seen] for name in FURTHER if name in numbers}
        yield Message(str(camera[i]), int(numbers["frame"][i]), float(numbers["time_s"][i]), pixels[seen], further)
