"""Objects that stand still: `Static`."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.motion.base import Flow, Motion, Noise
from stereophd.core.motion.settings import PerAxis
from stereophd.core.settings import Length, PositiveLength, parameter, settings


@dataclass(frozen=True)
class Static(Motion):
    """Objects that stand still: the position does not change, even if the state has a velocity.

    In transitions of six states the velocity is carried along untouched, so that they can be inverted and
    covariances keep their rank.
    """

    state_size: ClassVar[int] = 3

    @property
    def noise_std(self) -> Array:
        """Zero (3,): nothing disturbs a static object."""
        return np.zeros(3)

    def flow(self, dt: Array) -> Flow:
        """Return the mean motion over intervals (...): none."""
        return Flow(np.zeros(np.shape(dt)), np.ones(np.shape(dt)), np.zeros((*np.shape(dt), 6)))

    def noise(self, dt: Array) -> Noise:
        """Return zeros, for intervals (...)."""
        nothing = np.zeros(np.shape(dt))
        return Noise(nothing, nothing, nothing)


@settings
class StaticSettings:
    """Objects that stand still."""

    model: Literal["static"] = parameter("the motion model", default="static")
    acceleration_std: Length | PerAxis = parameter(
        "without effect; accepted so that the model alone can be exchanged", default=0.0, unit="length/s^2"
    )
    max_speed: PositiveLength | None = parameter(
        "without effect; accepted so that the model alone can be exchanged", default=None, unit="length/s"
    )

    def build(self) -> Static:
        """Return the motion model."""
        return Static()


SETTINGS = StaticSettings
