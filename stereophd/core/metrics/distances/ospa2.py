"""OSPA(2): the OSPA distance between sets of tracks, over a sliding window of scans.

The base distance of a track and a true object is the mean, over the scans of the window at which at least
one of them exists, of their distance truncated at the cutoff; where only one exists it is the cutoff. OSPA
with this base, between the tracks and the objects that exist in the window, punishes what OSPA does not
see: a track that changes its identity or its object, or breaks.

References
----------
M. Beard, B. T. Vo, B.-N. Vo, "OSPA(2): Using the OSPA metric to evaluate multi-target tracking
performance", ICCAIS 2017, and "A solution for large-scale multi-object tracking", IEEE Trans. Signal
Processing 68, 2020 (section V).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.distances.ospa import Ospa, check_parameters, match, ospa_of_matching
from stereophd.core.metrics.errors import UNLABELLED
from stereophd.core.metrics.matching.assignment import is_positive_definite
from stereophd.core.metrics.scans import PointSets, batches_of_one_size

# Windows are summed for about this many (scan, track, object) at once, some 20 megabytes in all.
WINDOW_ENTRIES = 400_000

# A piece shorter than its window repeats most of the work of the one before: it may take this many instead.
MOST_ENTRIES = 4_000_000

# More scans at once gain nothing, and bring together more tracks that never meet.
MOST_SCANS_AT_ONCE = 4096


@dataclass(frozen=True)
class _Run:
    """Estimates and truth of a run, with the track and the object of each of their points numbered."""

    estimates: PointSets
    truth: PointSets
    track: Integers
    target: Integers
    # (n, 3, 3), None: Euclidean
    inverse_covariance: Array | None
    cutoff: float
    window: int

    def earliest(self, first: int) -> int:
        """Return the first scan of the window that ends at scan `first`."""
        return max(first - self.window + 1, 0)


@dataclass(frozen=True)
class _Chunk:
    """The windows that end at the scans ``first <= k < last``, and who exists in any of them."""

    first: int
    last: int
    # Sorted numbers, (t,) and (o,)
    tracks: Integers
    targets: Integers

    @property
    def scans(self) -> int:
        return self.last - self.first

    @property
    def entries(self) -> int:
        return self.scans * max(len(self.tracks), 1) * max(len(self.targets), 1)


def ospa2_of_windows(
    estimates: PointSets, truth: PointSets, window: int, order: float, cutoff: float, *, mahalanobis: bool = False
) -> Ospa:
    """Return OSPA(2), arrays (k,), over the window of scans that ends at each scan.

    Points with one label are one track. An estimate without an identity (negative label) is a track of one scan, and so
    is one whose label is there already in its scan. A window has at least 1 scan; the first ones are shorter. Over time
    the base distance, Euclidean or from the covariance of each estimate (Mahalanobis), is a plain mean; the cutoff and
    the result are in its unit. The work per scan depends on the tracks and objects in its window only.

    Raises ValueError when the scans differ in number, parameters are out of range, or a covariance that is needed is
    missing or not positive definite.
    """
    check_parameters(order, cutoff)
    if window < 1:
        raise ValueError(f"expected a window of at least 1 scan, found {window}")
    if estimates.scans != truth.scans:
        raise ValueError(f"expected as many scans of truth as of estimates, {estimates.scans}")
    run = _Run(
        estimates,
        truth,
        _number_tracks(estimates, estimates.label <= UNLABELLED),
        _number_tracks(truth, np.zeros(len(truth.label), dtype=bool)),
        _inverse_covariances(estimates) if mahalanobis else None,
        cutoff,
        min(window, max(estimates.scans, 1)),
    )
    values = np.zeros((3, estimates.scans))
    for chunk in _chunks(run):
        ratio, track_there, target_there = _base_distances(run, chunk)
        for scans, m, n in batches_of_one_size(track_there.sum(axis=1), target_there.sum(axis=1)):
            rows, columns = _first_marked(track_there[scans], m), _first_marked(target_there[scans], n)
            distances = cutoff * ratio[scans[:, None, None], rows[:, :, None], columns[:, None, :]]
            values[:, chunk.first + scans] = ospa_of_matching(match(distances, order, cutoff), n, order, cutoff)
    return Ospa(*values)


def _number_tracks(points: PointSets, anonymous: NDArray[np.bool_]) -> Integers:
    """Number the tracks: one number for each label, and one for each anonymous or repeated point."""
    order = np.lexsort((points.label, points.scan))
    label, scan = points.label[order], points.scan[order]
    alone = anonymous.copy()
    alone[order[1:]] |= (np.diff(label) == 0) & (np.diff(scan) == 0)
    number = np.empty(len(label), dtype=np.int64)
    names, number[~alone] = np.unique(points.label[~alone], return_inverse=True)
    number[alone] = len(names) + np.arange(alone.sum())
    return number


def _inverse_covariances(estimates: PointSets) -> Array:
    if estimates.covariance is None:
        raise ValueError("expected covariances for the Mahalanobis distance")
    if not is_positive_definite(estimates.covariance).all():
        raise np.linalg.LinAlgError("expected positive definite covariances")
    return np.asarray(np.linalg.inv(estimates.covariance))


def _chunks(run: _Run) -> Iterator[_Chunk]:
    """Cut the scans where the tracks of a piece become too many for one table."""
    scans = run.estimates.scans
    todo = [(first, min(first + MOST_SCANS_AT_ONCE, scans)) for first in range(0, scans, MOST_SCANS_AT_ONCE)]
    while todo:
        first, last = todo.pop()
        begin = run.earliest(first)
        chunk = _Chunk(
            first,
            last,
            np.unique(run.track[_rows(run.estimates, begin, last)]),
            np.unique(run.target[_rows(run.truth, begin, last)]),
        )
        bound = WINDOW_ENTRIES if chunk.scans > run.window else MOST_ENTRIES
        if chunk.entries > bound and chunk.scans > 1:
            middle = (first + last) // 2
            todo += [(first, middle), (middle, last)]
        else:
            yield chunk


def _rows(points: PointSets, first: int, last: int) -> slice:
    return slice(int(points.start[first]), int(points.start[last]))


def _base_distances(run: _Run, chunk: _Chunk) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return base distances over the cutoff, (b, t, o), and who exists in each window, (b, t) and (b, o)."""
    shape = (chunk.scans, len(chunk.tracks), len(chunk.targets))
    begin = run.earliest(chunk.first)
    lives, rows, offset = [], [], (int(run.estimates.start[begin]), int(run.truth.start[begin]))
    for points, number, names in ((run.estimates, run.track, chunk.tracks), (run.truth, run.target, chunk.targets)):
        rows.append(np.searchsorted(names, number[_rows(points, begin, chunk.last)]))
        scan = np.repeat(np.arange(begin, chunk.last), points.counts[begin : chunk.last])
        steps = np.zeros((chunk.scans, len(names)), dtype=np.int64)
        _add_steps(steps, run, chunk, scan, rows[-1], np.ones(len(scan), dtype=np.int64))
        lives.append(steps.cumsum(axis=0))
    both, near = np.zeros((shape[0], shape[1] * shape[2]), dtype=np.int64), np.zeros((shape[0], shape[1] * shape[2]))
    for scan, estimate, true_point in _pairs_of_scans(run, begin, chunk.last):
        cell = rows[0][estimate - offset[0]] * shape[2] + rows[1][true_point - offset[1]]
        _add_steps(both, run, chunk, scan, cell, np.ones(len(scan), dtype=np.int64))
        _add_steps(near, run, chunk, scan, cell, np.minimum(_distances(run, estimate, true_point) / run.cutoff, 1.0))
    together = both.cumsum(axis=0)
    # Scans that leave the window are subtracted; rounding errors remain where the sum should be zero.
    located = np.clip(near.cumsum(axis=0), 0.0, together).reshape(shape)
    together = together.reshape(shape)
    either = lives[0][:, :, None] + lives[1][:, None, :] - together
    ratio = (located + (either - together)) / np.maximum(either, 1)
    return ratio, lives[0] > 0, lives[1] > 0


