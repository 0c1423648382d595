"""Pairs of tracks that two cameras may have paired crosswise: the geometry of epipolar planes.

Two objects in one epipolar plane of two cameras have a second explanation if the rays of the one camera also meet those
of the other crosswise, before both cameras and at depths at which objects appear.
"""

import math
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.disparity.world_moments import place_in_world
from stereophd.core.geometry.compiled_lenses import pixel_in_view
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.multi.swaps.history import DeferredPairs
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import stable_order

# Tracks whose epipolar planes are further apart than this many standard deviations of a pixel are not tested.
COPLANAR_SIGMAS = 6.0
# Standard deviations by which a place may be off where a track is followed back in time.
PAST_SIGMAS = 3.0
# Largest number of tracks for which an event looks for a second one.
MOST_TRACKS = 64
GOLDEN_SECTION = (math.sqrt(5.0) - 1.0) / 2.0
# Crosswise intersections of a disparity this many standard deviations off the birth prior are no objects.
DISPARITY_SIGMAS = 4.0


class NewObjects(NamedTuple):
    """Prior of new objects: mean and standard deviation of the disparity (c,) for each camera; of velocities."""

    means: Array
    stds: Array
    velocity_std: float
    region: Array  # (r,) or empty: where objects can be


class Past(NamedTuple):
    """Time (s) for which crosswise pairs have been in one epipolar plane, and the acceleration noise (length/s^2)."""

    span_s: float
    acceleration_std: float


class TrackPlaces(NamedTuple):
    """Reported tracks: heaviest component (n,), place now and at the beginning of the past (n, 3), error of the latter.

    The error (n,) is `PAST_SIGMAS` standard deviations, length.
    """

    heads: Integers
    now: Array
    past: Array
    errors: Array


@compiled
def swap_candidates(
    mixture: GaussianMixture,
    rows: Integers,
    homes: Array,
    cameras: tuple[int, int],
    views: Array,
    prior: NewObjects,
    tolerance: float,
    past: Past,
    deferred: DeferredPairs,
    event: int,
    most: int,
) -> Integers:
    """Labels (n, 2) of the first pairs of reported tracks that two cameras may have paired crosswise, at most so many.

    Tracks are ordered by label and then by falling weight; component k has the packed home space ``homes[rows[k]]``,
    and `views` (c, 30) are those of all cameras. Two epipolar lines up to `tolerance` px apart may be one. Two tracks
    that have come into one plane since the `past` were not paired crosswise before. Deferred are pairs of tracks and
    the second camera that are left out, until an event; `event` is the number of this one.
    """
    labels, first, second = mixture.labels, views[cameras[0]], views[cameras[1]]
    heads, places, before, errors = _reported_places(mixture, rows, homes, past)
    count = len(heads)
    # angle of the epipolar plane of each, and how far (rad) two planes may be apart
    axes = _epipolar_axes(first, second)
    angles, widths = np.empty(count), np.empty(count)
    old_angles, old_widths = np.empty(count), np.empty(count)
    for i in range(count):
        angles[i], radius = _plane(places[i], second, axes)
        old_angles[i], old_radius = _plane(before[i], second, axes)
        depth = 0.0
        for a in range(3):
            depth += second[ROTATION + 6 + a] * (places[i, a] - second[CENTER + a])
        widths[i] = tolerance * depth / (second[FX] * radius) if depth > 0.0 else 0.0
        old_widths[i] = errors[i] / old_radius
    order = stable_order(angles)
    out = np.empty((most, 2), dtype=np.int64)
    one_ghost, other_ghost = np.empty(3), np.empty(3)
    n_pairs = 0
    # another beginning at every event, at distances that repeat for no rhythm of the cameras: every track has its turn
    start = int(event * GOLDEN_SECTION % 1.0 * count)
    for k in range(min(count, MOST_TRACKS)):
        m = (start + k) % count
        i = order[m]
        for n in range(m + 1, count):
            j = order[n]
            apart = angles[j] - angles[i]
            if apart > widths[i]:
                break
            width = min(widths[i], widths[j])
            turned = abs(old_angles[j] - old_angles[i])
            turned = min(turned, 2.0 * math.pi - turned)
            if (
                apart <= width
                and turned <= width + old_widths[i] + old_widths[j]
                and _image_distance(places[i], places[j], second) > tolerance
                and _meet(places[i], places[j], views, cameras, prior, one_ghost)
                and _meet(places[j], places[i], views, cameras, prior, other_ghost)
                and not _told_apart(places[i], one_ghost, views, cameras, tolerance)
                and not _told_apart(places[j], other_ghost, views, cameras, tolerance)
            ):
                one, other = labels[heads[i]], labels[heads[j]]
                one, other = min(one, other), max(one, other)
                if _waits(one, other, cameras[1], deferred, event):
                    continue
                out[n_pairs, 0], out[n_pairs, 1] = one, other
                n_pairs += 1
                if n_pairs == most:
                    return out
    return out[:n_pairs]


