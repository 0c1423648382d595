"""Probability that tracks of two runs over the same events are one object, for overlapping pieces of a log.

Where both runs report a track, the states differ by d with covariance C = P_i + P_j if the tracks are one object, and
d' C^-1 d is small. (The runs share detections there, so the true covariance is smaller, and a pair that is one object
is nearer than this assumes.) The odds of a pair are those of `stereophd.core.trajectories.stitching`, at whose limit D
a pair is as likely one object as two:

    psi_ij = exp((D - m_ij) / 2),

with m_ij the mean squared distance over the events that report either track. The mean replaces the sum because errors
of successive states are not independent. Events near the time of the join count most, and one that reports only one of
the two counts as D. The probability of a pair is its marginal over all ways to pair the tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.trajectories.smoothing import Trajectory
from stereophd.core.trajectories.stitching import STITCH_DISTANCE

# Events that are compared, spread over the overlap, and the largest squared distance that counts of one of them.
MOST_EVENTS = 32
LARGEST = 4.0 * STITCH_DISTANCE


@dataclass(frozen=True)
class JointPairs:
    """Pairs of tracks that may be one object."""

    # `before`, `after`: arrays (k,) of int: Numbers of the trajectories.
    before: Integers
    after: Integers
    probabilities: Array  # (k,): Probability that both are one object


def join_probabilities(
    before: Sequence[Trajectory], after: Sequence[Trajectory], times: Array, at_s: float, decay_s: float
) -> JointPairs:
    """Return the probabilities that tracks of two runs are one object.

    Parameters
    ----------
    before, after : sequences of Trajectory
        Tracks of the two runs in their overlap; their events are numbered alike.
    times : array (n,)
        Times of all events of the overlap, s.
    at_s : float
        Time of the join.
    decay_s : float
        An event this far from the join has the weight 1/e.
    """
    chosen: list[int] = []
    if len(times):
        chosen = np.unique(np.linspace(0, len(times) - 1, MOST_EVENTS).round().astype(np.int64)).tolist()
    shape = (len(before), len(after))
    common, distance, either = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    near = np.zeros(shape, dtype=np.bool_)
    for event in chosen:
        weight = float(np.exp(-abs(times[event] - at_s) / decay_s))
        rows, columns = _places(before, event), _places(after, event)
        i, j = np.flatnonzero(rows >= 0), np.flatnonzero(columns >= 0)
        either[i, :] += weight
        either[:, j] += weight
        if not len(i) or not len(j):
            continue
        either[np.ix_(i, j)] -= weight
        common[np.ix_(i, j)] += weight
        squared = _squared_distances(
            [before[k] for k in i.tolist()], rows[i], [after[k] for k in j.tolist()], columns[j]
        )
        near[np.ix_(i, j)] |= squared < LARGEST
        distance[np.ix_(i, j)] += weight * squared
    first, second = np.nonzero(near & (common > 0.0))
    alone = either - common
    mean = (distance + STITCH_DISTANCE * alone)[first, second] / either[first, second]
    odds = np.exp(0.5 * (STITCH_DISTANCE - mean))
    probabilities, _, _, _ = association_marginals(first, second, odds, *shape)
    return JointPairs(first, second, probabilities)


def _places(trajectories: Sequence[Trajectory], event: int) -> Integers:
    """Return where in each trajectory an event is, -1 where it is not."""
    out = np.full(len(trajectories), -1, dtype=np.int64)
    for number, trajectory in enumerate(trajectories):
        place = int(np.searchsorted(trajectory.events, event))
        if place < len(trajectory.events) and trajectory.events[place] == event:
            out[number] = place
    return out


def _squared_distances(
    before: Sequence[Trajectory], rows: Integers, after: Sequence[Trajectory], columns: Integers
) -> Array:
    """Squared Mahalanobis distances (n, m) of states, at most `LARGEST`."""
    states = np.array([t.states[k] for t, k in zip(before, rows, strict=True)])
    spreads = np.array([t.covariances[k] for t, k in zip(before, rows, strict=True)])
    others = np.array([t.states[k] for t, k in zip(after, columns, strict=True)])
    other_spreads = np.array([t.covariances[k] for t, k in zip(after, columns, strict=True)])
    out = np.full((len(states), len(others)), LARGEST)
    # the distance is at least that along each axis
    axes = slice(0, 3)
    apart = (states[:, None, axes] - others[None, :, axes]) ** 2
    variances = np.diagonal(spreads, axis1=1, axis2=2)[:, None, axes]
    other_variances = np.diagonal(other_spreads, axis1=1, axis2=2)[None, :, axes]
    i, j = np.nonzero((apart <= LARGEST * (variances + other_variances)).all(axis=2))
    if len(i):
        difference = states[i] - others[j]
        # static objects have no velocity to compare: its covariance is zero
        inverse = np.linalg.pinv(spreads[i] + other_spreads[j], hermitian=True)
        out[i, j] = np.minimum(np.einsum("ka,kab,kb->k", difference, inverse, difference), LARGEST)
    return out
