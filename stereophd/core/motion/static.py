"""The word ``static``: nothing moves."""

from __future__ import annotations

from typing import Literal

from stereophd.core.motion.constant_velocity import PerAxis
from stereophd.core.motion.models import Static
from stereophd.core.settings import Length, PositiveLength, parameter, settings


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
