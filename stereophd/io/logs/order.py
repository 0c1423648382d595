"""Whether the rows of a detection log are in order of time, or only the rows of each camera."""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.settings import LARGEST_TIME_S
from stereophd.io.file_kinds import LOG
from stereophd.io.logs.rows import values_of
from stereophd.io.tables.reading import cast_column, read_pieces
from stereophd.io.tables.schemas import FLOAT, STRING

# Two narrow columns: larger pieces than a reader of all columns takes.
PIECE_ROWS = 131_072


@dataclass(frozen=True)
class LogOrder:
    """How the rows of a log lie in time."""

    by_camera: bool  # the rows of each camera are in order of time, not those of all: in blocks, as tables put together
    misplaced: Integers  # rows outside the longest order of time, rising
    before: Array  # for each of them, the time of the row in order before it; -inf: none
    after: Array  # the same after it; inf: none


def order_of(path: Path) -> LogOrder:
    """Return how the rows of a log lie in time.

    The few are wrong, not the many: rows are misplaced if the longest sequence of rows in order of time leaves them
    out. Rows without a finite time or a camera are ignored here. Raises InputError when the file is damaged, or a value
    does not fit the type of its column.
    """
    for by_camera in (False, True):
        if _is_ordered(path, by_camera):
            return LogOrder(by_camera, np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))
    times, cameras = _whole(path)
    together = _misplaced(np.arange(len(times)), times)
    apart = [_misplaced(rows, times[rows]) for code in np.unique(cameras) for rows in [np.flatnonzero(cameras == code)]]
    count = sum(len(rows) for rows, _, _ in apart)
    if count >= len(together[0]):
        return LogOrder(False, *together)
    rows, before, after = (np.concatenate(parts) for parts in zip(*apart, strict=True))
    order = np.argsort(rows)
    return LogOrder(True, rows[order], before[order], after[order])


def _whole(path: Path) -> tuple[Array, Integers]:
    """Return the times (n,) of all rows, and the number of the camera of each, by its name."""
    numbers: dict[str, int] = {}
    times, cameras = [], []
    for piece, codes, names in _pieces(path, True):
        known = np.array([numbers.setdefault(name, len(numbers)) for name in names] + [-1])
        times.append(piece)
        cameras.append(known[codes])
    return np.concatenate(times), np.concatenate(cameras)


def _misplaced(rows: Integers, times: Array) -> tuple[Integers, Array, Array]:
    """Return which rows the longest order of their times (n,) leaves out, and the times in order around each.

    The longest sequence that does not fall, by the piles of patience (C. Schensted, Canadian J. Math. 13, 1961).
    """
    finite = np.flatnonzero(np.isfinite(times) & (np.abs(times) <= LARGEST_TIME_S))
    tails: list[float] = []
    last: list[int] = []
    previous = np.full(len(finite), -1, dtype=np.int64)
    for k, time in enumerate(times[finite].tolist()):
        pile = bisect_right(tails, time)
        previous[k] = last[pile - 1] if pile else -1
        if pile == len(tails):
            tails.append(time)
            last.append(k)
        else:
            tails[pile], last[pile] = time, k
    kept = np.zeros(len(finite), dtype=np.bool_)
    k = last[-1] if last else -1
    while k >= 0:
        kept[k] = True
        k = int(previous[k])
    ordered = np.concatenate([[-np.inf], times[finite][kept], [np.inf]])
    place = np.cumsum(kept)[~kept]
    return rows[finite[~kept]], ordered[place], ordered[place + 1]


def _is_ordered(path: Path, by_camera: bool) -> bool:
    """Whether times do not fall from row to row: of each camera, or of all, for which their names are not read."""
    latest: dict[str, float] = {}
    for times, codes, names in _pieces(path, by_camera):
        for code, name in enumerate(names):
            mine = times[(codes == code) & np.isfinite(times)]
            if not len(mine):
                continue
            if mine[0] < latest.get(name, -np.inf) or (np.diff(mine) < 0).any():
                return False
            latest[name] = float(mine[-1])
    return True


def _pieces(path: Path, has_cameras: bool) -> Iterator[tuple[Array, Integers, list[str]]]:
    """Yield times (n,), codes (n,) of the cameras (-1: null) and their names; without cameras all rows have one."""
    start = 0
    for batch in read_pieces(path, ["time_s", "camera"] if has_cameras else ["time_s"], LOG, PIECE_ROWS):
        times = values_of(cast_column(batch.column("time_s"), "time_s", FLOAT, path, start), np.float64, np.nan)
        codes, names = np.zeros(len(times), dtype=np.int64), [""]
        if has_cameras:
            column = cast_column(batch.column("camera"), "camera", STRING, path, start)
            encoded = column.dictionary_encode()
            codes, names = values_of(encoded.indices, np.int32, -1), encoded.dictionary.to_pylist()
        start += len(batch)
        yield times, codes, names
