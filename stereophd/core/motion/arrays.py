"""What compiled code reads of a motion model: a few numbers for each interval."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.numerics.compilation import compiled

Array = NDArray[np.float64]


class MotionArrays(NamedTuple):
    """How n objects move, each over an interval of its own.

    With two independent standard-normal vectors W and A (3,), scaled by `noise_std` on the axes of the world,
    an object at position p with velocity v comes to

        p + reach v + drift_p + position_noise (with_velocity W + alone A),
        keep v + drift_v + velocity_noise W.

    Attributes
    ----------
    reach, keep : arrays (n,)
        Displacement for each unit of velocity, s, and the part of the velocity that remains.
    position_noise, velocity_noise, with_velocity, alone : arrays (n,)
        Factor of the noise. Where `with_velocity` and `alone` are equal for several objects, their samples share one
        mixture of W and A.
    drift : array (n, 6)
        In the axes of the world.
    noise_std : array (3,)
    max_speed : float
        Limit of the speed before the move, length/s; infinity for none.
    """

    reach: Array
    keep: Array
    position_noise: Array
    velocity_noise: Array
    with_velocity: Array
    alone: Array
    drift: Array
    noise_std: Array
    max_speed: float


@compiled
def slice_motion(motion: MotionArrays, first: int, last: int) -> MotionArrays:
    """Return views of consecutive intervals."""
    return MotionArrays(
        motion.reach[first:last], motion.keep[first:last], motion.position_noise[first:last],
        motion.velocity_noise[first:last], motion.with_velocity[first:last], motion.alone[first:last],
        motion.drift[first:last], motion.noise_std, motion.max_speed,
    )  # fmt: skip


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
