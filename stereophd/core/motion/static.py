"""Objects that stand still: `Static`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stereophd.core.motion.base import Flow, Motion, Noise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Static(Motion):
    """Objects that stand still: the position stays what it is, whatever the velocity says.

    In transitions of six states the velocity is carried along untouched, so that they can be inverted and
    covariances keep their rank.
    """

    name: ClassVar[str] = "static"
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
