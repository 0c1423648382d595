"""Fixed-interval smoothing of tracks in the world, and the stitching of broken pieces.

A log is offline: what a camera saw later says where an object was before. The Rauch-Tung-Striebel smoother
runs back over the filtered world states of each track, with the motion model of the filter, and goes on
past its confirmation to its first detection. Reference: H. E. Rauch, F. Tung and C. T. Striebel, "Maximum
likelihood estimates of linear dynamic systems", AIAA Journal 3 (8), 1965.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.motion import Motion, Static

Array = NDArray[np.float64]

# Squared Mahalanobis distance (99 % of a chi-square with 6 degrees of freedom) up to which the end of one
# track and the start of another may be one object.
STITCH_DISTANCE = 16.81


@dataclass(frozen=True)
class Trajectory:
    """States of one track at successive events.

    Attributes
    ----------
    track_id : int
    events : array (k,) of int
        Numbers of the events, increasing.
    times : array (k,)
        Their times, s, not decreasing.
    states, covariances : arrays (k, 6), (k, 6, 6)
        World states (x, y, z, vx, vy, vz).
    existence : array (k,)
    """

    track_id: int
    events: NDArray[np.int64]
    times: Array
    states: Array
    covariances: Array
    existence: Array


def smooth(trajectory: Trajectory, motion: Motion) -> Trajectory:
    """Return the smoothed trajectory (Rauch, Tung and Striebel 1965) at the same events."""
    states, covariances = trajectory.states.copy(), trajectory.covariances.copy()
    if isinstance(motion, Static):
        # what is known at the end holds throughout; the velocity has no covariance to invert
        states[:], covariances[:] = states[-1], covariances[-1]
        return replace(trajectory, states=states, covariances=covariances)
    for k in range(len(states) - 2, -1, -1):
        matrix, noise = motion.transition(float(trajectory.times[k + 1] - trajectory.times[k]))
        predicted = matrix @ covariances[k] @ matrix.T + noise
        gain = np.linalg.solve(predicted, matrix @ covariances[k]).T
        states[k] += gain @ (states[k + 1] - matrix @ states[k])
        update = gain @ (covariances[k + 1] - predicted) @ gain.T
        covariances[k] += (update + update.T) / 2.0
    return replace(trajectory, states=states, covariances=covariances)


def extend_back(
    trajectory: Trajectory, events: NDArray[np.int64], times: Array, motion: Motion, existence: Array | None = None
) -> Trajectory:
    """Return the trajectory continued back over earlier events, by backward prediction.

    Parameters
    ----------
    trajectory : Trajectory
        Smoothed.
    events, times : arrays (j,)
        Events before its first, in order.
    motion : Motion
    existence : array (j,), optional
        At these events; default that at its first.
    """
    if existence is None:
        existence = np.full(len(events), trajectory.existence[0])
    states = np.empty((len(events), 6))
    covariances = np.empty((len(events), 6, 6))
    for k, time_s in enumerate(times):
        matrix, noise = motion.transition(float(time_s - trajectory.times[0]))
        states[k] = matrix @ trajectory.states[0]
        covariances[k] = matrix @ trajectory.covariances[0] @ matrix.T + noise
    return Trajectory(
        trajectory.track_id,
        np.concatenate([events, trajectory.events]),
        np.concatenate([times, trajectory.times]),
        np.concatenate([states, trajectory.states]),
        np.concatenate([covariances, trajectory.covariances]),
        np.concatenate([existence, trajectory.existence]),
    )


def stitch(trajectories: Sequence[Trajectory], motion: Motion, max_gap_s: float) -> dict[int, int]:
    """Find tracks that continue others.

    The end of a track, predicted over the gap, is compared with the start of each track that begins at
    most `max_gap_s` later; pairs are chosen jointly, at the least total squared Mahalanobis distance.

    Returns
    -------
    dict
        Track -> the earlier track that it continues, for those that do.
    """
    from scipy.optimize import linear_sum_assignment

    count = len(trajectories)
    # twice the limit where no pair is allowed: no assignment gains by such a pair
    cost = np.full((count, count), 2.0 * STITCH_DISTANCE)
    starts = np.array([t.times[0] for t in trajectories])
    first_events = np.array([t.events[0] for t in trajectories])
    for i, earlier in enumerate(trajectories):
        gaps = starts - earlier.times[-1]
        after = (first_events > earlier.events[-1]) & (gaps >= 0.0) & (gaps <= max_gap_s)
        for j in np.flatnonzero(after):
            matrix, noise = motion.transition(float(gaps[j]))
            later = trajectories[int(j)]
            difference = later.states[0] - matrix @ earlier.states[-1]
            covariance = matrix @ earlier.covariances[-1] @ matrix.T + noise + later.covariances[0]
            # static objects have no velocity to compare: its covariance is zero
            distance = float(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference)
            if distance <= STITCH_DISTANCE:
                cost[i, j] = distance
    rows, columns = linear_sum_assignment(cost)
    return {
        trajectories[j].track_id: trajectories[i].track_id
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
        if cost[i, j] <= STITCH_DISTANCE
    }
