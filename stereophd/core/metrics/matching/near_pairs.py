"""All pairs of an estimate and a true point nearer than the cutoff, and the optimal assignment among them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.metrics.scans import UNLABELLED, PointSets
from stereophd.core.numerics.covariance_factors import is_positive_definite
from stereophd.core.numerics.rows import ArrayRows

# Distances held at once: some 20 megabytes.
PAIRS_AT_ONCE = 400_000


@dataclass(frozen=True)
class NearPairs(ArrayRows):
    """Pairs (q,) of an estimate and a true point of one scan that are nearer than the cutoff, in order of estimate."""

    scan: Integers  # (q,) array: Scan of the pair
    # `estimate`, `truth`: (q,) arrays: Rows of the estimate and of the true point.
    estimate: Integers
    truth: Integers
    ratio: Array  # (q,) array: Base distance over the cutoff, in [0, 1)


def near_pairs(estimates: PointSets, truth: PointSets, cutoff: float, *, mahalanobis: bool = False) -> NearPairs:
    """Return all pairs of the same scans whose base distance is below the cutoff.

    The distance is Euclidean, or ``sqrt((x - y)^T P^-1 (x - y))`` with the covariance P of the estimate (Mahalanobis,
    paper VIII-C). Raises ValueError when the scans differ in number, a distance is not finite, or a covariance that is
    needed is missing or not positive definite.
    """
    if estimates.scans != truth.scans:
        raise ValueError(f"expected as many scans of truth as of estimates, {estimates.scans}")
    inverse = _inverse_covariances(estimates) if mahalanobis else None
    pieces = [(np.zeros(0, dtype=np.int64),) * 3 + (np.zeros(0),)]
    for scan, estimate, true_point in _pairs_of_scans(estimates, truth):
        difference = estimates.position[estimate] - truth.position[true_point]
        weighted = difference if inverse is None else np.einsum("qij,qj->qi", inverse[estimate], difference)
        distance = np.sqrt(np.maximum(np.einsum("qd,qd->q", difference, weighted), 0.0))
        if not np.isfinite(distance).all():
            raise ValueError("expected finite distances")
        near = distance < cutoff
        pieces.append((scan[near], estimate[near], true_point[near], distance[near] / cutoff))
    return NearPairs(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)))


def _inverse_covariances(estimates: PointSets) -> Array:
    if estimates.covariance is None:
        raise ValueError("expected covariances for the Mahalanobis distance")
    if not is_positive_definite(estimates.covariance).all():
        raise np.linalg.LinAlgError("expected positive definite covariances")
    return np.asarray(np.linalg.inv(estimates.covariance))


def _pairs_of_scans(estimates: PointSets, truth: PointSets) -> Iterator[tuple[Integers, Integers, Integers]]:
    """Yield scan, estimate and true point of all pairs within a scan, in order, some scans at a time."""
    m, n = estimates.counts, truth.counts
    total = np.cumsum(m * n)
    for scans in np.split(np.arange(estimates.scans), np.flatnonzero(np.diff(total // PAIRS_AT_ONCE)) + 1):
        count = (m * n)[scans]
        scan = np.repeat(scans, count)
        place = np.arange(len(scan)) - np.repeat(np.cumsum(count) - count, count)
        estimate, true_point = np.divmod(place, n[scan])
        yield scan, estimates.start[scan] + estimate, truth.start[scan] + true_point


@dataclass(frozen=True)
class Couples:
    """True objects and tracks that are near each other at some scan."""

    # `object_of`, `track_of`: (n,), (m,) arrays: Number, from zero, of the object of each true point and of the track
    # of each estimate.
    object_of: Integers
    track_of: Integers
    # `objects`, `tracks`: (c,) arrays: Object and track of each couple.
    objects: Integers
    tracks: Integers
    number: Integers  # (q,) array: Couple of each near pair


def couples(estimates: PointSets, truth: PointSets, near: NearPairs) -> Couples:
    """Return the couples of the near pairs; an estimate without an identity is a track of its own."""
    track_of, count = number_tracks(estimates.label, estimates.label <= UNLABELLED)
    object_of = np.unique(truth.label, return_inverse=True)[1].astype(np.int64)
    names, number = np.unique(object_of[near.truth] * count + track_of[near.estimate], return_inverse=True)
    objects, tracks = np.divmod(names, max(count, 1))
    return Couples(object_of, track_of, objects, tracks, number)


def number_tracks(label: Integers, alone: Booleans) -> tuple[Integers, int]:
    """Number the tracks of points (n,) from zero, one for each label and for each point `alone` (n,); count them."""
    number = np.empty(len(label), dtype=np.int64)
    names, number[~alone] = np.unique(label[~alone], return_inverse=True)
    count = int(np.count_nonzero(alone))
    number[alone] = len(names) + np.arange(count)
    return number, len(names) + count


def least_cost(rows: Integers, columns: Integers, cost: Array, unpaired: float) -> Integers:
    """Choose pairs that share no row and no column, of the least total cost (q,); return their places.

    Rows and columns (q,) are any numbers, such as those of estimates and true points, and the places are in rising
    order. No pair costs more than what stays `unpaired`. Costs are not turned into gains, 1 less a small cost, whose
    last digits rounding would take. Where the best partners of all rows differ they are the optimum: their sum bounds
    every choice. Otherwise pairs that no chain of pairs connects are assigned apart, so that the work does not grow
    with the number of all rows times that of all columns.
    """
    if len(cost) == 0:
        return np.zeros(0, dtype=np.int64)
    order = np.lexsort((-cost, rows))
    best = order[np.append(np.diff(rows[order]) > 0, True)]
    wanted, times = np.unique(columns[best], return_inverse=True, return_counts=True)[1:]
    clashing = best[times[wanted] > 1]
    if not len(clashing):
        return np.sort(best)
    from scipy.optimize import linear_sum_assignment  # costly to import, often not needed
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    row, column = (np.unique(names, return_inverse=True)[1] for names in (rows, columns))
    size = int(row.max()) + int(column.max()) + 2
    graph = coo_array((np.ones(len(row), dtype=np.int8), (row, size - 1 - column)), shape=(size, size))
    part = connected_components(graph, directed=False)[1][row]
    is_free = ~np.isin(part, part[clashing])
    chosen = [best[is_free[best]]]
    others = np.flatnonzero(~is_free)
    others = others[np.argsort(part[others], kind="stable")]
    for places in np.split(others, np.flatnonzero(np.diff(part[others])) + 1):
        i, j = (np.unique(names[places], return_inverse=True)[1] for names in (row, column))
        table = np.full((i.max() + 1, j.max() + 1), unpaired)
        table[i, j] = cost[places]
        partner = np.full(len(table), -1)
        assigned, partners = linear_sum_assignment(table)
        partner[assigned] = partners
        chosen.append(places[partner[i] == j])
    return np.sort(np.concatenate(chosen))
