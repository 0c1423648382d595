"""Constant velocity with a steady acceleration along x."""

from typing import Literal

from stereophd.core.motion.ballistic import Ballistic
from stereophd.core.motion.settings import Acceleration, acceleration_parameter, stated
from stereophd.core.settings import NonNegative, parameter, settings


@settings
class WindySettings:
    """Wind from the left."""

    model: Literal["windy"] = parameter("the motion model", default="windy")
    wind: NonNegative = parameter("acceleration along x", default=0.0, unit="length/s^2")
    acceleration_std: Acceleration = acceleration_parameter()

    def build(self) -> Ballistic:
        """Return the motion model."""
        return Ballistic(stated(self.acceleration_std), None, (self.wind, 0.0, 0.0))


SETTINGS = WindySettings
