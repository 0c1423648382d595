"""Columns for the page: tracks in order, thinned out, and as compact text."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers

# Longer than this many usual steps between two estimates of a track is a gap: lines break there. Steps differ by much
# where cameras report one soon after the other and then pause, so usual is what few steps exceed.
GAP_STEPS = 3.0
USUAL_SHARE = 0.98


def packed(values: NDArray[Any]) -> str:
    """Return numbers as base64 of 32-bit floats, which the page's script unpacks; none is drawn beyond their range."""
    with np.errstate(over="ignore"):
        return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode("ascii")


@dataclass(frozen=True)
class Paths:
    """Paths of objects or tracks, one after the other, each in order of time."""

    ids: Integers  # (k,) of int
    starts: Integers  # First row of each, and the number of rows
    columns: Mapping[str, Array]  # With ``time_s, x, y, z``

    @property
    def times(self) -> Array:
        """Times of the rows (n,), s."""
        return self.columns["time_s"]

    def at(self, path: int, times: Array, names: Sequence[str]) -> Array:
        """Return columns (m, k) of one path at times (m,), interpolated; NaN outside of its life."""
        rows = slice(int(self.starts[path]), int(self.starts[path + 1]))
        path_times = self.times[rows]
        columns = [np.interp(times, path_times, self.columns[name][rows], np.nan, np.nan) for name in names]
        return np.stack(columns, axis=1)


def paths_of(ids: Integers, columns: Mapping[str, Array]) -> Paths:
    """Sort rows into paths, in order of their first time; of rows of one time the last one counts."""
    times = columns["time_s"]
    known, number = np.unique(ids, return_inverse=True)
    first = np.full(len(known), np.inf)
    np.minimum.at(first, number, times)
    rank = np.empty(len(known), dtype=np.int64)
    order_of_paths = np.lexsort((known, first))
    rank[order_of_paths] = np.arange(len(known))
    path = rank[number]
    order = np.lexsort((np.arange(len(times)), times, path))
    path, sorted_times = path[order], times[order]
    last = np.append((np.diff(path) != 0) | (np.diff(sorted_times) > 0), True)[: len(path)]
    order, path = order[last], path[last]
    starts = np.searchsorted(path, np.arange(len(known) + 1))
    kept = {name: np.asarray(values, dtype=np.float64)[order] for name, values in columns.items()}
    return Paths(known[order_of_paths], starts.astype(np.int64), kept)


def thinned(paths: Paths, budget: int) -> Paths:
    """Keep about `budget` rows, first and last ones always; a row of NaN marks each gap."""
    count = len(paths.times)
    step = max(1, -(-count // max(budget, 1)))
    path = np.repeat(np.arange(len(paths.ids)), np.diff(paths.starts))
    within = np.arange(count) - paths.starts[path]
    steps = np.diff(paths.times)
    inside = np.diff(path) == 0
    usual = float(np.quantile(steps[inside], USUAL_SHARE)) if inside.any() else np.inf
    gaps = np.append(False, inside & (steps > GAP_STEPS * usual))[:count]
    ends = np.append(np.diff(path) != 0, True)[:count]
    keep = (within % step == 0) | ends | gaps | np.append(gaps[1:], False)[:count]
    rows = np.flatnonzero(keep)
    breaks = np.flatnonzero(gaps[rows])
    columns = {name: np.insert(values[rows], breaks, np.nan) for name, values in paths.columns.items()}
    numbers = np.insert(path[rows], breaks, path[rows][breaks])
    return Paths(paths.ids, np.searchsorted(numbers, np.arange(len(paths.ids) + 1)).astype(np.int64), columns)


def chosen(count: int, most: int) -> Integers:
    """Return at most `most` of the first `count` numbers, evenly spread, first and last included."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, max(most, 1)).round().astype(np.int64))


def binned(times: Array, values: Mapping[str, Array], most: int) -> dict[str, Array]:
    """Return means over neighbouring rows, at most `most` of them, with their ``time_s``."""
    count = len(times)
    if count <= most:
        return {"time_s": times, **values}
    starts = np.arange(most) * count // most
    sizes = np.diff(np.append(starts, count))
    return {name: np.add.reduceat(column, starts) / sizes for name, column in {"time_s": times, **values}.items()}
