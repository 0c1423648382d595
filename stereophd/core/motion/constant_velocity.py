"""The word ``constant_velocity``: constant velocity disturbed by white acceleration."""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereophd.core.motion.models import ConstantVelocity
from stereophd.core.settings import Length, PositiveLength, parameter, settings

PerAxis = tuple[Length, Length, Length]


@settings
class ConstantVelocitySettings:
    """Constant velocity disturbed by white acceleration."""

    model: Literal["constant_velocity"] = parameter("the motion model", default="constant_velocity")
    acceleration_std: Length | PerAxis = parameter(
        "white acceleration in the world, one value or one per axis: standard deviation of the mean acceleration "
        "over 1 s (spectral density acceleration_std^2 times 1 s)",
        default=0.0,
        unit="length/s^2",
    )
    max_speed: PositiveLength | None = parameter(
        "physical limit on speed; samples above it are scaled back to it", default=None, unit="length/s"
    )

    def build(self) -> ConstantVelocity:
        """Return the motion model."""
        std = np.broadcast_to(np.asarray(self.acceleration_std, dtype=float), 3)
        return ConstantVelocity(std, self.max_speed)


SETTINGS = ConstantVelocitySettings
