"""Components of a mixture in compiled code: allocation and copies of `stereophd.core.multi.intensity.Parts`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.multi.intensity import UNLABELLED, Parts
from stereophd.core.numerics.compilation import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@compiled
def allocate_parts(count: int, size: int) -> Parts:
    """Room for components: without identity and never reported, else not filled in."""
    return (
        np.empty(count), np.empty((count, size)), np.empty((count, size, size)), np.empty(count, dtype=np.int64),
        np.empty(count), np.empty(count, dtype=np.int64), np.full(count, UNLABELLED),
        np.zeros(count, dtype=np.bool_),
    )  # fmt: skip


@compiled
def copy_gaussian(means: Array, covariances: Array, k: int, to_means: Array, to_covariances: Array, i: int) -> None:
    """Copy mean and covariance k to place i (in loops: compiled, assigning slices takes five times as long)."""
    size = means.shape[1]
    for a in range(size):
        to_means[i, a] = means[k, a]
        for b in range(size):
            to_covariances[i, a, b] = covariances[k, a, b]


@compiled
def copy_parts(parts: Parts, index: Integers, out: Parts, start: int) -> None:
    """Copy the components with these indices to `out`, from place `start` on.

    In loops over unpacked arrays: each fetch of an array from a tuple, each row as an array of its own, counts a
    reference up and down, which costs more than the row.
    """
    weights, means, covariances, cameras, times, labels, tracks, reported = parts
    to_weights, to_means, to_covariances, to_cameras, to_times, to_labels, to_tracks, to_reported = out
    size = means.shape[1]
    for i in range(len(index)):
        k, place = index[i], start + i
        to_weights[place], to_cameras[place], to_times[place] = weights[k], cameras[k], times[k]
        to_labels[place], to_tracks[place], to_reported[place] = labels[k], tracks[k], reported[k]
        for a in range(size):
            to_means[place, a] = means[k, a]
            for b in range(size):
                to_covariances[place, a, b] = covariances[k, a, b]


@compiled
def take_parts(parts: Parts, index: Integers) -> Parts:
    """Return the components with these indices."""
    out = allocate_parts(len(index), parts[1].shape[1])
    copy_parts(parts, index, out, 0)
    return out


@compiled
def slice_parts(parts: Parts, first: int, last: int) -> Parts:
    """Return views of consecutive components."""
    return (
        parts[0][first:last], parts[1][first:last], parts[2][first:last], parts[3][first:last],
        parts[4][first:last], parts[5][first:last], parts[6][first:last], parts[7][first:last],
    )  # fmt: skip