def _add_steps(
    steps: NDArray[Any], run: _Run, chunk: _Chunk, scan: Integers, cell: Integers, weight: NDArray[Any]
) -> None:
    """Add to steps (b, cells), whose running sum over scans is the sum over each window.

    A contribution comes in with its scan (or with the first window), and leaves a window's length later.
    """
    cells = steps.shape[1]
    flat = steps.reshape(-1)
    np.add.at(flat, np.maximum(scan - chunk.first, 0) * cells + cell, weight)
    leaves = scan + run.window - chunk.first
    inside = leaves < chunk.scans
    np.subtract.at(flat, leaves[inside] * cells + cell[inside], weight[inside])


def _pairs_of_scans(run: _Run, begin: int, end: int) -> Iterator[tuple[Integers, Integers, Integers]]:
    """Yield scan, estimate and true point of all pairs within a scan, some scans at a time."""
    m, n = run.estimates.counts[begin:end], run.truth.counts[begin:end]
    total = np.cumsum(m * n)
    cuts = np.flatnonzero(np.diff(total // WINDOW_ENTRIES)) + 1
    for scans in np.split(np.arange(end - begin), cuts):
        count = (m * n)[scans]
        owner = np.repeat(scans, count)
        place = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        estimate = run.estimates.start[begin + owner] + place // n[owner]
        yield begin + owner, estimate, run.truth.start[begin + owner] + place % n[owner]


def _distances(run: _Run, estimate: Integers, true_point: Integers) -> Array:
    """Return the base distances (q,) of pairs of points."""
    difference = run.estimates.position[estimate] - run.truth.position[true_point]
    if run.inverse_covariance is None:
        return np.asarray(np.sqrt(np.einsum("qd,qd->q", difference, difference)))
    weighted = np.einsum("qij,qj->qi", run.inverse_covariance[estimate], difference)
    return np.asarray(np.sqrt(np.maximum(np.einsum("qi,qi->q", difference, weighted), 0.0)))


def _first_marked(marked: NDArray[np.bool_], count: int) -> Integers:
    """Return the columns of the marks of each row, (b, count), for rows that all have this many."""
    return np.argsort(~marked, axis=1, kind="stable")[:, :count].astype(np.int64)
