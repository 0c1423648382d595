"""Observation-driven birth: every detection may be a new object (paper VI-B, after its reference [18]).

What a detection says about a new object, and what the prior adds to it: `stereophd.core.disparity.initial`.
"""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import FirstSight, initial_moments
from stereophd.core.multi.filter_settings.common import BirthPrior


def newborn_prior(space: Array, prior: BirthPrior, region: Array | None) -> FirstSight:
    """Return the prior of the objects that the camera of a packed space (30,) sees for the first time."""
    mean, std = prior.disparity_moments(space)
    limits = np.empty(0) if region is None else region
    return FirstSight(space, float(mean), float(std), float(prior.velocity_std), limits)


def birth_moments(
    event: Event, space: Array, prior: BirthPrior, size: int, region: Array | None = None
) -> tuple[Array, Array]:
    """Gaussians of the objects that the detections of an event may have given birth to, given the detection.

    Means (m, d) and covariances (m, d, d) are in the camera's packed disparity space (30,); `size`, their d, is 6, or 3
    for static objects. In a `region` (r,) (`stereophd.core.disparity.events.Rig.region`), where objects can be, depths
    along a ray are those inside it.
    """
    first = newborn_prior(space, prior, region)
    return initial_moments(event.points, event.covariances, first, size, event.readings(space))
