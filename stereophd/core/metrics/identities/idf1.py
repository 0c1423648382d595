"""IDF1: the share of points with the right identity when each object is given at most one track for the whole run.

References
----------
E. Ristani, F. Solera, R. Zou, R. Cucchiara, C. Tomasi, "Performance measures and a data set for multi-target,
multi-camera tracking", ECCV Workshops 2016 (section 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.metrics.matching.assignment import optimal_assignment
from stereophd.core.metrics.matching.near_pairs import Couples, NearPairs, couples
from stereophd.core.metrics.scans import PointSets


@dataclass(frozen=True)
class IdentityScore:
    """IDF1 and its two parts, between 0 and 1; NaN where there is nothing to divide by."""

    f1: float
    precision: float
    recall: float


def identity_score(estimates: PointSets, truth: PointSets, near: NearPairs) -> IdentityScore:
    """Return IDF1 with ID precision and ID recall, from all pairs of the same scans nearer than the cutoff.

    An estimate without an identity is a track of its own.
    """
    right = _most_common_scans(couples(estimates, truth, near))
    n_truth, n_estimates = len(truth.label), len(estimates.label)
    return IdentityScore(_share(2.0 * right, n_truth + n_estimates), _share(right, n_estimates), _share(right, n_truth))


def _share(part: float, whole: int) -> float:
    return part / whole if whole else float("nan")


def _most_common_scans(pairs: Couples) -> int:
    """Return the greatest total number of near pairs when each object is given at most one track.

    Objects and tracks that no chain of pairs connects are assigned apart, so that the work does not grow with the
    number of all objects times that of all tracks.
    """
    objects, tracks_of, count = pairs.objects, pairs.tracks, np.bincount(pairs.number)
    if len(objects) == 0:
        return 0
    from scipy.sparse import coo_array  # costly to import
    from scipy.sparse.csgraph import connected_components

    tracks = int(tracks_of.max()) + 1
    nodes = int(objects.max()) + 1 + tracks
    ones = np.ones(len(objects), dtype=np.int8)
    graph = coo_array((ones, (objects, tracks_of + nodes - tracks)), shape=(nodes, nodes))
    part = connected_components(graph, directed=False)[1][objects]
    order = np.argsort(part, kind="stable")
    total = 0
    for rows in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        row, column = (np.unique(names[rows], return_inverse=True)[1] for names in (objects, tracks_of))
        table = np.zeros((1, row.max() + 1, column.max() + 1))
        table[0, row, column] = count[rows]
        partner = optimal_assignment(-table)[0]
        paired = partner >= 0
        total += int(table[0, paired, partner[paired]].sum())
    return total
