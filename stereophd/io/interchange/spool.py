"""Rows of each camera in a temporary file of its own, so that a log larger than memory can be put in order."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import EXTRA_COLUMNS, ForeignRecording, Piece

FRAME, TIME, U, V = range(4)
WIDTH = 4 + len(EXTRA_COLUMNS)
# Rows of a piece of a temporary file.
PIECE_ROWS = 65536
# Largest number of a frame, or of an object: beyond it not every whole number is a float.
MAX_FRAME = 2.0**53


@dataclass
class Spool:
    """The rows of one camera in a temporary file: frame, time, u, v and extra columns, all float64."""

    path: Path
    stream: BinaryIO
    rows: int = 0
    last: float = -math.inf
    in_order: bool = True
    has_frames: bool = True

    def discard(self) -> None:
        """Close the file and remove it."""
        self.stream.close()
        self.path.unlink(missing_ok=True)


def extra_columns(spools: Mapping[str, Spool]) -> list[str]:
    """Return the extra columns that have a value in some row."""
    found = np.zeros(len(EXTRA_COLUMNS), dtype=bool)
    for spool in spools.values():
        spool.stream.flush()
        for rows in read_rows(spool):
            found |= ~np.isnan(rows[:, 4:]).all(axis=0)
    return [name for name, is_there in zip(EXTRA_COLUMNS, found, strict=True) if is_there]


def spool_pieces(recording: ForeignRecording, folder: Path) -> dict[str, Spool]:
    """Append every piece to the temporary file of its camera."""
    spools: dict[str, Spool] = {}
    for piece in recording.pieces or ():
        if not len(piece.pixels):
            continue
        spool = spools.get(piece.camera)
        if spool is None:
            path = folder / f"camera-{len(spools)}.rows"
            spool = spools[piece.camera] = Spool(path, open(path, "w+b"))  # noqa: SIM115 (closed by discard)
        _append(spool, piece)
    return spools


def _append(spool: Spool, piece: Piece) -> None:
    count = len(piece.pixels)
    rows = np.full((count, WIDTH), np.nan)
    if piece.frame is not None:
        rows[:, FRAME] = piece.frame
    if piece.time_s is not None:
        rows[:, TIME] = piece.time_s
    is_empty = np.isnan(piece.pixels[:, 0]) | np.isnan(piece.pixels[:, 1])
    rows[:, U : V + 1] = np.where(is_empty[:, None], np.nan, piece.pixels)
    if np.isinf(rows[:, U : V + 1]).any():
        raise InputError(f"camera {piece.camera}: expected finite pixels, found infinity")
    for name, values in piece.extra.items():
        rows[:, 4 + EXTRA_COLUMNS.index(name)] = values
    identities = rows[:, 4 + EXTRA_COLUMNS.index("object_id")]
    if (np.abs(identities[~np.isnan(identities)]) > MAX_FRAME).any():
        raise InputError(f"camera {piece.camera}: expected whole identities of objects, found one beyond 2^53")
    spool.has_frames &= piece.frame is not None
    key: Array = rows[:, FRAME] if spool.has_frames else rows[:, TIME]
    if not np.isfinite(key).all():
        what = "frame numbers" if spool.has_frames else "times"
        raise InputError(f"camera {piece.camera}: expected {what}, found a row without one")
    broken = key[(key % 1.0 != 0.0) | (np.abs(key) > MAX_FRAME)]
    if spool.has_frames and len(broken):
        raise InputError(f"camera {piece.camera}: expected whole frame numbers, found {broken[0]:g}")
    spool.in_order &= bool(key[0] >= spool.last and (np.diff(key) >= 0).all())
    spool.last = float(key[-1])
    spool.rows += count
    spool.stream.write(rows.data)  # `tofile` would not say why the disk refuses it


def read_rows(spool: Spool) -> Iterator[Array]:
    """Yield the rows of a temporary file in order, in pieces."""
    spool.stream.flush()
    if not spool.in_order:
        rows = np.fromfile(spool.path).reshape(-1, WIDTH)
        order = np.argsort(rows[:, FRAME if spool.has_frames else TIME], kind="stable")
        for start in range(0, len(rows), PIECE_ROWS):
            yield rows[order[start : start + PIECE_ROWS]]
        return
    with open(spool.path, "rb") as stream:
        while True:
            values = np.fromfile(stream, count=PIECE_ROWS * WIDTH)
            if not len(values):
                return
            yield values.reshape(-1, WIDTH)
