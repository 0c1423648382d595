"""OSPA and GOSPA distances between sets of points (paper VIII-C).

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
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.matching.assignment import euclidean_distances, optimal_assignment


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


@dataclass(frozen=True)
class Matching:
    """Optimal assignments of k scans that all have m estimates and n true points."""

    truth: Integers  # (k, m) array: Index of the true point that each estimate is assigned to, -1 if none
    distance: Array  # (k, m) array: Base distance of that pair, infinite if none


def check_parameters(order: float, cutoff: float) -> None:
    """Raise ValueError unless ``1 <= order < inf`` and ``0 < cutoff < inf``."""
    if not (np.isfinite(order) and order >= 1.0):
        raise ValueError(f"expected an order >= 1 and finite, found {order}")
    if not (np.isfinite(cutoff) and cutoff > 0.0):
        raise ValueError(f"expected a cutoff > 0 and finite, found {cutoff}")


def match(distances: Array, order: float, cutoff: float) -> Matching:
    """Assign estimates to true points at the least sum of ``min(distance, cutoff)**order``.

    The distances are (k, m, n), of k scans. Pairs further apart than the cutoff are kept; their distance identifies
    them.
    """
    check_parameters(order, cutoff)
    truth = optimal_assignment(np.minimum(distances / cutoff, 1.0) ** order)
    if distances.shape[2] == 0:
        return Matching(truth, np.full(truth.shape, np.inf))
    distance = np.take_along_axis(distances, np.maximum(truth, 0)[:, :, None], axis=2)[:, :, 0]
    return Matching(truth, np.where(truth >= 0, distance, np.inf))


def ospa_of_matching(matching: Matching, n_truth: int, order: float, cutoff: float) -> Ospa:
    """Return the OSPA distances of matched scans (Schuhmacher et al. 2008, eq. 3 and its two parts)."""
    scans, n_estimates = matching.truth.shape
    longest = max(n_estimates, n_truth)
    if longest == 0:
        return Ospa(np.zeros(scans), np.zeros(scans), np.zeros(scans))
    ratio = np.where(matching.truth >= 0, np.minimum(matching.distance / cutoff, 1.0), 0.0)
    located = (ratio**order).sum(axis=1) / longest
    absent = np.full(scans, abs(n_estimates - n_truth) / longest)
    root = 1.0 / order
    return Ospa(cutoff * (located + absent) ** root, cutoff * located**root, cutoff * absent**root)


def gospa_of_matching(matching: Matching, n_truth: int, order: float, cutoff: float) -> Gospa:
    """Return the GOSPA distances (alpha = 2) of matched scans.

    With alpha = 2 a pair at or beyond the cutoff costs as much as one missed and one false point, so the
    assignment of OSPA is optimal for GOSPA too.
    """
    n_estimates = matching.truth.shape[1]
    near = matching.distance < cutoff
    pairs = near.sum(axis=1)
    located = (np.where(near, matching.distance / cutoff, 0.0) ** order).sum(axis=1)
    missed = 0.5 * (n_truth - pairs)
    false = 0.5 * (n_estimates - pairs)
    root = 1.0 / order
    return Gospa(
        cutoff * (located + missed + false) ** root, cutoff * located**root, cutoff * missed**root, cutoff * false**root
    )


def _match_two_sets(
    x: ArrayLike, y: ArrayLike, order: float, cutoff: float, distances: ArrayLike | None
) -> tuple[Matching, int]:
    estimates, truth = _as_points(x), _as_points(y)
    shape = (len(estimates), len(truth))
    if distances is not None:
        base = np.asarray(distances, dtype=float)
        if base.shape != shape:
            raise ValueError(f"expected distances of shape {shape}, found {base.shape}")
    elif 0 in shape:
        base = np.zeros(shape)
    else:
        base = euclidean_distances(estimates, truth)
    return match(base[None], order, cutoff), len(truth)


def _as_points(points: ArrayLike) -> Array:
    array = np.asarray(points, dtype=float)
    return array.reshape(0, 0) if array.size == 0 and array.ndim < 2 else array


def ospa(x: ArrayLike, y: ArrayLike, order: float, cutoff: float, distances: ArrayLike | None = None) -> Ospa:
    """Return the OSPA distance between two sets of points, and its parts, as zero-dimensional arrays.

    Estimates `x` are (m, d), the truth `y` is (n, d); either may be empty, and all parts are zero when both are. The
    order p >= 1 sets the weight of outliers; the cutoff c > 0 is the cost of a missed or false object, in the unit of
    the distances. Base distances (m, n) are given when they are not Euclidean (Mahalanobis, or between whole tracks).
    Raises ValueError for an order or cutoff out of range, a wrong shape, or a distance that is not finite.
    """
    matching, n_truth = _match_two_sets(x, y, order, cutoff, distances)
    return Ospa(*(part[0] for part in ospa_of_matching(matching, n_truth, order, cutoff)))


def gospa(x: ArrayLike, y: ArrayLike, order: float, cutoff: float, distances: ArrayLike | None = None) -> Gospa:
    """Return the GOSPA distance (alpha = 2) between two sets of points, and its parts.

    Parameters and errors are those of `ospa`; the result holds zero-dimensional arrays.
    """
    matching, n_truth = _match_two_sets(x, y, order, cutoff, distances)
    return Gospa(*(part[0] for part in gospa_of_matching(matching, n_truth, order, cutoff)))
