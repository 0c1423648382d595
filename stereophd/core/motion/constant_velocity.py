"""Constant velocity disturbed by white acceleration: `ConstantVelocity`.

The exact discretisation of continuous white acceleration (Y. Bar-Shalom, X. R. Li and T. Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, section 6.2.2). Its noise has one shape for all intervals: with
unit normals W and A the position gains ``dt^1.5 (W / 2 + A / sqrt(12))`` and the velocity ``dt^0.5 W``.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.motion.base import Accelerated, Flow, Noise
from stereophd.core.motion.settings import Acceleration, acceleration_parameter, speed_parameter, stated
from stereophd.core.settings import PositiveLength, parameter, settings

# The factor of [[1 / 3, 1 / 2], [1 / 2, 1]].
POSITION_WITH_VELOCITY = 0.5
POSITION_ALONE = 1.0 / math.sqrt(12.0)


# Keeps the constants for the 64 latest values of `count` that are at most this.
MOST_KEPT = 1024


def _constants(count: int) -> tuple[Array, Array, Array, Array]:
    """Fields of `MotionArrays` that are the same for all intervals: `keep`, `drift`, `with_velocity`, `alone`.

    Read only.
    """
    flags = np.ones(count)
    return flags, np.zeros((count, 6)), POSITION_WITH_VELOCITY * flags, POSITION_ALONE * flags


_kept_constants = lru_cache(maxsize=64)(_constants)


@dataclass(frozen=True)
class ConstantVelocity(Accelerated):
    """Constant velocity disturbed by white acceleration; see `Accelerated` for its fields and errors."""

    def flow(self, dt: Array) -> Flow:
        """Return the mean motion over intervals (...): the velocity stays."""
        return Flow(dt, np.ones(np.shape(dt)), np.zeros((*np.shape(dt), 6)))

    def noise(self, dt: Array) -> Noise:
        """Return |dt|^3 / 3, sign(dt) dt^2 / 2 and |dt|, for intervals (...)."""
        return Noise(abs(dt) ** 3 / 3.0, dt * abs(dt) / 2.0, abs(dt))

    def arrays(self, dt: Array) -> MotionArrays:
        """Return what compiled code reads for intervals (n,): `Motion.arrays`, in a third of its time."""
        std = np.sqrt(abs(dt))
        count = len(dt)
        keep, drift, with_velocity, alone = _kept_constants(count) if count <= MOST_KEPT else _constants(count)
        return MotionArrays(
            dt, keep, std * dt, std, with_velocity, alone, drift, self._noise_std, self.speed_limit
        )  # fmt: skip

    @cached_property
    def _noise_std(self) -> Array:
        return self.noise_std

    def shocks(self, dt: Array, normal: Array) -> tuple[Array, Array]:
        """Return noise of positions and of velocities (n, 3) over intervals (n,), from standard normals (n, 2, 3).

        Given the gain in velocity, that of position has the mean ``dt / 2`` times it and the variance ``dt^3 / 12``.
        """
        density, step = self.noise_std**2, dt[:, None]
        velocity = np.sqrt(density * abs(step)) * normal[:, 0]
        return 0.5 * step * velocity + np.sqrt(density * abs(step) ** 3 / 12) * normal[:, 1], velocity

    def precision(self, dt: Array) -> Array:
        """Return the inverse covariances (n, 2, 2) of unit noise over positive intervals (n,)."""
        inverse = np.empty((len(dt), 2, 2))
        inverse[:, 0, 0] = 12.0 / dt**3
        inverse[:, 0, 1] = inverse[:, 1, 0] = -6.0 / dt**2
        inverse[:, 1, 1] = 4.0 / dt
        return inverse

    def between(self, elapsed: Array, interval: Array) -> tuple[Array, Array]:
        """Return the weights (n, 4) of the cubic through two positions and velocities; offsets (n, 3) of zero.

        With s = elapsed / interval the position is
        ``(1 - 3 s^2 + 2 s^3) p_0 + D (s - 2 s^2 + s^3) v_0 + (3 s^2 - 2 s^3) p_1 + D (s^3 - s^2) v_1``.
        """
        s = elapsed / interval
        weights = np.empty((len(s), 4))
        weights[:, 0] = 1.0 - 3.0 * s**2 + 2.0 * s**3
        weights[:, 1] = interval * (s - 2.0 * s**2 + s**3)
        weights[:, 2] = 3.0 * s**2 - 2.0 * s**3
        weights[:, 3] = interval * (s**3 - s**2)
        return weights, np.zeros((len(s), 3))

    def velocity_between(self, elapsed: Array, interval: Array) -> tuple[Array, Array]:
        """Return the weights (n, 4) of the derivative of the cubic of `between`; offsets (n, 3) of zero."""
        s = elapsed / interval
        bend = 6.0 * (s - s**2) / interval
        weights = np.column_stack([-bend, 1.0 - 4.0 * s + 3.0 * s**2, bend, 3.0 * s**2 - 2.0 * s])
        return weights, np.zeros((len(s), 3))


@settings
class ConstantVelocitySettings:
    """Constant velocity disturbed by white acceleration."""

    model: Literal["constant_velocity"] = parameter("the motion model", default="constant_velocity")
    acceleration_std: Acceleration = acceleration_parameter()
    max_speed: PositiveLength | None = speed_parameter()

    def build(self) -> ConstantVelocity:
        """Return the motion model."""
        return ConstantVelocity(stated(self.acceleration_std), self.max_speed)


SETTINGS = ConstantVelocitySettings
