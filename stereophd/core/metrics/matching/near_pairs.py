"""All pairs of an estimate and a true point nearer than the cutoff, and assignments among them."""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.errors import UNLABELLED
from stereophd.core.metrics.matching.assignment import optimal_assignment
from stereophd.core.metrics.scans import PointSets, base_distances, batches_of_one_size
from stereophd.core.numerics.rows import ArrayRows


@dataclass(frozen=True)
class NearPairs(ArrayRows):
    """Pairs (q,) of an estimate and a true point of one scan that are nearer than the cutoff, in order of estimate."""

    scan: Integers  # (q,) array: Scan of the pair
    # `estimate`, `truth`: (q,) arrays: Rows of the estimate and of the true point.
    estimate: Integers
    truth: Integers
    ratio: Array  # (q,) array: Base distance over the cutoff, in [0, 1)


def near_pairs(estimates: PointSets, truth: PointSets, cutoff: float, *, mahalanobis: bool = False) -> NearPairs:
    """Return all pairs of the same scans whose base distance is below the cutoff."""
    pieces = [(np.zeros(0, dtype=np.int64),) * 3 + (np.zeros(0),)]
    for scans, m, n in batches_of_one_size(estimates.counts, truth.counts):
        if m == 0 or n == 0:
            continue
        rows = estimates.start[scans][:, None] + np.arange(m)
        columns = truth.start[scans][:, None] + np.arange(n)
        distance = base_distances(estimates, truth, rows, columns, mahalanobis)
        batch, row, column = np.nonzero(distance < cutoff)
        ratio = distance[batch, row, column] / cutoff
        pieces.append((scans[batch], rows[batch, row], columns[batch, column], ratio))
    scan, estimate, true_point, ratio = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    return NearPairs(scan, estimate, true_point, ratio).take(np.lexsort((true_point, estimate)))


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
    track_of, count = _numbered_tracks(estimates.label)
    object_of = np.unique(truth.label, return_inverse=True)[1].astype(np.int64)
    names, number = np.unique(object_of[near.truth] * count + track_of[near.estimate], return_inverse=True)
    objects, tracks = np.divmod(names, max(count, 1))
    return Couples(object_of, track_of, objects, tracks, number)


def _numbered_tracks(label: Integers) -> tuple[Integers, int]:
    """Number the tracks of estimates (n,) from zero; return the numbers and how many tracks there are."""
    known = label > UNLABELLED
    names, number = np.unique(label[known], return_inverse=True)
    out = np.empty(len(label), dtype=np.int64)
    out[known] = number
    out[~known] = len(names) + np.arange(np.count_nonzero(~known))
    return out, len(names) + int(np.count_nonzero(~known))


def most_gain(pairs: NearPairs, gain: Array) -> Integers:
    """Choose pairs that share no point, of the greatest total gain (q,), not negative, in each scan; return their rows.

    Rows are in rising order. Where the best partners of the estimates of a scan differ they are the optimum: their sum
    bounds every choice. Only the other scans are solved.
    """
    if len(gain) == 0:
        return np.zeros(0, dtype=np.int64)
    order = np.lexsort((gain, pairs.estimate))
    last = np.append(np.diff(pairs.estimate[order]) > 0, True)
    best = order[last]
    partners = np.bincount(pairs.truth[best])
    clash = np.unique(pairs.scan[best[partners[pairs.truth[best]] > 1]])
    chosen = [best[~np.isin(pairs.scan[best], clash)]]
    by_scan = np.argsort(pairs.scan, kind="stable")
    begin = np.searchsorted(pairs.scan[by_scan], clash, side="left")
    end = np.searchsorted(pairs.scan[by_scan], clash, side="right")
    for first, stop in zip(begin.tolist(), end.tolist(), strict=True):
        rows = by_scan[first:stop]
        chosen.append(rows[_solve(pairs.estimate[rows], pairs.truth[rows], gain[rows])])
    return np.sort(np.concatenate(chosen))


def _solve(estimate: Integers, truth: Integers, gain: Array) -> Integers:
    """Choose pairs of one scan: those of the greatest total gain."""
    names, row = np.unique(estimate, return_inverse=True)
    others, column = np.unique(truth, return_inverse=True)
    cost = np.zeros((1, len(names), len(others)))
    cost[0, row, column] = -gain
    partner = optimal_assignment(cost)[0]
    return np.flatnonzero(partner[row] == column)
