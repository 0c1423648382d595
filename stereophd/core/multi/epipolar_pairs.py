"""Pairs of tracks that two cameras may have paired crosswise: the geometry of epipolar planes.

Two objects in one epipolar plane of two cameras have a second explanation if the rays of the one camera also meet those
of the other crosswise, before both cameras and at depths at which objects appear.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.multi.history import DeferredPairs
from stereophd.core.multi.mixture import UNLABELLED, GaussianMixture
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.sorting import stable_order

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Tracks whose epipolar planes are further apart than this many standard deviations of a pixel are not tested.
COPLANAR_SIGMAS = 6.0
# Crosswise intersections of a disparity this many standard deviations off the birth prior are no objects.
DISPARITY_SIGMAS = 4.0


class NewObjects(NamedTuple):
    """Prior of new objects: mean and standard deviation of the disparity (c,) for each camera; of velocities."""

    means: Array
    stds: Array
    velocity_std: float


@compiled
def crosswise_pairs(
    mixture: GaussianMixture,
    homes: Array,
    cameras: tuple[int, int],
    views: Array,
    prior: NewObjects,
    tolerance: float,
    deferred: DeferredPairs,
    event: int,
    most: int,
) -> Integers:
    """Labels (n, 2) of the first pairs of reported tracks that two cameras may have paired crosswise.

    Parameters
    ----------
    mixture : GaussianMixture
        Tracks ordered by label and then by falling weight.
    homes, views : arrays (n, 30), (c, 30)
        Packed spaces of the components, and of all cameras.
    cameras : (int, int)
        The two cameras.
    prior : NewObjects
    tolerance : float
        Distance of two epipolar lines, px, up to which they may be one.
    deferred : DeferredPairs
        Pairs of tracks and the second camera that are left out, until an event.
    event : int
        Number of the event.
    most : int
        Largest number of pairs to return.
    """
    labels, first, second = mixture.labels, views[cameras[0]], views[cameras[1]]
    heads, places = _reported_places(mixture, homes)
    count = len(heads)
    # angle of the epipolar plane of each, and how far (rad) two planes may be apart
    across, up = _epipolar_axes(first, second)
    angles, widths, widest = np.empty(count), np.empty(count), 0.0
    for i in range(count):
        x = places[i, 0] - second[CENTER]
        y = places[i, 1] - second[CENTER + 1]
        z = places[i, 2] - second[CENTER + 2]
        along = across[0] * x + across[1] * y + across[2] * z
        high = up[0] * x + up[1] * y + up[2] * z
        depth = second[ROTATION + 6] * x + second[ROTATION + 7] * y + second[ROTATION + 8] * z
        angles[i] = math.atan2(high, along)
        widths[i] = tolerance * depth / (second[FX] * math.hypot(along, high)) if depth > 0.0 else 0.0
        widest = max(widest, widths[i])
    order = stable_order(angles)
    out = np.empty((most, 2), dtype=np.int64)
    found = 0
    for k in range(count):
        # another beginning at every event: among hundreds of objects a pair is always due, and each has its turn
        m = (k + event) % count
        i = order[m]
        for n in range(m + 1, count):
            j = order[n]
            apart = angles[j] - angles[i]
            if apart > widest:
                break
            if apart <= min(widths[i], widths[j]) and (
                _meet(places[i], places[j], views, cameras[0], cameras[1], prior)
                and _meet(places[j], places[i], views, cameras[0], cameras[1], prior)
            ):
                one, other = labels[heads[i]], labels[heads[j]]
                one, other = min(one, other), max(one, other)
                if _waits(one, other, cameras[1], deferred, event):
                    continue
                out[found, 0], out[found, 1] = one, other
                found += 1
                if found == most:
                    return out
    return out[:found]


@compiled
def _epipolar_axes(first: Array, second: Array) -> tuple[Array, Array]:
    """Two axes (3,) that are orthogonal to the line from one camera to another, and to each other."""
    base, across, up = np.empty(3), np.empty(3), np.empty(3)
    for a in range(3):
        base[a] = second[CENTER + a] - first[CENTER + a]
    length = math.sqrt(base[0] ** 2 + base[1] ** 2 + base[2] ** 2)
    least = 0
    for a in range(3):
        base[a] = base[a] / length
        if abs(base[a]) < abs(base[least]):
            least = a
    for a in range(3):
        across[a] = -base[least] * base[a]
    across[least] += 1.0
    length = math.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)
    for a in range(3):
        across[a] /= length
    up[0] = base[1] * across[2] - base[2] * across[1]
    up[1] = base[2] * across[0] - base[0] * across[2]
    up[2] = base[0] * across[1] - base[1] * across[0]
    return across, up


@compiled
def _waits(one: int, other: int, camera: int, deferred: DeferredPairs, event: int) -> bool:
    """Whether the test of a pair with a camera is deferred beyond an event."""
    for k in range(len(deferred.due)):
        pair = deferred.pairs[k]
        if pair[0] == one and pair[1] == other and pair[2] == camera and deferred.due[k] > event:
            return True
    return False


@compiled
def _reported_places(mixture: GaussianMixture, homes: Array) -> tuple[Integers, Array]:
    """Heaviest component of each reported track, and the place (n, 3) of its mean in the world."""
    labels = mixture.labels
    heads = np.empty(len(labels), dtype=np.int64)
    count = 0
    for k in range(len(labels)):
        new = labels[k] != UNLABELLED and (k == 0 or labels[k] != labels[k - 1])
        if new and mixture.reported[k] and mixture.means[k, 2] > 0.0:
            heads[count] = k
            count += 1
    places = np.empty((count, 3))
    for i in range(count):
        mean, home = mixture.means[heads[i]], homes[heads[i]]
        depth = disparity_scale(home) / mean[2]
        x, y = (mean[0] - home[CX]) / home[FX] * depth, (mean[1] - home[CY]) / home[FY] * depth
        for a in range(3):
            r0, r1, r2 = home[ROTATION + a], home[ROTATION + 3 + a], home[ROTATION + 6 + a]
            places[i, a] = home[CENTER + a] + r0 * x + r1 * y + r2 * depth
    return heads[:count], places


@compiled
def _meet(one: Array, other: Array, views: Array, a: int, b: int, prior: NewObjects) -> bool:
    """Whether the ray of camera a to one place and that of camera b to another meet where objects may be."""
    first, second = views[a], views[b]
    # alpha to_one - beta to_other = base, in the least-squares sense
    p, q, r, s, t, forward_a, forward_b = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        to_one, to_other = one[k] - first[CENTER + k], other[k] - second[CENTER + k]
        base = second[CENTER + k] - first[CENTER + k]
        p += to_one * to_one
        q += to_one * to_other
        r += to_other * to_other
        s += to_one * base
        t += to_other * base
        forward_a += first[ROTATION + 6 + k] * to_one
        forward_b += second[ROTATION + 6 + k] * to_other
    determinant = p * r - q * q
    if not determinant > 1e-12 * p * r:
        return False
    alpha, beta = (r * s - q * t) / determinant, (q * s - p * t) / determinant
    depth_a, depth_b = alpha * forward_a, beta * forward_b
    if not (depth_a > 0.0 and depth_b > 0.0):
        return False
    off_a = abs(disparity_scale(first) / depth_a - prior.means[a])
    off_b = abs(disparity_scale(second) / depth_b - prior.means[b])
    return bool(off_a <= DISPARITY_SIGMAS * prior.stds[a] and off_b <= DISPARITY_SIGMAS * prior.stds[b])
