"""Observation-driven birth: every detection may be a new object (paper VI-B, after its reference [18]).

The depth of a new object is drawn from a prior on disparity, its velocity from N(0, sigma^2 I) in the
world. Mapped to disparity space the velocity is

    du = d a_u . v,  dv = d a_v . v,  dd = d^2 a_d . v,      (v in the camera's axes)

with a_u = (fx, 0, cx - u) / s, a_v = (0, fy, cy - v) / s, a_d = (0, 0, -1) / s and s = f b: a polynomial
in the disparity. Its moments under the prior are therefore known in closed form, and the Gaussian
fitted here is the one that infinitely many samples would give. (A diagonal prior in px/s would lose
near, fast objects and make far ones fly.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.disparity.space import BASELINE, VERTICAL
from stereophd.geometry.layout import CX, CY, FX, FY
from stereophd.multi.events import Event

Array = NDArray[np.float64]

# Distance in standard deviations of disparity at which a depth range ends.
DEPTH_RANGE_SIGMAS = 2.0


@dataclass(frozen=True)
class BirthPrior:
    """Prior of new objects.

    Attributes
    ----------
    per_frame : float
        Expected number of new objects a frame, uniform over the image.
    disparity : tuple of float or None
        Mean and standard deviation of the disparity, px.
    depth_range : tuple of float or None
        Instead of `disparity`, near and far depth: two standard deviations either side of the mean.
    velocity_std : float
        Standard deviation of each component of velocity, length/s.
    """

    per_frame: float
    disparity: tuple[float, float] | None
    depth_range: tuple[float, float] | None
    velocity_std: float

    def disparity_moments(self, space: Array) -> tuple[float, float]:
        """Mean and standard deviation of the disparity (px) in a packed space (30,)."""
        if self.disparity is not None:
            return self.disparity
        assert self.depth_range is not None
        scale = float((space[FY] if space[VERTICAL] == 1.0 else space[FX]) * space[BASELINE])
        near, far = scale / self.depth_range[0], scale / self.depth_range[1]
        return (near + far) / 2.0, (near - far) / (2.0 * DEPTH_RANGE_SIGMAS)


def birth_moments(event: Event, space: Array, prior: BirthPrior, size: int) -> tuple[Array, Array]:
    """Gaussians of the objects that the detections of an event may have given birth to.

    Parameters
    ----------
    event : Event
        Detections of one camera.
    space : array (30,)
        Packed space of that camera.
    prior : BirthPrior
        Prior of depth and velocity.
    size : int
        6, or 3 for static objects.

    Returns
    -------
    means, covariances : arrays (m, d), (m, d, d)
        In the camera's disparity space, given the detection.
    """
    count = len(event.points)
    mean, std = prior.disparity_moments(space)
    means = np.zeros((count, size))
    means[:, :2] = event.points
    means[:, 2] = mean
    covariances = np.zeros((count, size, size))
    covariances[:, :2, :2] = event.covariances
    covariances[:, 2, 2] = std**2
    if size == 3:
        return means, covariances
    focal = space[FY] if space[VERTICAL] == 1.0 else space[FX]
    scale = focal * space[BASELINE]
    # rows of the map from camera velocity to (du / d, dv / d, dd / d^2), for every detection
    rows = np.zeros((count, 3, 3))
    rows[:, 0, 0] = space[FX] / scale
    rows[:, 1, 1] = space[FY] / scale
    rows[:, 0, 2] = (space[CX] - event.points[:, 0]) / scale
    rows[:, 1, 2] = (space[CY] - event.points[:, 1]) / scale
    rows[:, 2, 2] = -1.0 / scale
    # E[d^2], E[d^3], E[d^4] of the prior, by the powers of d that each pair of components carries
    second = mean**2 + std**2
    third = mean**3 + 3.0 * mean * std**2
    fourth = mean**4 + 6.0 * mean**2 * std**2 + 3.0 * std**4
    powers = np.array([[second, second, third], [second, second, third], [third, third, fourth]])
    velocity = rows @ np.swapaxes(rows, 1, 2) * prior.velocity_std**2
    velocity = velocity * powers
    covariances[:, 3:, 3:] = velocity
    if event.delays is not None:
        # back from the time of the row to that of the frame: y - delay (du, dv, dd), velocities of mean 0
        delays = event.delays[:, None, None]
        covariances[:, :3, :3] += delays**2 * velocity
        covariances[:, :3, 3:] = covariances[:, 3:, :3] = -delays * velocity
    return means, covariances
