"""A velocity that decays while white acceleration feeds it: `DampedVelocity`.

The velocity is an Ornstein-Uhlenbeck process, ``dv = -v / T dt + dW``, the position its integral: animals that turn,
drones that hover. Left alone its standard deviation on each axis comes to ``acceleration_std sqrt(T / 2)``. Exact
discretisation: X. R. Li and V. P. Jilkov, "Survey of maneuvering target tracking, part I: dynamic models", IEEE Trans.
Aerospace and Electronic Systems 39 (4), 2003 (there one derivative higher, as R. A. Singer's model of acceleration).
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.motion.base import Accelerated, Flow, Noise
from stereophd.core.motion.settings import Acceleration, acceleration_parameter, speed_parameter, stated
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.settings import PositiveDuration, PositiveLength, parameter, settings

# Backward over more time constants the uncertainty leaves the range of numbers.
MOST_TIME_CONSTANTS = 50.0
# Below this part of the time constant the variance of the position is summed as a series: its closed form cancels.
SERIES_BELOW = 0.5
# Coefficients of x^3, x^4, ... of x - (1 - e^-x) - (1 - e^-x)^2 / 2.
SERIES = np.array([(-1.0) ** n * (2.0 - 2.0 ** (n - 1)) / math.factorial(n) for n in range(3, 20)])


@dataclass(frozen=True)
class DampedVelocity(Accelerated):
    """Velocity that decays with a time constant, disturbed by white acceleration; see `Accelerated`.

    `time_constant_s` is the time after which 1/e of the velocity remains; ValueError if it is not positive.
    """

    time_constant_s: float = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.time_constant_s > 0.0:
            raise ValueError(f"motion: expected a positive time_constant_s, found {self.time_constant_s}")

    def flow(self, dt: Array) -> Flow:
        """Return the mean motion over intervals (...): e^-x of the velocity remains, x in time constants."""
        x = self._time_constants(dt)
        reach = -self.time_constant_s * np.expm1(-x)
        return Flow(reach, np.exp(-x), np.zeros((*np.shape(dt), 6)))

    def noise(self, dt: Array) -> Noise:
        """Return the covariance of unit noise over intervals (...).

        With x in time constants T and e = 1 - e^-x: ``T^3 (x - e - e^2 / 2)``, ``T^2 e^2 / 2`` and
        ``T (1 - e^-2x) / 2``, backward with the signs of a covariance.
        """
        x, scale = self._time_constants(dt), self.time_constant_s
        position, cross, velocity = unit_noise(x.ravel()).reshape(3, *np.shape(dt))
        return Noise(scale**3 * position, scale**2 * cross, scale * velocity)

    def _time_constants(self, dt: Array) -> Array:
        return np.maximum(np.asarray(dt) / self.time_constant_s, -MOST_TIME_CONSTANTS)


@compiled
def unit_noise(x: Array) -> Array:
    """Return the noise (3, n) of position, of both and of velocity after x (n,) time constants, for T = 1."""
    out = np.empty((3, len(x)))
    for n in range(len(x)):
        e = -np.expm1(-x[n])
        if abs(x[n]) < SERIES_BELOW:
            position = 0.0
            for coefficient in SERIES[::-1]:
                position = coefficient + x[n] * position
            position *= x[n] ** 3
        else:
            position = x[n] - e - e**2 / 2.0
        out[0, n], out[1, n], out[2, n] = abs(position), np.sign(x[n]) * e**2 / 2.0, abs(np.expm1(-2.0 * x[n])) / 2.0
    return out


@settings
class DampedVelocitySettings:
    """A velocity that decays while white acceleration feeds it: animals that turn, drones that hover."""

    model: Literal["damped_velocity"] = parameter("the motion model", default="damped_velocity")
    time_constant_s: PositiveDuration = parameter(
        "time after which 1/e of the velocity remains",
        unit="s",
        advice="the time after which the velocity of an object no longer depends on its earlier velocity. Its speed on "
        "each axis settles at acceleration_std sqrt(time_constant_s / 2).",
    )
    acceleration_std: Acceleration = acceleration_parameter()
    max_speed: PositiveLength | None = speed_parameter()

    def build(self) -> DampedVelocity:
        """Return the motion model."""
        return DampedVelocity(stated(self.acceleration_std), self.max_speed, time_constant_s=self.time_constant_s)


SETTINGS = DampedVelocitySettings
