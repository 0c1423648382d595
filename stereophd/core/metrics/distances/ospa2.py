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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.metrics.distances.ospa import Ospa, check_parameters, ospa_of_sums
from stereophd.core.metrics.matching.near_pairs import NearPairs, least_cost, number_tracks
from stereophd.core.metrics.scans import UNLABELLED, PointSets

# Windows are summed for about this many (scan, track, object) at once, some 20 megabytes in all.
WINDOW_ENTRIES = 400_000

# A piece shorter than its window repeats most of the work of the one before: it may take this many instead.
MOST_ENTRIES = 4_000_000

# More scans at once gain nothing, and bring together more tracks that never meet.
MOST_SCANS_AT_ONCE = 4096


@dataclass(frozen=True)
class _Points:
    """Estimates, or true points, of a run: the scan and the number of the track, or of the object, of each."""

    start: Integers  # As in `PointSets`
    scan: Integers
    number: Integers


@dataclass(frozen=True)
class _Windows:
    """The windows that end at the scans ``first <= k < last``, and who exists in any of them."""

    first: int
    last: int
    begin: int  # First scan of the first window
    # Sorted numbers, (t,) and (o,)
    tracks: Integers
    targets: Integers

    @property
    def entries(self) -> int:
        return (self.last - self.first) * max(len(self.tracks), 1) * max(len(self.targets), 1)


def ospa2_of_windows(
    estimates: PointSets, truth: PointSets, near: NearPairs, window: int, order: float, cutoff: float
) -> Ospa:
    """Return OSPA(2), arrays (k,), over the window of scans that ends at each scan.

    Points with one label are one track. An estimate without an identity (negative label) is a track of one scan, and so
    is one whose label is there already in its scan. `near` holds all pairs nearer than the cutoff. A window has at
    least 1 scan; the first ones are shorter. Over time the base distance is a plain mean; the cutoff and the result are
    in its unit. The work per scan depends on the tracks and objects in its window only.

    Raises ValueError when parameters are out of range.
    """
    check_parameters(order, cutoff)
    if window < 1:
        raise ValueError(f"expected a window of at least 1 scan, found {window}")
    run = (
        _Points(estimates.start, estimates.scan, _number_tracks(estimates, estimates.label <= UNLABELLED)),
        _Points(truth.start, truth.scan, _number_tracks(truth, np.zeros(len(truth.label), dtype=bool))),
    )
    window = min(window, max(estimates.scans, 1))
    values = np.zeros((3, estimates.scans))
    todo = [(first, min(first + MOST_SCANS_AT_ONCE, estimates.scans))
            for first in range(0, estimates.scans, MOST_SCANS_AT_ONCE)]  # fmt: skip
    while todo:
        first, last = todo.pop()
        begin = max(first - window + 1, 0)
        names = [np.unique(one.number[one.start[begin] : one.start[last]]) for one in run]
        windows = _Windows(first, last, begin, *names)
        if windows.entries > (WINDOW_ENTRIES if last - first > window else MOST_ENTRIES) and last - first > 1:
            middle = (first + last) // 2
            todo += [(first, middle), (middle, last)]
            continue
        ratio, tracks, targets = _base_distances(run, near, windows, window)
        k, i, j = np.nonzero(ratio < 1.0)
        size = ratio.shape
        powers = ratio[k, i, j] ** order
        chosen = least_cost(k * size[1] + i, k * size[2] + j, powers, 1.0)
        located: Array = np.bincount(k[chosen], powers[chosen], size[0]).astype(np.float64)
        count = np.bincount(k[chosen], minlength=size[0])
        values[:, first:last] = ospa_of_sums(located, count, tracks.sum(axis=1), targets.sum(axis=1), order, cutoff)
    return Ospa(*values)


def _number_tracks(points: PointSets, anonymous: Booleans) -> Integers:
    """Number the tracks: one number for each label, and one for each anonymous or repeated point."""
    order = np.lexsort((points.label, points.scan))
    label, scan = points.label[order], points.scan[order]
    alone = anonymous.copy()
    alone[order[1:]] |= (np.diff(label) == 0) & (np.diff(scan) == 0)
    return number_tracks(points.label, alone)[0]


def _base_distances(
    run: tuple[_Points, _Points], near: NearPairs, windows: _Windows, window: int
) -> tuple[Array, Booleans, Booleans]:
    """Return base distances over the cutoff, (b, t, o), and who exists in each window, (b, t) and (b, o)."""
    begin, scans = windows.begin, windows.last - windows.begin
    ends = np.arange(windows.first - begin, scans) + 1

    def summed(values: NDArray[np.bool_] | Array) -> Array:
        sums = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
        return np.asarray(sums[ends] - sums[np.maximum(ends - window, 0)])

    there: list[Booleans] = []
    for points, names in zip(run, (windows.tracks, windows.targets), strict=True):
        rows = slice(points.start[begin], points.start[windows.last])
        there.append(np.zeros((scans, len(names)), dtype=np.bool_))
        there[-1][points.scan[rows] - begin, np.searchsorted(names, points.number[rows])] = True
    pairs = slice(*np.searchsorted(near.scan, [begin, windows.last]))
    nearness = np.zeros((scans, len(windows.tracks), len(windows.targets)))
    track, target = run[0].number[near.estimate[pairs]], run[1].number[near.truth[pairs]]
    places = np.searchsorted(windows.tracks, track), np.searchsorted(windows.targets, target)
    nearness[near.scan[pairs] - begin, *places] = 1.0 - near.ratio[pairs]
    together = summed(there[0][:, :, None] & there[1][:, None, :])
    lives = [summed(one) for one in there]
    either = lives[0][:, :, None] + lives[1][:, None, :] - together
    # Scans that leave the window are subtracted; rounding errors remain where the sum should be zero.
    ratio = 1.0 - np.clip(summed(nearness), 0.0, together) / np.maximum(either, 1.0)
    return ratio, lives[0] > 0.0, lives[1] > 0.0
