"""What filters return besides their state: the objects reported, and diagnostics of an event."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.region import are_inside
from stereophd.core.multi.association.attribution import Claims
from stereophd.core.numerics.rows import ArrayRows


@dataclass(frozen=True)
class Estimates(ArrayRows):
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
        return replace(self.take(are_inside(self.states[:, :3], half_spaces)), tentative=tentative)

    def with_tentative(self) -> Estimates:
        """Return confirmed and tentative estimates as one."""
        return self if self.tentative is None else replace(self.join(self.tentative), tentative=None)

    def divided(self, confirmed: int) -> Estimates:
        """Return the first estimates, so many of them, with the others, if there are any, as the tentative ones."""
        if confirmed == len(self.track_ids):
            return self
        return replace(self.take(slice(confirmed)), tentative=self.take(slice(confirmed, None)))


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
    # Detections that were taken as a burst of clutter (`stereophd.core.multi.births.undetected.expected_births`).
    burst: int = field(default=0, compare=False)
    # Hypotheses of tracks beyond the bound on their number (PMB).
    hypotheses_left_out: int = field(default=0, compare=False)
    # Detections that these would have decided: the sum of their weights, each times its share of its track.
    undecided_detections: float = field(default=0.0, compare=False)
    # Total correlation of the tracks after the event, which are taken for independent (PMB), nats.
    forgotten: float = field(default=0.0, compare=False)
