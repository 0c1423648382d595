"""Fixed-interval smoothing of tracks in the world.

A log is complete: later detections improve earlier states. The Rauch-Tung-Striebel smoother
runs back over the filtered world states of each track, with the motion model of the filter, and continues
past its confirmation to its first detection. Reference: H. E. Rauch, F. Tung and C. T. Striebel, "Maximum
likelihood estimates of linear dynamic systems", AIAA Journal 3 (8), 1965.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.rows import ArrayRows


@dataclass(frozen=True)
class Trajectory(ArrayRows):
    """States of one track at successive events."""

    track_id: int
    events: NDArray[np.int64]  # (k,) of int: Numbers of the events, increasing
    times: Array  # (k,): Their times, s, not decreasing
    # `states`, `covariances`: arrays (k, 6), (k, 6, 6): World states (x, y, z, vx, vy, vz).
    states: Array
    covariances: Array
    existence: Array  # (k,)

    def place(self, event: int) -> int:
        """Return where in the trajectory an event is, -1 where it is not."""
        place = int(np.searchsorted(self.events, event))
        return place if place < len(self.events) and self.events[place] == event else -1


def smooth(trajectory: Trajectory, motion: Motion) -> Trajectory:
    """Return the smoothed trajectory (Rauch, Tung and Striebel 1965) at the same events."""
    states, covariances = trajectory.states.copy(), trajectory.covariances.copy()
    if not motion.moves:
        # what is known at the end holds throughout; the velocity has no covariance to invert
        states[:], covariances[:] = states[-1], covariances[-1]
        return replace(trajectory, states=states, covariances=covariances)
    for k in range(len(states) - 2, -1, -1):
        transition = motion.transition(float(trajectory.times[k + 1] - trajectory.times[k]))
        state, predicted = transition.predict(states[k], covariances[k])
        gain = np.linalg.solve(predicted, transition.matrix @ covariances[k]).T
        states[k] += gain @ (states[k + 1] - state)
        update = gain @ (covariances[k + 1] - predicted) @ gain.T
        covariances[k] += (update + update.T) / 2.0
    return replace(trajectory, states=states, covariances=covariances)


def extend_back(
    trajectory: Trajectory, events: NDArray[np.int64], times: Array, motion: Motion, existence: Array | None = None
) -> Trajectory:
    """Return a smoothed trajectory continued back over events (j,) before its first, in order, by backward prediction.

    The existence at these events is (j,); by default that at the first event of the trajectory.
    """
    if existence is None:
        existence = np.full(len(events), trajectory.existence[0])
    steps = motion.transition(times - trajectory.times[0])
    gaussians = steps.predict(trajectory.states[0], trajectory.covariances[0])
    return Trajectory(trajectory.track_id, events, times, *gaussians, existence).join(trajectory)
