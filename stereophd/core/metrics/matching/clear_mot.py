"""The assignment of CLEAR MOT: a true object keeps its track while the two stay nearer than the cutoff.

The optimal assignment of each scan on its own changes the tracks of two objects that are closer than their errors back
and forth, although both are followed without fault. Identity switches, purity, RMSE and NEES therefore use the
assignment of Bernardin and Stiefelhagen. At each scan the objects first keep the tracks that they were last matched to,
if these are still nearer than the match distance (the cutoff, unless another one is stated). Only the remaining points
are then assigned, at the least sum of ``min(distance, match distance)**order``. Where two objects were last matched to
one track, the later of them has it.

The match distance is the threshold T of the authors. Where it is larger than the distance between objects, an
assignment may be wrong from the first scan on and yet be kept: an object stays assigned to a track 10 cm away, although
that track follows another object within 1 mm.

References
----------
K. Bernardin, R. Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics", EURASIP Journal
on Image and Video Processing, 2008 (section 2.1.3).
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.metrics.distances.ospa import ScanScores
from stereophd.core.metrics.matching.near_pairs import NearPairs, least_cost, near_pairs
from stereophd.core.metrics.scans import UNLABELLED, PointSets

# What an object without a match so far remembers.
NOTHING = (UNLABELLED, -1)
# A track that is so many times nearer to another object than to its own does not follow its own.
BESIDE = 4.0


def match_within(
    estimates: PointSets,
    truth: PointSets,
    scores: ScanScores,
    order: float,
    cutoff: float,
    distance: float,
    *,
    mahalanobis: bool = False,
) -> tuple[ScanScores, NearPairs]:
    """Return the scores with the pairs of CLEAR MOT nearer than a distance, and all pairs nearer than it.

    The cutoff of the scores and the distance are in the unit of the base distance, which is Euclidean or taken from the
    covariance of each estimate; the rest is as for `follow`.
    """
    near = scores.near if distance == cutoff else near_pairs(estimates, truth, distance, mahalanobis=mahalanobis)
    return replace(scores, pairs=follow(estimates, truth, near, order)), near


def beside_another(estimates: PointSets, truth: PointSets, matched: NearPairs, matchable: NearPairs) -> int:
    """Return the number of matches whose track is more than `BESIDE` times nearer to another object than to its own.

    They count where that is so in most matches of the same object and track: errors of the track cause it now and then.
    Both pairs are those of `match_within`.
    """
    nearest = np.full(len(estimates.label), np.inf)
    np.minimum.at(nearest, matchable.estimate, matchable.ratio)
    beside = matched.ratio > BESIDE * nearest[matched.estimate]
    named = np.stack([truth.label[matched.truth], estimates.label[matched.estimate]])
    couple = np.unique(named, axis=1, return_inverse=True)[1].ravel()
    pairs, wrong = np.bincount(couple), np.bincount(couple, weights=beside)
    return int(wrong[2 * wrong > pairs].sum())


def follow(estimates: PointSets, truth: PointSets, near: NearPairs, order: float) -> NearPairs:
    """Return the pairs of CLEAR MOT, in order of estimate.

    The scans are in order of time; `near` holds all pairs that may be matched, and `order` is the order p of the cost
    of the points that keep no assignment. Where the optimal assignment of a scan has all pairs that could be kept, it
    is the one wanted.
    """
    cost = near.ratio**order
    chosen = np.zeros(len(cost), dtype=np.bool_)
    chosen[least_cost(near.estimate, near.truth, cost, 1.0)] = True
    track, target = estimates.label[near.estimate], truth.label[near.truth]
    memory: dict[int, tuple[int, int]] = {}  # of each object: the track that it was last matched to, and the scan
    starts = np.searchsorted(near.scan, np.arange(estimates.scans + 1)).tolist()
    for scan, (first, end) in enumerate(pairwise(starts)):
        rows = slice(first, end)
        tracks, targets, matched = track[rows].tolist(), target[rows].tolist(), chosen[rows].tolist()
        kept = [k for k, one in enumerate(tracks) if one > UNLABELLED and memory.get(targets[k], NOTHING)[0] == one]
        if not all(matched[k] for k in kept):
            since = {k: memory[targets[k]][1] for k in kept}
            latest_first = sorted(kept, key=since.__getitem__, reverse=True)
            chosen[rows] = False
            chosen[first + _assign(near.take(rows), cost[rows], np.array(latest_first))] = True
            matched = chosen[rows].tolist()
        memory.update({targets[k]: (one, scan) for k, one in enumerate(tracks) if matched[k] and one > UNLABELLED})
    return near.take(np.flatnonzero(chosen))


def _assign(near: NearPairs, cost: Array, kept: Integers) -> Integers:
    """Return the pairs of one scan: those that are kept, the first of each point, and the best of what is left."""
    kept = kept[np.sort(np.unique(near.estimate[kept], return_index=True)[1])]
    kept = kept[np.unique(near.truth[kept], return_index=True)[1]]
    taken = np.isin(near.estimate, near.estimate[kept]) | np.isin(near.truth, near.truth[kept])
    left = np.flatnonzero(~taken)
    return np.concatenate([kept, left[least_cost(near.estimate[left], near.truth[left], cost[left], 1.0)]])