@compiled
def _plane(place: Array, camera: Array, axes: tuple[Array, Array]) -> tuple[float, float]:
    """Angle of the epipolar plane of a place, and the distance of the place from the line between the cameras."""
    across, up = axes
    along, high = 0.0, 0.0
    for a in range(3):
        offset = place[a] - camera[CENTER + a]
        along += across[a] * offset
        high += up[a] * offset
    return math.atan2(high, along), math.hypot(along, high)


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
def _reported_places(mixture: GaussianMixture, rows: Integers, homes: Array, past: Past) -> TrackPlaces:
    """Places of the means of the reported tracks, now and, with their velocities, in the past."""
    labels = mixture.labels
    heads = np.empty(len(labels), dtype=np.int64)
    count = 0
    for k in range(len(labels)):
        if (k == 0 or labels[k] != labels[k - 1]) and mixture.reported[k] and mixture.means[k, 2] > 0.0:
            heads[count] = k
            count += 1
    moving = mixture.means.shape[1] == 6
    places, before, errors = np.empty((count, 3)), np.empty((count, 3)), np.zeros(count)
    for i in range(count):
        mean, covariance, home = mixture.means[heads[i]], mixture.covariances[heads[i]], homes[rows[heads[i]]]
        x, y, z, vx, vy, vz = place_in_world(mean, home)
        places[i, 0], places[i, 1], places[i, 2] = x, y, z
        span = past.span_s
        before[i, 0], before[i, 1], before[i, 2] = x - span * vx, y - span * vy, z - span * vz
        if moving:
            depth = disparity_scale(home) / mean[2]
            rate = max(covariance[3, 3] / home[FX] ** 2, covariance[4, 4] / home[FY] ** 2) * depth**2
            errors[i] = PAST_SIGMAS * span * math.sqrt(rate + past.acceleration_std**2 * span / 3.0)
    return TrackPlaces(heads[:count], places, before, errors)


@compiled
def _meet(one: Array, other: Array, views: Array, cameras: tuple[int, int], prior: NewObjects, ghost: Array) -> bool:
    """Whether the ray of the first camera to one place and that of the second to another meet where objects may be.

    Fills in where they do (3,).
    """
    a, b = cameras
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
    for k in range(3):
        ghost[k] = first[CENTER + k] + alpha * (one[k] - first[CENTER + k])
    return bool(off_a <= DISPARITY_SIGMAS * prior.stds[a] and off_b <= DISPARITY_SIGMAS * prior.stds[b])


@compiled
def _told_apart(place: Array, ghost: Array, views: Array, cameras: tuple[int, int], tolerance: float) -> bool:
    """Whether a third camera has a place in view, and a ghost on the same ray of the first camera lies elsewhere there.

    The track at the place would not live without its detections.
    """
    for c in range(len(views)):
        if c in cameras:
            continue
        u, v, in_front = _projected(place, views[c])
        # not a number where the ghost lies in the plane of the camera
        if in_front and pixel_in_view(views[c], u, v) and not _image_distance(place, ghost, views[c]) <= tolerance:
            return True
    return False


@compiled
def _image_distance(one: Array, other: Array, view: Array) -> float:
    """Distance of the undistorted pixels of two places."""
    u, v, _ = _projected(one, view)
    x, y, _ = _projected(other, view)
    return math.hypot(x - u, y - v)


@compiled
def _projected(place: Array, view: Array) -> tuple[float, float, bool]:
    """Undistorted pixel of a place, and whether it lies in front of the camera."""
    x, y, z = 0.0, 0.0, 0.0
    for a in range(3):
        offset = place[a] - view[CENTER + a]
        x += view[ROTATION + a] * offset
        y += view[ROTATION + 3 + a] * offset
        z += view[ROTATION + 6 + a] * offset
    return view[FX] * x / z + view[CX], view[FY] * y / z + view[CY], z > 0.0
