"""Paths of objects, interval by interval (compiled)."""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled


@compiled
def walk(start: Array, motion: MotionArrays, position_noise: Array, velocity_noise: Array) -> Array:
    """States (n, 6) of one object after each of n successive intervals, from the state `start` (6,).

    `position_noise` and `velocity_noise` (n, 3) are what the noise adds in each interval.
    """
    out = np.empty((len(motion.reach), 6))
    state = start.copy()
    for k in range(len(motion.reach)):
        for a in range(3):
            velocity = state[3 + a]
            state[a] += motion.reach[k] * velocity + position_noise[k, a] + motion.drift[k, a]
            state[3 + a] = motion.keep[k] * velocity + velocity_noise[k, a] + motion.drift[k, 3 + a]
        out[k] = state
    return out
