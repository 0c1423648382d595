"""Fragments of one track: which tracks continue others, by where one ends and the next begins."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans
from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.smoothing import Trajectory

# Squared Mahalanobis distance (99 % of a chi-square with 6 degrees of freedom) up to which the end of one
# track and the start of another may be one object.
STITCH_DISTANCE = 16.81


def stitch(trajectories: Sequence[Trajectory], motion: Motion, max_gap_s: float) -> dict[int, int]:
    """Find tracks that continue others.

    The end of a track, predicted over the gap, is compared with the start of each track that begins at
    most `max_gap_s` later; pairs are chosen jointly, at the least total squared Mahalanobis distance.

    Returns
    -------
    dict
        Track -> the earlier track that it continues, for those that do.
    """
    if not trajectories:
        return {}
    starts = np.array([t.times[0] for t in trajectories])
    order = np.argsort(starts, kind="stable")
    starts = starts[order]
    first_events = np.array([trajectories[k].events[0] for k in order])
    positions = np.array([trajectories[k].states[0, :3] for k in order])
    spreads = np.array([np.sqrt(np.diagonal(trajectories[k].covariances[0])[:3]) for k in order])
    pairs: dict[tuple[int, int], float] = {}
    for i, earlier in enumerate(trajectories):
        end_s = float(earlier.times[-1])
        first, last = np.searchsorted(starts, end_s), np.searchsorted(starts, end_s + max_gap_s, side="right")
        soon = np.arange(first, last)[first_events[first:last] > earlier.events[-1]]
        near = soon[_may_be_near(earlier, starts[soon], positions[soon], spreads[soon], motion)]
        for k in order[near].tolist():
            distance = _distance(earlier, trajectories[k], motion)
            if distance <= STITCH_DISTANCE:
                pairs[i, k] = distance
    return {
        trajectories[j].track_id: trajectories[i].track_id
        for group in _connected(pairs, len(trajectories))
        for i, j in _assigned({pair: pairs[pair] for pair in group})
    }


def _may_be_near(earlier: Trajectory, starts: Array, positions: Array, spreads: Array, motion: Motion) -> Booleans:
    """Return which starts (n,) a bound on each axis does not rule out: their distance can be below the limit."""
    if not len(starts):
        return np.zeros(0, dtype=np.bool_)
    gaps = starts - earlier.times[-1]
    end = earlier.states[-1]
    flow = motion.flow(gaps)
    predicted = end[:3] + flow.reach[:, None] * end[3:] + flow.drift[:, :3]
    std = np.sqrt(np.diagonal(earlier.covariances[-1]))
    # a sum of standard deviations bounds the spread for any correlations, as does the noise of the longest gap
    noise = np.sqrt(np.diagonal(motion.transition(float(gaps.max())).noise)[:3])
    bound = std[:3] + flow.reach[:, None] * std[3:] + noise + spreads
    return np.asarray((np.abs(positions - predicted) <= np.sqrt(STITCH_DISTANCE) * bound).all(axis=1))


def _distance(earlier: Trajectory, later: Trajectory, motion: Motion) -> float:
    """Squared Mahalanobis distance of the start of a track from the predicted end of another."""
    transition = motion.transition(float(later.times[0] - earlier.times[-1]))
    predicted, spread = transition.predict(earlier.states[-1], earlier.covariances[-1])
    difference = later.states[0] - predicted
    covariance = spread + later.covariances[0]
    # static objects have no velocity to compare: its covariance is zero
    return float(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference)


def _connected(pairs: Iterable[tuple[int, int]], count: int) -> list[list[tuple[int, int]]]:
    """Groups of pairs that share no track with another group: a long log has many tracks, but few meet."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    places: NDArray[np.int64] = np.array(list(pairs), dtype=np.int64).reshape(-1, 2)
    # the end of a track and its start are two nodes
    edges = (np.ones(len(places)), (places[:, 0], count + places[:, 1]))
    _, component = connected_components(coo_array(edges, shape=(2 * count, 2 * count)), directed=False)
    groups: dict[int, list[tuple[int, int]]] = {}
    for i, j in places.tolist():
        groups.setdefault(int(component[i]), []).append((i, j))
    return list(groups.values())


def _assigned(costs: dict[tuple[int, int], float]) -> Iterator[tuple[int, int]]:
    """Yield the pairs of the joint assignment of least cost, a track left alone at twice the limit."""
    from scipy.optimize import linear_sum_assignment

    ends, begins = sorted({i for i, _ in costs}), sorted({j for _, j in costs})
    # twice the limit where no pair is allowed: no assignment gains by such a pair
    cost = np.full((len(ends), len(begins)), 2.0 * STITCH_DISTANCE)
    for (i, j), distance in costs.items():
        cost[ends.index(i), begins.index(j)] = distance
    for row, column in zip(*linear_sum_assignment(cost), strict=True):
        pair = (ends[int(row)], begins[int(column)])
        if pair in costs:
            yield pair
