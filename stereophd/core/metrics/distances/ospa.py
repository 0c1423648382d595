"""OSPA and GOSPA distances between sets of points (paper VIII-C).

Both are sums over an optimal assignment of estimates to true points, and so is everything that is counted over matched
pairs (RMSE, NEES, identity switches). Pairs at or beyond the cutoff cost as much as pairs that are not assigned: those
nearer than the cutoff are all that the assignment needs.

References
----------
D. Schuhmacher, B.-T. Vo, B.-N. Vo, "A consistent metric for performance evaluation of multi-object
filters", IEEE Trans. Signal Processing 56(8), 2008 (OSPA, eq. 3).
A. S. Rahmathullah, A. F. Garcia-Fernandez, L. Svensson, "Generalized optimal sub-pattern assignment
metric", FUSION 2017 (GOSPA, with alpha = 2, so that it splits into localisation, missed and false).

All sums are formed with distances divided by the cutoff, so that a large order neither overflows nor
underflows.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.matching.near_pairs import NearPairs, least_cost, near_pairs
from stereophd.core.metrics.scans import PointSets


class Ospa(NamedTuple):
    """OSPA distances and their parts, arrays (k,) over scans.

    ``distance**order == localisation**order + cardinality**order``; all in the unit of the base distance,
    between 0 and the cutoff.
    """

    distance: Array
    localisation: Array
    cardinality: Array


class Gospa(NamedTuple):
    """GOSPA distances (alpha = 2) and their parts, arrays (k,) over scans.

    ``distance**order == localisation**order + missed**order + false**order``; all in the unit of the base
    distance.
    """

    distance: Array
    localisation: Array
    missed: Array
    false: Array


def check_parameters(order: float, cutoff: float) -> None:
    """Raise ValueError unless ``1 <= order < inf`` and ``0 < cutoff < inf``."""
    if not (np.isfinite(order) and order >= 1.0):
        raise ValueError(f"expected an order >= 1 and finite, found {order}")
    if not (np.isfinite(cutoff) and cutoff > 0.0):
        raise ValueError(f"expected a cutoff > 0 and finite, found {cutoff}")


@dataclass(frozen=True)
class ScanScores:
    """Metrics of each scan, arrays (k,), and the pairs of estimates and true points."""

    ospa: Ospa
    gospa: Gospa
    near: NearPairs  # All pairs nearer than the cutoff
    pairs: NearPairs  # Those that are matched, in order of estimate

    @property
    def n_matched(self) -> Integers:
        """Number of matched pairs of each scan, (k,)."""
        return np.bincount(self.pairs.scan, minlength=len(self.ospa.distance)).astype(np.int64)


def score_scans(
    estimates: PointSets, truth: PointSets, order: float, cutoff: float, *, mahalanobis: bool = False
) -> ScanScores:
    """Score the estimates of each scan against its true points, by OSPA and GOSPA of this order and cutoff.

    The base distance is Euclidean or taken from the covariance of each estimate (Mahalanobis); the cutoff is in its
    unit. Matched are the pairs of the optimal assignment that are nearer than the cutoff.

    Raises ValueError when the scans differ in number, parameters are out of range, a distance is not finite, or a
    covariance that is needed is missing or not positive definite.
    """
    check_parameters(order, cutoff)
    near = near_pairs(estimates, truth, cutoff, mahalanobis=mahalanobis)
    pairs = near.take(least_cost(near.estimate, near.truth, near.ratio**order, 1.0))
    count = np.bincount(pairs.scan, minlength=estimates.scans)
    located: Array = np.bincount(pairs.scan, pairs.ratio**order, estimates.scans).astype(np.float64)
    m, n = estimates.counts, truth.counts
    missed, false, root = 0.5 * (n - count), 0.5 * (m - count), 1.0 / order
    parts = (located + missed + false, located, missed, false)
    gospa = Gospa(*(np.asarray(cutoff * part**root) for part in parts))
    return ScanScores(ospa_of_sums(located, count, m, n, order, cutoff), gospa, near, pairs)


def ospa_of_sums(located: Array, count: Integers, m: Integers, n: Integers, order: float, cutoff: float) -> Ospa:
    """Return the OSPA distances of k optimal assignments (Schuhmacher et al. 2008, eq. 3 and its two parts).

    Of each, `located` (k,) is the sum of ``(distance / cutoff)**order`` over the pairs nearer than the cutoff, `count`
    the number of these, and m and n are the numbers of estimates and of true points.
    """
    longest, root = np.maximum(np.maximum(m, n), 1), 1.0 / order
    located, absent = (located + (np.minimum(m, n) - count)) / longest, np.abs(m - n) / longest
    return Ospa(cutoff * (located + absent) ** root, cutoff * located**root, cutoff * absent**root)
