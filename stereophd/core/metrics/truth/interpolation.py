"""Which events are scored, and where the true objects are at their times.

Times are true times in seconds.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.metrics.scans import PointSets
from stereophd.core.numerics.rows import ArrayRows, sums_between
from stereophd.core.numerics.times import SAME_TIME_S

# By default the truth may be interpolated over intervals a little longer than its usual step.
DEFAULT_GAP_STEPS = 1.5
# Time before and after a row from which its velocity is fitted where the truth has none, s.
FIT_WINDOW_S = 0.1


@dataclass(frozen=True)
class Truth:
    """True objects: rows ordered by object and, within an object, by time."""

    time_s: Array  # (n,) array: True time; distinct within an object
    object_id: Integers  # (n,) array: Identity
    position: Array  # (n, 3) array: In the world, length unit
    velocity: Array | None = None  # (n, 3) array or None: Length unit per second; None where only positions are known

    @property
    def step_s(self) -> float:
        """Median time between successive rows of an object; infinite when no object has two rows."""
        step = np.diff(self.time_s)[np.diff(self.object_id) == 0]
        return float(np.median(step)) if step.size else float("inf")


@dataclass(frozen=True)
class Events(ArrayRows):
    """The events of a run, in the order in which they were processed."""

    time_s: Array  # (k,) array: Time of each event, never decreasing
    # `row_start`, `row_end`: (k,) arrays: The estimates reported after it are these rows of the tracks; equal when
    # there are none.
    row_start: Integers
    row_end: Integers


@dataclass(frozen=True)
class AlignedTruth:
    """True objects at the times of k events."""

    points: PointSets  # Their positions and velocities
    outside: Booleans  # (k,) bool array: The time is before the first or after the last row of the truth
    gap: Booleans  # (k,) bool array: An object that exists then has no rows near enough to interpolate its position


def last_event_of_each_time(time_s: Array) -> Integers:
    """Return the index of the last of all events that share a time, for times (k,) in order."""
    if len(time_s) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(np.append(np.diff(time_s) > SAME_TIME_S, True)).astype(np.int64)


def add_truth_times(events: Events, truth_time_s: Array) -> Events:
    """Add an event without estimates at each time of the truth (n,), in any order, that has none, if the grids agree.

    The events are known from the reported estimates only: those that reported nothing are missing. They are completed
    when every one lies on a time of the truth, and unchanged otherwise: then nothing shows when the others were.
    """
    grid = np.unique(truth_time_s)
    grid = grid[np.append(True, np.diff(grid) > SAME_TIME_S)] if len(grid) else grid
    if not _is_near(events.time_s, grid).all():
        return events
    missing = grid[~_is_near(grid, events.time_s)]
    none = np.zeros(len(missing), dtype=np.int64)
    time_s = np.concatenate([events.time_s, missing])
    order = np.argsort(time_s, kind="stable")
    joined = Events(time_s, np.concatenate([events.row_start, none]), np.concatenate([events.row_end, none]))
    return joined.take(order.astype(np.int64))


def _is_near(time_s: Array, grid: Array) -> Booleans:
    """Return which times lie within the tolerance of a time of the grid (sorted)."""
    if len(grid) == 0:
        return np.zeros(len(time_s), dtype=bool)
    after = np.clip(np.searchsorted(grid, time_s), 0, len(grid) - 1)
    before = np.maximum(after - 1, 0)
    distance = np.minimum(np.abs(grid[after] - time_s), np.abs(grid[before] - time_s))
    return np.asarray(distance <= SAME_TIME_S)


def in_window(time_s: Array, from_s: float | None, to_s: float | None) -> Booleans:
    """Return which times lie in ``[from_s, to_s]``; None is no bound."""
    inside = np.ones(len(time_s), dtype=bool)
    if from_s is not None:
        inside &= time_s >= from_s - SAME_TIME_S
    if to_s is not None:
        inside &= time_s <= to_s + SAME_TIME_S
    return inside


def align_truth(truth: Truth, time_s: Array, max_gap_s: float) -> AlignedTruth:
    """Interpolate the true objects linearly at the times (k,) of events, which never decrease.

    An object exists from its first to its last row; intervals between rows longer than `max_gap_s` are not interpolated
    over. Velocities are those of the truth, interpolated, or else fitted to its positions (`fitted_velocities`); NaN
    where there is none.
    """
    change = np.flatnonzero(np.diff(truth.object_id)) + 1
    ends = [len(truth.object_id)] if len(truth.object_id) else []
    starts = np.concatenate([[0], change, ends]).astype(np.int64)
    first, end = starts[:-1], starts[1:]
    birth, death = truth.time_s[first], truth.time_s[end - 1]
    begin = np.searchsorted(time_s, birth - SAME_TIME_S, side="left")
    stop = np.searchsorted(time_s, death + SAME_TIME_S, side="right")
    count = stop - begin
    owner = np.repeat(np.arange(len(first)), count)
    scan = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count) + begin[owner]
    time = np.clip(time_s[scan], birth[owner], death[owner])
    left = _segments(truth.time_s, starts, time, count)
    position, velocity, in_gap = _interpolate(truth, time, left, end[owner] - 1, max_gap_s)
    gap = np.zeros(len(time_s), dtype=bool)
    gap[scan[in_gap]] = True
    outside = np.ones(len(time_s), dtype=bool)
    if len(truth.time_s):
        outside = ~in_window(time_s, float(truth.time_s.min()), float(truth.time_s.max()))
    order = np.argsort(scan, kind="stable")
    counts = np.bincount(scan, minlength=len(time_s))
    points = PointSets(
        start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        position=position[order],
        velocity=velocity[order],
        label=truth.object_id[first[owner]][order],
    )
    return AlignedTruth(points, outside, gap)


def _segments(row_time: Array, starts: Integers, time: Array, count: Integers) -> Integers:
    """Return for each time of each object the row that begins its segment (objects one after the other)."""
    pieces = [np.zeros(0, dtype=np.int64)]
    done = 0
    for first, end, points in zip(starts[:-1], starts[1:], count, strict=True):
        rows = np.searchsorted(row_time[first:end], time[done : done + points], side="right") - 1
        pieces.append(first + np.clip(rows, 0, max(end - first - 2, 0)))
        done += points
    return np.concatenate(pieces)


def _interpolate(
    truth: Truth, time: Array, left: Integers, last: Integers, max_gap_s: float
) -> tuple[Array, Array, Booleans]:
    """Return position, velocity and whether the time is inside too long a segment, for each point."""
    right = np.minimum(left + 1, last)
    span = truth.time_s[right] - truth.time_s[left]
    elapsed = time - truth.time_s[left]
    on_row = np.minimum(elapsed, truth.time_s[right] - time) <= SAME_TIME_S
    long = span > max_gap_s + SAME_TIME_S
    weight = np.divide(elapsed, span, out=np.zeros_like(span), where=span > 0)[:, None]
    position = (1 - weight) * truth.position[left] + weight * truth.position[right]
    known = fitted_velocities(truth, max_gap_s) if truth.velocity is None else truth.velocity
    # at a row only that row counts: the other may lie beyond a gap
    velocity = np.where(weight > 0.0, weight * known[right], 0.0) + np.where(
        weight < 1.0, (1 - weight) * known[left], 0.0
    )
    return position, velocity, long & ~on_row


def fitted_velocities(truth: Truth, max_gap_s: float) -> Array:
    """Return velocities (n, 3) of a truth of positions, from lines of least squares; NaN where an object has one row.

    The lines are fitted to the rows within `FIT_WINDOW_S` before and after, or to the nearest where these are farther
    apart, without those beyond a gap: the difference of two rows a millisecond apart is their noise.
    """
    first = np.ones(len(truth.time_s), dtype=np.bool_)
    first[1:] = (np.diff(truth.object_id) != 0) | (np.diff(truth.time_s) > max_gap_s + SAME_TIME_S)
    piece = np.cumsum(first) - 1
    starts = np.flatnonzero(first)
    ends = np.append(starts[1:], len(first))
    rows, velocity = np.arange(len(first)), np.full((len(first), 3), np.nan)
    low, high = np.maximum(rows - 1, starts[piece]), np.minimum(rows + 2, ends[piece])
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        times = truth.time_s[start:end]
        reach = FIT_WINDOW_S + SAME_TIME_S
        low[start:end] = np.minimum(low[start:end], start + np.searchsorted(times, times - reach))
        high[start:end] = np.maximum(high[start:end], start + np.searchsorted(times, times + reach, side="right"))
        if end - start > 1:
            middle = truth.position[start:end].mean(axis=0)
            table = np.column_stack([times - times.mean(), truth.position[start:end] - middle])
            velocity[start:end] = _slopes(table, low[start:end] - start, high[start:end] - start)
    return velocity


def _slopes(table: Array, low: Integers, high: Integers) -> Array:
    """Return the slopes (n, 3) of columns 1 to 3 over column 0, over rows from `low` to before `high` (n,) each."""
    count = (high - low).astype(np.float64)[:, None]
    mean = sums_between(table, low, high) / count
    products = sums_between(table[:, :1] * table, low, high) / count - mean[:, :1] * mean
    return np.asarray(products[:, 1:] / products[:, :1])
