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

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.metrics.distances.ospa import ScanScores
from stereophd.core.metrics.matching.near_pairs import NearPairs, least_cost, near_pairs
from stereophd.core.metrics.scans import UNLABELLED, PointSets

NEVER = -1
# A track that is so many times nearer to another object than to its own does not follow its own.
BESIDE = 4.0


@dataclass(frozen=True)
class _Run:
    """Near pairs (q,) in order of scan, their tracks and objects, and which of them the optimal assignments have."""

    near: NearPairs
    # First pair of each scan, and the number of pairs: (k + 1,).
    start: Integers
    # (q,) Identity of the track, UNLABELLED without one, and number of the object.
    track: Integers
    target: Integers
    # (q,) Cost of the pair, over that of points without a pair.
    cost: Array
    targets: int
    # (q,) Whether the optimal assignment of the scan has the pair.
    optimal: Booleans
    # Rows of the optimal pairs with an identity by object and scan, and the rising keys of both.
    known: Integers
    known_key: Integers


class _Memory:
    """Track that each object was last matched to, and when."""

    def __init__(self, track: Integers, when: Integers) -> None:
        self.track, self.when = track, when

    def update(self, run: _Run, pairs: Integers, scan: int) -> None:
        """Take the pairs of a scan into account; those without identity do not count."""
        known = pairs[run.track[pairs] > UNLABELLED]
        self.track[run.target[known]] = run.track[known]
        self.when[run.target[known]] = scan

    def equals(self, other: _Memory) -> bool:
        """Return whether what follows is the same for both."""
        return bool((self.track == other.track).all() and (self.when == other.when).all())


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
    of the points that keep no assignment. The loop over single scans begins only at the first scan at which the optimal
    assignment breaks a pair that could be kept, and ends where both assignments remember the same tracks again.
    """
    run = _number(estimates, truth, near, order)
    suspects = _suspects(run)
    pieces: list[Integers] = []
    done = position = 0
    while position < len(suspects):
        scan = int(suspects[position])
        pieces.append(np.flatnonzero(run.optimal[run.start[done] : run.start[scan]]) + run.start[done])
        stepped, done = _step_through(run, scan)
        pieces.extend(stepped)
        position = int(np.searchsorted(suspects, done))
    pieces.append(np.flatnonzero(run.optimal[run.start[done] :]) + run.start[done])
    return near.take(np.sort(np.concatenate(pieces)))


def _number(estimates: PointSets, truth: PointSets, near: NearPairs, order: float) -> _Run:
    """Number the objects, and put the optimal pairs in order."""
    labels, label = np.unique(truth.label, return_inverse=True)
    start = np.searchsorted(near.scan, np.arange(estimates.scans + 1)).astype(np.int64)
    track, target = estimates.label[near.estimate], label[near.truth].astype(np.int64)
    cost = near.ratio**order
    optimal = np.zeros(len(cost), dtype=np.bool_)
    optimal[least_cost(near.estimate, near.truth, cost, 1.0)] = True
    rows = np.flatnonzero(optimal & (track > UNLABELLED))
    key = target[rows] * len(start) + near.scan[rows]
    in_order = np.argsort(key, kind="stable")
    return _Run(near, start, track, target, cost, len(labels), optimal, rows[in_order], key[in_order])


def _suspects(run: _Run) -> Integers:
    """Return the scans at which an object could keep the track that the optimal assignments gave it last, but does not.

    Up to the first of them both assignments are the same.
    """
    last = _last_before(run, run.target, run.near.scan)
    broken = (last != NEVER) & (run.track[last] == run.track) & ~run.optimal
    return np.unique(run.near.scan[broken])


def _last_before(run: _Run, target: Integers, scan: Integers | int) -> Integers:
    """Return the last optimal pair with identity of each object before a scan, `NEVER` without one."""
    if len(run.known) == 0:
        return np.full(len(target), NEVER, dtype=np.int64)
    place = np.searchsorted(run.known_key, target * len(run.start) + scan) - 1
    last = run.known[np.maximum(place, 0)]
    return np.where((place >= 0) & (run.target[last] == target), last, NEVER)


def _memory_before(run: _Run, scan: int) -> _Memory:
    """Return what the optimal assignments of the scans before this one remember."""
    last = _last_before(run, np.arange(run.targets), scan)
    return _Memory(np.where(last == NEVER, NEVER, run.track[last]), np.where(last == NEVER, NEVER, run.near.scan[last]))


def _step_through(run: _Run, first: int) -> tuple[Sequence[Integers], int]:
    """Assign scan by scan from `first`, until the optimal assignments remember the same; return pairs and next scan."""
    optimal = _memory_before(run, first)
    memory = _Memory(optimal.track.copy(), optimal.when.copy())
    pieces = []
    for scan in range(first, len(run.start) - 1):
        rows = np.arange(run.start[scan], run.start[scan + 1])
        pairs = _assign(run, rows, memory)
        pieces.append(pairs)
        memory.update(run, pairs, scan)
        optimal.update(run, rows[run.optimal[rows]], scan)
        if memory.equals(optimal):
            return pieces, scan + 1
    return pieces, len(run.start) - 1


def _assign(run: _Run, rows: Integers, memory: _Memory) -> Integers:
    """Return the pairs of one scan: those that are kept, and the best of what is left."""
    target = run.target[rows]
    track = run.track[rows]
    kept = rows[(track == memory.track[target]) & (track > UNLABELLED)]
    kept = kept[np.argsort(-memory.when[run.target[kept]], kind="stable")]
    kept = kept[np.sort(np.unique(run.near.estimate[kept], return_index=True)[1])]
    kept = kept[np.unique(run.target[kept], return_index=True)[1]]
    free = ~(np.isin(run.near.estimate[rows], run.near.estimate[kept]) | np.isin(target, run.target[kept]))
    remaining = rows[free]
    estimate, true_point = run.near.estimate[remaining], run.near.truth[remaining]
    return np.concatenate([kept, remaining[least_cost(estimate, true_point, run.cost[remaining], 1.0)]])
