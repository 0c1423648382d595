"""What filters return besides their state: the objects reported, and diagnostics of an event."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.association.attribution import Claims


@dataclass(frozen=True)
class Estimates:
    """Objects reported after an event, in the world.

    Attributes
    ----------
    track_ids : array (k,) of int
    states : array (k, 6)
        (x, y, z, vx, vy, vz), length and length/s.
    covariances : array (k, 6, 6)
        By moments.
    existence : array (k,)
        Weight (PHD) or probability of existence.
    labels : array (k,) of int
        Labels of the components behind them.
    tentative : Estimates, optional
        Further objects, which are not confirmed; None: there are none.
    """

    track_ids: Integers
    states: Array
    covariances: Array
    existence: Array
    labels: Integers
    tentative: Estimates | None = None

    def certain(self, max_position_std: float) -> Estimates:
        """Return the estimates whose position has at most this standard deviation (root of the trace)."""
        variance = np.trace(self.covariances[:, :3, :3], axis1=1, axis2=2)
        tentative = None if self.tentative is None else self.tentative.certain(max_position_std)
        return replace(self.take(variance <= max_position_std**2), tentative=tentative)

    def with_tentative(self) -> Estimates:
        """Return confirmed and tentative estimates as one."""
        if self.tentative is None:
            return self
        one, other = self, self.tentative
        return Estimates(
            np.concatenate([one.track_ids, other.track_ids]),
            np.concatenate([one.states, other.states]),
            np.concatenate([one.covariances, other.covariances]),
            np.concatenate([one.existence, other.existence]),
            np.concatenate([one.labels, other.labels]),
        )

    def divided(self, confirmed: int) -> Estimates:
        """Return the first estimates, so many of them, with the others as the tentative ones."""
        return Estimates(
            self.track_ids[:confirmed],
            self.states[:confirmed],
            self.covariances[:confirmed],
            self.existence[:confirmed],
            self.labels[:confirmed],
            self.take(slice(confirmed, None)),
        )

    def take(self, kept: NDArray[np.bool_] | slice) -> Estimates:
        """Return some of the estimates, by a mask (k,) or a slice, without the tentative ones."""
        return Estimates(
            self.track_ids[kept],
            self.states[kept],
            self.covariances[kept],
            self.existence[kept],
            self.labels[kept],
        )


@dataclass(frozen=True)
class Info:
    """Diagnostics of an event.

    Attributes
    ----------
    log_likelihood : float
        Multi-object log-likelihood of the event's detections (paper VII-B), over distorted pixels.
    cardinality_mean : float
        Expected number of objects after the event.
    n_components : int
        Components after reduction.
    detected : array of int
        Labels that the event detected (`stereophd.core.multi.association.attribution.detected_labels`).
    claims : Claims, optional
        Which detections they were; None unless `DisparityFilter.claims` is set.
    left_out : int
        Tracks (PMB) or components (PHD) beyond the bound on their number, which left out the least probable ones.
    hypotheses_left_out : int
        Hypotheses of tracks beyond the bound on their number (PMB).
    burst : int
        Detections that were taken as a burst of clutter (`stereophd.core.multi.births.undetected.burst_of`).
    """

    log_likelihood: float
    cardinality_mean: float
    n_components: int
    detected: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64), compare=False)
    claims: Claims | None = field(default=None, compare=False)
    left_out: int = field(default=0, compare=False)
    burst: int = field(default=0, compare=False)
    hypotheses_left_out: int = field(default=0, compare=False)
