"""Gaussian mixtures over disparity spaces: one named tuple, the same in Python and in compiled code."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import copy_gaussian, picked, stable_order

# Identity of labels that were never reported.
UNREPORTED = -1


class GaussianMixture(NamedTuple):
    """Weighted Gaussians, each in the disparity space of a camera at a time.

    A component is at home in the camera that last had it wholly in view: carried into the image of a
    camera that does not see it, it would be described badly.

    In compiled loops the arrays are unpacked first: each fetch of an array from a tuple counts a reference up and
    down, which costs more than reading a row.
    """

    weights: Array  # (n,): Expected number of objects of each component
    # `means`, `covariances`: arrays (n, d), (n, d, d): States (u, v, d, du, dv, dd), or (u, v, d) for static objects.
    means: Array
    covariances: Array
    # `cameras`, `times`: arrays (n,): Home camera (index in the rig) and time, s.
    cameras: Integers
    times: Array
    # (n,) of int: Components that descend from one detection share its label.
    labels: Integers
    tracks: Integers  # (n,) of int: Identity under which the label was first reported, -1 before
    reported: NDArray[np.bool_]  # (n,) of bool: Whether the label was reported after the last event

    @property
    def size(self) -> int:
        """Number of components (`len` of the tuple is the number of its fields)."""
        return len(self.weights)

    def take(self, index: Integers) -> "GaussianMixture":
        """Return the components with these indices."""
        return GaussianMixture._make(values[index] for values in self)

    def with_weights(self, weights: Array) -> "GaussianMixture":
        """Return the same components with other weights."""
        # `_replace` takes longer
        return GaussianMixture(weights, *self[1:])


def empty_mixture(size: int) -> GaussianMixture:
    """Return a mixture without components, of states of this size (3 or 6)."""
    integers = np.empty(0, dtype=np.int64)
    return GaussianMixture(
        np.empty(0), np.empty((0, size)), np.empty((0, size, size)), integers, np.empty(0), integers,
        integers, np.empty(0, dtype=np.bool_)
    )  # fmt: skip


def concatenate(mixtures: list[GaussianMixture]) -> GaussianMixture:
    """Join mixtures."""
    return GaussianMixture(*(np.concatenate(values) for values in zip(*mixtures, strict=True)))


@compiled
def allocate_mixture(count: int, size: int) -> GaussianMixture:
    """Room for components: without identity and never reported, else not filled in."""
    return GaussianMixture(
        np.empty(count), np.empty((count, size)), np.empty((count, size, size)), np.empty(count, dtype=np.int64),
        np.empty(count), np.empty(count, dtype=np.int64), np.full(count, UNREPORTED),
        np.zeros(count, dtype=np.bool_)
    )  # fmt: skip


@compiled
def copy_components(mixture: GaussianMixture, index: Integers, out: GaussianMixture, start: int) -> None:
    """Copy the components with these indices to `out`, from place `start` on."""
    weights, means, covariances, cameras, times, labels, tracks, reported = mixture
    to_weights, to_means, to_covariances, to_cameras, to_times, to_labels, to_tracks, to_reported = out
    for i in range(len(index)):
        k, place = index[i], start + i
        to_weights[place], to_cameras[place], to_times[place] = weights[k], cameras[k], times[k]
        to_labels[place], to_tracks[place], to_reported[place] = labels[k], tracks[k], reported[k]
        copy_gaussian(means, covariances, k, to_means, to_covariances, place)


@compiled
def take_components(mixture: GaussianMixture, index: Integers) -> GaussianMixture:
    """Return the components with these indices."""
    out = allocate_mixture(len(index), mixture.means.shape[1])
    copy_components(mixture, index, out, 0)
    return out


@compiled
def slice_components(mixture: GaussianMixture, first: int, last: int) -> GaussianMixture:
    """Return views of consecutive components."""
    return GaussianMixture(
        mixture.weights[first:last], mixture.means[first:last], mixture.covariances[first:last],
        mixture.cameras[first:last], mixture.times[first:last], mixture.labels[first:last],
        mixture.tracks[first:last], mixture.reported[first:last]
    )  # fmt: skip


@compiled
def order_by_label(weights: Array, labels: Integers) -> Integers:
    """Components by label and then by falling weight; most often they are in this order."""
    order = np.arange(len(labels))
    for i in range(1, len(order)):
        before, k = order[i - 1], order[i]
        if labels[k] < labels[before] or (labels[k] == labels[before] and weights[k] > weights[before]):
            order = picked(order, stable_order(-picked(weights, order)))
            return picked(order, stable_order(picked(labels, order)))
    return order
