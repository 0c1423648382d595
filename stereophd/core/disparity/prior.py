"""Settings of the prior of an object's depth and velocity, which its first detection does not measure."""

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.space import BASELINE, VERTICAL
from stereophd.core.geometry.layout import FX, FY
from stereophd.core.settings import PositiveLength, PositivePixels, parameter, settings

# Distance in standard deviations of disparity at which a depth range ends.
DEPTH_RANGE_SIGMAS = 2.0


@settings
class DisparityPrior:
    """Gaussian prior of the disparity of a new object."""

    mean_px: PositivePixels = parameter("mean at the baseline", unit="px")
    std_px: PositivePixels = parameter("standard deviation at the baseline", unit="px")


DepthRange = tuple[PositiveLength, PositiveLength]


class DepthPrior:
    """What is known of the depth of a new object: its disparity, or a range; a base of settings that have both."""

    disparity: DisparityPrior | None
    depth_range: DepthRange | None

    def check_depth(self) -> None:
        """Raise ValueError unless exactly one of disparity and depth_range is given, and a range is near < far."""
        if (self.disparity is None) == (self.depth_range is None):
            raise ValueError("expected exactly one of disparity and depth_range")
        if self.depth_range is not None and self.depth_range[0] >= self.depth_range[1]:
            raise ValueError(f"depth_range: expected near < far, found {list(self.depth_range)}")

    def disparity_moments(self, space: Array) -> tuple[float, float]:
        """Mean and standard deviation of the disparity (px) in a packed space (30,)."""
        if self.disparity is not None:
            return self.disparity.mean_px, self.disparity.std_px
        if self.depth_range is None:
            raise ValueError("expected exactly one of disparity and depth_range, found none")
        scale = float((space[FY] if space[VERTICAL] == 1.0 else space[FX]) * space[BASELINE])
        near, far = scale / self.depth_range[0], scale / self.depth_range[1]
        return (near + far) / 2.0, (near - far) / (2.0 * DEPTH_RANGE_SIGMAS)


@settings
class InitialPrior(DepthPrior):
    """The prior of an object that a camera sees for the first time (paper V-A)."""

    disparity: DisparityPrior | None = parameter("prior of the disparity, px at the baseline", default=None)
    depth_range: DepthRange | None = parameter(
        "near and far depth: two standard deviations either side in disparity", unit="length", default=None
    )
    velocity_std: PositiveLength | None = parameter(
        "standard deviation of each component of velocity in the world", unit="length/s", default=None
    )
    disparity_velocity_std_px_s: tuple[PositivePixels, PositivePixels, PositivePixels] | None = parameter(
        "instead, standard deviations of the rates of u, v and d", unit="px/s", default=None
    )

    def __post_init__(self) -> None:
        self.check_depth()
        if self.velocity_std is not None and self.disparity_velocity_std_px_s is not None:
            raise ValueError("expected one of velocity_std and disparity_velocity_std_px_s, found both")

    @property
    def velocity_spread(self) -> float:
        """`velocity_std`, 0 where it is not given: length/s."""
        return self.velocity_std or 0.0

    def moments(self, points: Array, noises: Array, space: Array, size: int) -> tuple[Array, Array]:
        """Means (m, d) and covariances (m, d, d) of objects first seen at `points`: see `initial_moments`."""
        # imported here: the settings are read without a compiler
        from stereophd.core.disparity.initial import FirstSight, initial_moments
        from stereophd.core.disparity.rolling import NO_READINGS

        mean, std = self.disparity_moments(space)
        prior = FirstSight(space, float(mean), float(std), self.velocity_spread, np.empty(0))
        means, covariances = initial_moments(points, noises, prior, size, NO_READINGS)
        if size == 6 and self.disparity_velocity_std_px_s is not None:
            covariances[:, 3:, 3:] = np.diag(np.square(self.disparity_velocity_std_px_s))
        return means, covariances
