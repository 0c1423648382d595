"""Likelihoods of all plausible pairs of a component and a detection, and Kalman updates of pairs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stereophd.compilation import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Pairs further apart than this many standard deviations in u have a likelihood below 1e-17 of the
# peak: leaving them out changes nothing, and detections ordered by u make finding the others cheap.
REACH_SIGMAS = 9.0


@compiled
def pair_likelihoods(
    means: Array, covariances: Array, seen: NDArray[np.bool_], points: Array, noises: Array, areas: Array
) -> tuple[Integers, Integers, Array]:
    """Predicted density N(z; H m, H P H^T + R) of every pair within reach, eq. (4) and (5).

    Parameters
    ----------
    means, covariances : arrays (n, d), (n, d, d)
        Components in the disparity space of the camera.
    seen : array (n,) of bool
        Components to consider.
    points, noises, areas : arrays (m, 2), (m, 2, 2), (m,)
        Detections of an `Event`, ordered by u.

    Returns
    -------
    components, detections : arrays (p,) of int
        Pairs, ordered by component and then by detection.
    densities : array (p,)
        Per distorted pixel area.
    """
    largest = 0.0
    for j in range(len(points)):
        largest = max(largest, noises[j, 0, 0])
    count = len(means)
    low = np.zeros(count, dtype=np.int64)
    high = np.zeros(count, dtype=np.int64)
    total = 0
    column = points[:, 0].copy()
    for k in range(count):
        if seen[k]:
            reach = REACH_SIGMAS * math.sqrt(covariances[k, 0, 0] + largest)
            low[k] = np.searchsorted(column, means[k, 0] - reach)
            high[k] = np.searchsorted(column, means[k, 0] + reach)
            total += high[k] - low[k]
    components = np.empty(total, dtype=np.int64)
    detections = np.empty(total, dtype=np.int64)
    densities = np.empty(total)
    found = 0
    for k in range(count):
        for j in range(low[k], high[k]):
            s00 = covariances[k, 0, 0] + noises[j, 0, 0]
            s01 = covariances[k, 0, 1] + noises[j, 0, 1]
            s11 = covariances[k, 1, 1] + noises[j, 1, 1]
            determinant = s00 * s11 - s01 * s01
            du = points[j, 0] - means[k, 0]
            dv = points[j, 1] - means[k, 1]
            squared = (s11 * du * du - 2.0 * s01 * du * dv + s00 * dv * dv) / determinant
            if squared > REACH_SIGMAS * REACH_SIGMAS:
                continue
            components[found] = k
            detections[found] = j
            densities[found] = areas[j] * math.exp(-0.5 * squared) / (2.0 * math.pi * math.sqrt(determinant))
            found += 1
    return components[:found], detections[:found], densities[:found]


@compiled
def kalman_updates(
    means: Array, covariances: Array, components: Integers, detections: Integers, points: Array, noises: Array
) -> tuple[Array, Array]:
    """Kalman update of each pair with H = [I_2 0] (eq. 4).

    Returns means (p, d) and covariances (p, d, d) of the updated components.
    """
    size = means.shape[1]
    count = len(components)
    out_means = np.empty((count, size))
    out_covariances = np.empty((count, size, size))
    gain = np.empty((size, 2))
    for i in range(count):
        k, j = components[i], detections[i]
        covariance = covariances[k]
        s00 = covariance[0, 0] + noises[j, 0, 0]
        s01 = covariance[0, 1] + noises[j, 0, 1]
        s11 = covariance[1, 1] + noises[j, 1, 1]
        determinant = s00 * s11 - s01 * s01
        du = points[j, 0] - means[k, 0]
        dv = points[j, 1] - means[k, 1]
        for a in range(size):
            gain[a, 0] = (covariance[a, 0] * s11 - covariance[a, 1] * s01) / determinant
            gain[a, 1] = (covariance[a, 1] * s00 - covariance[a, 0] * s01) / determinant
            out_means[i, a] = means[k, a] + gain[a, 0] * du + gain[a, 1] * dv
        for a in range(size):
            for b in range(a + 1):
                value = covariance[a, b] - gain[a, 0] * covariance[b, 0] - gain[a, 1] * covariance[b, 1]
                out_covariances[i, a, b] = value
                out_covariances[i, b, a] = value
    return out_means, out_covariances
