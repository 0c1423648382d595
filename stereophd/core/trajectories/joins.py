"""Tracks that are one object: fragments of a run, and the tracks of two runs over the same events.

Two tracks are compared by the squared Mahalanobis distance of their states: of the end of one, predicted over the gap,
and the start of another; or of both where two runs report a track, with covariance C = P_i + P_j. (The runs share
detections there, so the true covariance is smaller, and a pair that is one object is nearer than this assumes.) At the
limit D a pair is as likely one object as two, so that its odds are

    psi_ij = exp((D - m_ij) / 2),

with m_ij the squared distance, for two runs its mean over the events that report either track. The mean replaces the
sum because errors of successive states are not independent. Events near the time of the join count most, and one that
reports only one of the two counts as D. The probability of a pair is its marginal over all ways to pair the tracks; a
pair that is more probable than not is joined.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.motion.base import Motion
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.trajectories.smoothing import Trajectory

# Squared Mahalanobis distance (99 % of a chi-square with 6 degrees of freedom) up to which the end of one
# track and the start of another may be one object.
STITCH_DISTANCE = 16.81
# Two tracks are one object if that is more probable than not.
PROBABLE = 0.5
# Events that are compared, spread over the overlap, and the largest squared distance that counts of one of them.
MOST_EVENTS = 32
LARGEST = 4.0 * STITCH_DISTANCE

# Means (n, 6) and covariances (n, 6, 6) of states.
Gaussians = tuple[Array, Array]


class JointPairs(NamedTuple):
    """Pairs of tracks that may be one object."""

    before: Integers  # (k,), numbers of the trajectories
    after: Integers  # (k,)
    probabilities: Array  # (k,), that both are one object


def stitch(trajectories: Sequence[Trajectory], motion: Motion, max_gap_s: float) -> dict[int, int]:
    """Find tracks that continue others, which end at most `max_gap_s` before: track -> the earlier one it continues."""
    if not trajectories:
        return {}
    starts = np.array([t.times[0] for t in trajectories])
    order = np.argsort(starts, kind="stable")
    starts = starts[order]
    first_events = np.array([trajectories[k].events[0] for k in order])
    states = np.array([trajectories[k].states[0] for k in order])
    covariances = np.array([trajectories[k].covariances[0] for k in order])
    pairs: list[tuple[int, int, float]] = []
    for i, earlier in enumerate(trajectories):
        end_s = float(earlier.times[-1])
        first, last = np.searchsorted(starts, end_s), np.searchsorted(starts, end_s + max_gap_s, side="right")
        soon = np.arange(first, last)[first_events[first:last] > earlier.events[-1]]
        count = len(soon)
        later = motion.transition(starts[soon] - end_s).predict(earlier.states[-1], earlier.covariances[-1])
        every = np.arange(count)
        squared = _squared(later, (states[soon], covariances[soon]), every, every, STITCH_DISTANCE)
        near = np.flatnonzero(squared < STITCH_DISTANCE)
        pairs += zip([i] * len(near), order[soon[near]].tolist(), squared[near].tolist(), strict=True)
    table = np.array(pairs).reshape(-1, 3)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    ends, begins = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    joined = _paired(ends, begins, table[:, 2], (len(trajectories), len(trajectories)))
    rows = zip(*(values.tolist() for values in joined), strict=True)
    return {trajectories[j].track_id: trajectories[i].track_id for i, j, probability in rows if probability > PROBABLE}


def join_probabilities(
    before: Sequence[Trajectory], after: Sequence[Trajectory], times: Array, at_s: float, decay_s: float
) -> JointPairs:
    """Return the probabilities that tracks of two runs, in their overlap, are one object.

    Their events are numbered alike; `times` (n,) are those of all events of the overlap, s. An event `decay_s` from the
    time `at_s` of the join has the weight 1/e.
    """
    chosen: list[int] = []
    if len(times):
        chosen = np.unique(np.linspace(0, len(times) - 1, MOST_EVENTS).round().astype(np.int64)).tolist()
    shape = (len(before), len(after))
    common, distance, either = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    near = np.zeros(shape, dtype=np.bool_)
    for event in chosen:
        weight = float(np.exp(-abs(times[event] - at_s) / decay_s))
        rows, columns = (np.array([one.place(event) for one in run], dtype=np.int64) for run in (before, after))
        i, j = np.flatnonzero(rows >= 0), np.flatnonzero(columns >= 0)
        either[i, :] += weight
        either[:, j] += weight
        if not len(i) or not len(j):
            continue
        either[np.ix_(i, j)] -= weight
        common[np.ix_(i, j)] += weight
        states, others = _at(before, i, rows), _at(after, j, columns)
        pairs = np.indices((len(i), len(j))).reshape(2, -1)
        squared = _squared(states, others, pairs[0], pairs[1], LARGEST).reshape(len(i), len(j))
        near[np.ix_(i, j)] |= squared < LARGEST
        distance[np.ix_(i, j)] += weight * squared
    # a copy: kernels have a form of their own for what NumPy returns, every second number of an array
    first, second = np.array(np.nonzero(near & (common > 0.0)))
    alone = either - common
    mean = (distance + STITCH_DISTANCE * alone)[first, second] / either[first, second]
    return _paired(first, second, mean, shape)


def _paired(first: Integers, second: Integers, squared: Array, shape: tuple[int, int]) -> JointPairs:
    """Return the probabilities of pairs (k,), in order, from their squared distances."""
    probabilities, _, _, _ = association_marginals(first, second, np.exp(0.5 * (STITCH_DISTANCE - squared)), *shape)
    return JointPairs(first, second, probabilities)


def _squared(before: Gaussians, after: Gaussians, i: Integers, j: Integers, most: float) -> Array:
    """Squared Mahalanobis distances (k,) of pairs of states, one of n and one of m Gaussians; at most this."""
    (means, spreads), (others, other_spreads) = before, after
    out = np.full(len(i), most)
    # the distance is at least that along each axis
    axes = np.arange(3)
    variances = spreads[:, axes, axes][i] + other_spreads[:, axes, axes][j]
    near = ((means[i, :3] - others[j, :3]) ** 2 <= most * variances).all(axis=1)
    i, j = i[near], j[near]
    differences = means[i] - others[j]
    # static objects have no velocity to compare: its covariance is zero
    inverse = np.linalg.pinv(spreads[i] + other_spreads[j], hermitian=True)
    out[near] = np.minimum(np.einsum("ka,kab,kb->k", differences, inverse, differences), most)
    return out


def _at(trajectories: Sequence[Trajectory], chosen: Integers, places: Integers) -> Gaussians:
    """Return the states of chosen trajectories, each at its place."""
    pairs = [(trajectories[k], int(places[k])) for k in chosen.tolist()]
    return np.array([t.states[k] for t, k in pairs]), np.array([t.covariances[k] for t, k in pairs])
