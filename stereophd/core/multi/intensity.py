"""Gaussian mixtures over disparity spaces, and what filters return beside their state."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# The fields of a mixture, in order, for compiled code.
Parts = tuple[Array, Array, Array, Integers, Array, Integers, Integers, NDArray[np.bool_]]

# Label of components that stand for objects never detected; identity of labels never reported.
UNLABELLED = -1


@dataclass(frozen=True)
class GaussianMixture:
    """Weighted Gaussians, each in the disparity space of a camera at a time.

    A component is at home in the camera that last had it wholly in view: carried into the image of a
    camera that does not see it, it would be described badly.

    Attributes
    ----------
    weights : array (n,)
        Expected number of objects of each component.
    means, covariances : arrays (n, d), (n, d, d)
        States (u, v, d, du, dv, dd), or (u, v, d) for static objects.
    cameras, times : arrays (n,)
        Home camera (index in the rig) and time, s.
    labels : array (n,) of int
        Components that descend from one detection share its label; -1 for objects never detected.
    tracks : array (n,) of int
        Identity under which the label was first reported, -1 before.
    reported : array (n,) of bool
        Whether the label was reported after the last event.
    """

    weights: Array
    means: Array
    covariances: Array
    cameras: Integers
    times: Array
    labels: Integers
    tracks: Integers
    reported: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def parts(self) -> Parts:
        """The fields, in order: what compiled code takes and returns."""
        return (
            self.weights, self.means, self.covariances, self.cameras, self.times, self.labels, self.tracks,
            self.reported,
        )  # fmt: skip

    def take(self, index: NDArray[np.intp]) -> GaussianMixture:
        """Return the components with these indices."""
        return GaussianMixture(
            self.weights[index],
            self.means[index],
            self.covariances[index],
            self.cameras[index],
            self.times[index],
            self.labels[index],
            self.tracks[index],
            self.reported[index],
        )

    def with_weights(self, weights: Array) -> GaussianMixture:
        """Return the same components with other weights."""
        return GaussianMixture(
            weights,
            self.means,
            self.covariances,
            self.cameras,
            self.times,
            self.labels,
            self.tracks,
            self.reported,
        )


def empty_mixture(size: int) -> GaussianMixture:
    """Return a mixture without components, of states of this size (3 or 6)."""
    integers = np.empty(0, dtype=np.int64)
    return GaussianMixture(
        np.empty(0), np.empty((0, size)), np.empty((0, size, size)), integers, np.empty(0), integers,
        integers, np.empty(0, dtype=np.bool_),
    )  # fmt: skip


def concatenate(parts: list[GaussianMixture]) -> GaussianMixture:
    """Join mixtures."""
    return GaussianMixture(
        *(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(GaussianMixture))
    )


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
    """

    track_ids: Integers
    states: Array
    covariances: Array
    existence: Array
    labels: Integers

    def certain(self, max_position_std: float) -> Estimates:
        """Return the estimates whose position has at most this standard deviation (root of the trace)."""
        variance = np.trace(self.covariances[:, :3, :3], axis1=1, axis2=2)
        return self.take(variance <= max_position_std**2)

    def take(self, kept: NDArray[np.bool_]) -> Estimates:
        """Return some of the estimates, by a mask (k,)."""
        return Estimates(
            self.track_ids[kept],
            self.states[kept],
            self.covariances[kept],
            self.existence[kept],
            self.labels[kept],
        )


@dataclass(frozen=True)
class Info:
    """What a person may want to know of an event.

    Attributes
    ----------
    log_likelihood : float
        Multi-object log-likelihood of the event's detections (paper VII-B), over distorted pixels.
    cardinality_mean : float
        Expected number of objects after the event.
    n_components : int
        Components after reduction.
    detected : array of int
        Labels that the event detected (`stereophd.core.multi.attribution.detected_labels`).
    """

    log_likelihood: float
    cardinality_mean: float
    n_components: int
    detected: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64), compare=False)
