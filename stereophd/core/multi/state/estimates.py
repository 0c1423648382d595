"""What filters return besides their state: the objects reported, and diagnostics of an event."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.region import are_inside
from stereophd.core.multi.association.attribution import Claims


@dataclass(frozen=True)
class Estimates:
    """Objects reported after an event, in the world."""

    track_ids: Integers  # (k,) of int
    states: Array  # (k, 6): (x, y, z, vx, vy, vz), length and length/s
    covariances: Array  # (k, 6, 6): By moments
    existence: Array  # (k,): Weight (PHD) or probability of existence
    labels: Integers  # (k,) of int: Labels of the components behind them
    tentative: Estimates | None = None  # Further objects, which are not confirmed; None: there are none
    # (k, 4): Height and width of bodies and their standard deviations, length; None: objects are points
    extents: Array | None = None

    def certain(self, max_position_std: float) -> Estimates:
        """Return the estimates whose position has at most this standard deviation (root of the trace)."""
        variance = np.trace(self.covariances[:, :3, :3], axis1=1, axis2=2)
        tentative = None if self.tentative is None else self.tentative.certain(max_position_std)
        return replace(self.take(variance <= max_position_std**2), tentative=tentative)

    def inside(self, half_spaces: Array) -> Estimates:
        """Return the estimates inside all half-spaces (h, 4)."""
        tentative = None if self.tentative is None else self.tentative.inside(half_spaces)
        return self.take(are_inside(self.states[:, :3], half_spaces), tentative)

    def with_tentative(self) -> Estimates:
        """Return confirmed and tentative estimates as one."""
        if self.tentative is None:
            return self
        names = [name for name, values in vars(self).items() if isinstance(values, np.ndarray)]
        pairs = {name: (getattr(self, name), getattr(self.tentative, name)) for name in names}
        joined: dict[str, Any] = {name: np.concatenate(pair) for name, pair in pairs.items()}
        return Estimates(**joined)

    def divided(self, confirmed: int) -> Estimates:
        """Return the first estimates, so many of them, with the others, if there are any, as the tentative ones."""
        if confirmed == len(self.track_ids):
            return self
        return self.take(slice(confirmed), self.take(slice(confirmed, None)))

    def take(self, kept: NDArray[np.bool_] | slice, tentative: Estimates | None = None) -> Estimates:
        """Return some of the estimates, by a mask (k,) or a slice, with others as the tentative ones."""
        return Estimates(
            self.track_ids[kept],
            self.states[kept],
            self.covariances[kept],
            self.existence[kept],
            self.labels[kept],
            tentative,
            None if self.extents is None else self.extents[kept],
        )


@dataclass(frozen=True)
class Info:
    """Diagnostics of an event."""

    log_likelihood: float  # Multi-object log-likelihood of the event's detections (paper VII-B), over distorted pixels
    cardinality_mean: float  # Expected number of objects after the event
    n_components: int  # Components after reduction
    # Labels that the event detected (`stereophd.core.multi.association.attribution.detected_labels`).
    detected: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64), compare=False)
    # Which detections they were; None unless `DisparityFilter.claims` is set.
    claims: Claims | None = field(default=None, compare=False)
    # Tracks (PMB) or components (PHD) beyond the bound on their number, which left out the least probable ones.
    left_out: int = field(default=0, compare=False)
    # Detections that were taken as a burst of clutter (`stereophd.core.multi.births.undetected.burst_of`).
    burst: int = field(default=0, compare=False)
    # Hypotheses of tracks beyond the bound on their number (PMB).
    hypotheses_left_out: int = field(default=0, compare=False)
