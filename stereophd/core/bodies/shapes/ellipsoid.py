"""Objects that are ellipsoids of revolution about the vertical, or spheres (``object.shape: ellipsoid``)."""

import math
from typing import Literal

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.settings import Fraction, NonNegative, Positive, PositiveLength, Vector3, parameter, settings

# Share of its extent by which a sphere may differ from one: the two half axes then share one value.
SPHERE_TOLERANCE = 1e-3


@settings
class Extent:
    """An extent that differs between objects: the logarithm is normal."""

    mean: PositiveLength = parameter("mean over the objects", unit="length")
    std: PositiveLength = parameter("standard deviation over the objects", unit="length")

    @property
    def log_moments(self) -> tuple[float, float]:
        """Mean and standard deviation of the logarithm of half the extent."""
        variance = math.log1p((self.std / self.mean) ** 2)
        return math.log(self.mean / 2.0) - variance / 2.0, math.sqrt(variance)


@settings
class Ground:
    """The plane, normal to ``up``, on which objects stand."""

    point: Vector3 = parameter("a point of the plane", unit="length")
    std: PositiveLength = parameter(
        "standard deviation of the height of the lowest point of an object over the plane",
        unit="length",
        advice="how uneven the ground is, and by how much objects bend or step.",
    )


@settings
class EllipsoidSettings:
    """Objects that are ellipsoids: the detections are their boxes."""

    shape: Literal["ellipsoid"] = parameter("the shape", default="ellipsoid")
    height: Extent = parameter("extent along up; the diameter of spheres")
    width: Extent | None = parameter("extent across; left out for spheres", default=None)
    up: Vector3 | None = parameter(
        "the direction of the height; left out: objects are spheres", default=None, advice="[0, -1, 0] where y is down."
    )
    ground: Ground | None = parameter("the plane on which objects stand; left out: nothing stands", default=None)
    hidden_loss: Fraction = parameter(
        "share of the probability of detection that an object loses when nearer ones hide it whole: p_detect (1 - "
        "hidden_loss o^hidden_power), where o is the hidden share of its box; 0: hidden objects are seen as others",
        default=0.7,
        advice="0.5 for detectors that were trained on crowds, 0.7 for others.",
    )
    hidden_power: Positive = parameter("exponent of the hidden share: see hidden_loss", default=2.5)
    instant_s: NonNegative = parameter(
        "frames of different cameras within this time are associated jointly; 0: each by itself", unit="s", default=0.02
    )

    def __post_init__(self) -> None:
        if (self.up is None) != (self.width is None):
            raise ValueError("expected width and up, or neither of them (spheres), found one")
        if self.up is None and self.ground is not None:
            raise ValueError("expected up where objects stand on the ground, found none")
        if self.up is not None and not any(self.up):
            raise ValueError("up: expected a direction, found [0, 0, 0]")

    @property
    def direction(self) -> Array:
        """Unit vector (3,) of the height; any for spheres."""
        vector = np.array((0.0, 0.0, 1.0) if self.up is None else self.up)
        return np.asarray(vector / np.linalg.norm(vector))

    def log_axes(self) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of the logarithms of the half axes along and across `direction`."""
        mean, std = self.height.log_moments
        if self.width is None:
            covariance = np.full((2, 2), std**2) + np.diag([0.0, SPHERE_TOLERANCE**2])
            return np.array([mean, mean]), covariance
        across, across_std = self.width.log_moments
        return np.array([mean, across]), np.diag([std**2, across_std**2])


SETTINGS = EllipsoidSettings
