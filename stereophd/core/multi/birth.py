"""Observation-driven birth: every detection may be a new object (paper VI-B, after its reference [18]).

What a detection says about a new object, and what the prior adds to it: `stereophd.core.disparity.initial`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import disparity_moments, initial_moments

Array = NDArray[np.float64]


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
        return disparity_moments(self.disparity, self.depth_range, space)


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
    mean, std = prior.disparity_moments(space)
    return initial_moments(event.points, event.covariances, space, mean, std, prior.velocity_std, size, event.delays)
