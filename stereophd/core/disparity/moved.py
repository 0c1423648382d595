"""Gaussians before and after they are carried into the disparity space of a camera, in Python and in compiled code."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled

OUT_OF_VIEW, PARTLY_IN_VIEW, IN_VIEW = 0, 1, 2


class Sources(NamedTuple):
    """Gaussians to be carried: where they are, and how their objects move until they arrive."""

    # (n, d), (n, d, d): Gaussians in the disparity spaces of their home cameras; d is 6, or 3 for static objects
    means: Array
    covariances: Array
    homes: Array  # (n, 30): Packed home space of each component (`DisparitySpace.packed`), at the component's time
    intervals: MotionArrays  # The motion in the world from each component's time to the arrival (`Motion.arrays`)


class Moved(NamedTuple):
    """Components carried into the disparity space of one camera at one time."""

    # `means`, `covariances`: arrays (n, d), (n, d, d): The part in view, in the destination's space; only where
    # `status` is not `OUT_OF_VIEW`.
    means: Array
    covariances: Array
    fraction: Array  # (n,): Part of the component that is in view, 0 to 1
    status: NDArray[np.int64]  # (n,) of int: `OUT_OF_VIEW`, `PARTLY_IN_VIEW` or `IN_VIEW`
    # `missed_means`, `missed_covariances`: arrays (n, d), (n, d, d): The part that was not detected, in the space and
    # at the time of origin. Filled only where `status` is `PARTLY_IN_VIEW`, or `OUT_OF_VIEW` with `inside` below 1:
    # the missed part of a component wholly in view has the shape of the whole.
    missed_means: Array
    missed_covariances: Array
    inside: Array  # (n,): Part of the component inside the region; what lies outside is left out of all of the above


def room_for_moved(count: int, size: int) -> Moved:
    """Room for components: all inside the region, none in view."""
    return Moved(
        np.zeros((count, size)), np.zeros((count, size, size)), np.zeros(count), np.zeros(count, dtype=np.int64),
        np.zeros((count, size)), np.zeros((count, size, size)), np.ones(count)
    )  # fmt: skip


# In Python it is faster as it is: a compiled function wraps every array that it returns.
allocate_moved = compiled(room_for_moved)
