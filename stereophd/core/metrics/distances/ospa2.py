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

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.metrics.distances.ospa import Ospa, check_parameters, ospa_of_sums
from stereophd.core.metrics.matching.near_pairs import NearPairs, least_cost, number_tracks
from stereophd.core.metrics.scans import UNLABELLED, PointSets
from stereophd.core.numerics.rows import sums_between

# Entries of tables of scans by tracks, objects and couples of them at once, some 20 megabytes in all.
MOST_ENTRIES = 500_000
# More scans at once gain nothing, and bring together more tracks that never meet.
MOST_SCANS_AT_ONCE = 4096


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
    tracks = _number_tracks(estimates, estimates.label <= UNLABELLED)
    objects = _number_tracks(truth, np.zeros(len(truth.label), dtype=bool))
    window = min(window, max(estimates.scans, 1))
    values = np.zeros((3, estimates.scans))
    todo = [(first, min(first + MOST_SCANS_AT_ONCE, estimates.scans))
            for first in range(0, estimates.scans, MOST_SCANS_AT_ONCE)]  # fmt: skip
    while todo:
        first, last = todo.pop()
        begin = max(first - window + 1, 0)
        names, there = _present(estimates, tracks, begin, last)
        other_names, other_there = _present(truth, objects, begin, last)
        # a track and an object that are never near each other cost as much as if they were not assigned
        rows = slice(*np.searchsorted(near.scan, [begin, last]))
        keys, couple = np.unique(
            tracks[near.estimate[rows]] * len(objects) + objects[near.truth[rows]], return_inverse=True
        )
        if (last - begin) * (len(names) + len(other_names) + len(keys)) > MOST_ENTRIES and last - first > 1:
            middle = (first + last) // 2
            todo += [(first, middle), (middle, last)]
            continue
        i, j = np.searchsorted(names, keys // len(objects)), np.searchsorted(other_names, keys % len(objects))
        nearness = np.zeros((last - begin, len(keys)))
        nearness[near.scan[rows] - begin, couple] = 1.0 - near.ratio[rows]
        ends = np.arange(first, last) - begin + 1
        lives, other_lives, together, gain = (
            sums_between(table, np.maximum(ends - window, 0), ends)
            for table in (there, other_there, there[:, i] & other_there[:, j], nearness)
        )
        # scans that leave the window are subtracted; rounding errors remain where the sum should be zero
        gain = np.clip(gain, 0.0, together)
        ratio = 1.0 - gain / np.maximum(lives[:, i] + other_lives[:, j] - together, 1.0)
        k, c = np.nonzero(ratio < 1.0)
        powers = ratio[k, c] ** order
        chosen = least_cost(k * len(names) + i[c], k * len(other_names) + j[c], powers, 1.0)
        located: Array = np.bincount(k[chosen], powers[chosen], last - first).astype(np.float64)
        count = np.bincount(k[chosen], minlength=last - first)
        exist = (lives > 0.0).sum(axis=1), (other_lives > 0.0).sum(axis=1)
        values[:, first:last] = ospa_of_sums(located, count, *exist, order, cutoff)
    return Ospa(*values)


def _number_tracks(points: PointSets, anonymous: Booleans) -> Integers:
    """Number the tracks: one number for each label, and one for each anonymous or repeated point."""
    order = np.lexsort((points.label, points.scan))
    label, scan = points.label[order], points.scan[order]
    alone = anonymous.copy()
    alone[order[1:]] |= (np.diff(label) == 0) & (np.diff(scan) == 0)
    return number_tracks(points.label, alone)[0]


def _present(points: PointSets, number: Integers, begin: int, last: int) -> tuple[Integers, Booleans]:
    """Return the numbers (n,) that exist in some scans, and in which of these, (k, n)."""
    rows = slice(points.start[begin], points.start[last])
    names, place = np.unique(number[rows], return_inverse=True)
    there = np.zeros((last - begin, len(names)), dtype=np.bool_)
    there[points.scan[rows] - begin, place] = True
    return names, there
