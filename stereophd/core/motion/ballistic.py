"""Free fall disturbed by white acceleration: `Ballistic`. Balls and other objects thrown; there is no drag."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.motion.base import Flow
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.settings import Acceleration, acceleration_parameter, speed_parameter, stated
from stereophd.core.settings import PositiveLength, Vector3, parameter, settings


@dataclass(frozen=True)
class Ballistic(ConstantVelocity):
    """`ConstantVelocity` under a constant known acceleration: gravity (3,), axes of the world, length/s^2.

    Interpolation between two states needs no term for it: a cubic through two states of a parabola is the parabola. The
    noise covers other accelerations, such as drag. Raises ValueError if gravity is not three finite numbers; otherwise
    as `ConstantVelocity`.
    """

    gravity: ArrayLike = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        gravity = np.asarray(self.gravity, dtype=np.float64)
        if gravity.shape != (3,) or not np.isfinite(gravity).all():
            raise ValueError(f"motion: expected three finite numbers as gravity, found {self.gravity!r}")
        object.__setattr__(self, "gravity", tuple(gravity.tolist()))

    def flow(self, dt: Array) -> Flow:
        """Return the mean motion over intervals (...): a parabola."""
        reach, keep, _ = super().flow(dt)
        gravity, time = np.asarray(self.gravity), np.asarray(dt)[..., None]
        return Flow(reach, keep, np.concatenate([0.5 * time**2 * gravity, time * gravity], axis=-1))

    def arrays(self, dt: Array) -> MotionArrays:
        """Return what compiled code reads for intervals (n,)."""
        return super().arrays(dt)._replace(drift=self.flow(dt).drift)


@settings
class BallisticSettings:
    """Free fall disturbed by white acceleration: balls and other objects thrown."""

    model: Literal["ballistic"] = parameter("the motion model", default="ballistic")
    gravity: Vector3 = parameter(
        "gravity in the axes of the world",
        unit="length/s^2",
        advice="[0, 9.81, 0] where the unit of length is m and y points down. Calibration takes it as exact: it then "
        "measures the scale of the scene.",
    )
    acceleration_std: Acceleration = acceleration_parameter()
    max_speed: PositiveLength | None = speed_parameter()

    def build(self) -> Ballistic:
        """Return the motion model."""
        return Ballistic(stated(self.acceleration_std), self.max_speed, self.gravity)


SETTINGS = BallisticSettings
