"""A motion model for compiled code: a few numbers for each interval."""

from typing import NamedTuple

from stereophd.core.arrays import Array


class MotionArrays(NamedTuple):
    """How n objects move, each over an interval of its own.

    With two independent standard-normal vectors W and A (3,), scaled by `noise_std` on the axes of the world,
    an object at position p with velocity v comes to

        p + reach v + drift_p + position_noise (with_velocity W + alone A),
        keep v + drift_v + velocity_noise W.
    """

    # `reach`, `keep`: arrays (n,): Displacement for each unit of velocity, s, and the part of the velocity that
    # remains.
    reach: Array
    keep: Array
    # `position_noise`, `velocity_noise`, `with_velocity`, `alone`: arrays (n,): Factor of the noise. Where
    # `with_velocity` and `alone` are equal for several objects, their samples share one mixture of W and A.
    position_noise: Array
    velocity_noise: Array
    with_velocity: Array
    alone: Array
    drift: Array  # (n, 6): In the axes of the world
    noise_std: Array  # (3,)
    max_speed: float  # Limit of the speed before the move, length/s; infinity for none
