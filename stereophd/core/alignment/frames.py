"""Frames without a control track: a camera's own, the floor that objects stand on, and the fall of objects in flight.

With them, how a camera is brought into the frame and onto the clock of a world.

A frame has x right, y down, z forward. The floor and gravity give the vertical; the origin is the foot of a camera, or
its centre, and forward is where that camera looks.
"""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.pose import Pose
from stereophd.core.metrics.errors import independent_means
from stereophd.core.metrics.truth.registration import Alignment, Registration, TrackedPlaces

# The objects are on a floor if their scatter about it is at most this part of their second extent.
MOST_SCATTER = 0.2
# Steps of the robust fit of a plane.
STEPS = 20
# Estimates of a stretch of which an acceleration is fitted; accelerations that differ from the commonest by less than
# this part of it are of free flight; fewest such stretches, and least part of all stretches.
STRETCHES, ALIKE, LEAST_STRETCHES, LEAST_PART = (10, 20, 40, 80), 0.15, 3, 0.3
# Standard acceleration of gravity, m/s^2.
GRAVITY = 9.80665


def moved_camera(camera: Camera, registration: Registration) -> Camera:
    """Return a camera in the world; its pose still holds at ``pose.time_s``, now on the world's clock.

    Raises ValueError for a camera on a known trajectory, or whose pose changes from a time on.
    """
    if camera.pose.path is not None:
        raise ValueError(f"camera {camera.name} follows a known trajectory, or changes its pose: its frame stays")
    at = camera.pose.at(float(registration.track_times(np.array(camera.pose.time_s))))
    pose = Pose(
        at.rotation @ registration.rotation.T,
        registration.positions(at.center),
        registration.velocities(at.velocity),
        at.rotation_rate / registration.rate,
        camera.pose.time_s,
    )
    offset = float(registration.times(np.array(camera.clock.offset_s)))
    clock = Clock(offset, registration.rate * camera.clock.rate)
    return replace(camera, pose=pose, clock=clock, readout_s=registration.rate * camera.readout_s)


def camera_frame(pose: Pose) -> Alignment:
    """Return the frame of a camera: its centre is the origin, its axes are the world's."""
    return Alignment(_registration(pose.rotation, pose.center))


def floor_frame(tracks: TrackedPlaces, pose: Pose) -> Alignment:
    """Return the frame whose floor, y = 0, is the plane that the objects move on.

    The origin is the foot of a camera, forward is where it looks, and the camera is above the floor. Heights count as
    alike as successive ones of an object are. Raises ValueError where the objects are not on one plane.
    """
    position = tracks.position
    weights = np.ones(len(position))
    for _ in range(STEPS):
        middle = np.average(position, axis=0, weights=weights)
        spread, axes = np.linalg.eigh(np.cov((position - middle).T, aweights=weights))
        heights = (position - middle) @ axes[:, 0]
        weights = 1.0 / (1.0 + (heights / max(2.0 * float(np.median(np.abs(heights))), 1e-12)) ** 2)
    scatter, extent = np.sqrt(np.maximum(spread[:2], 0.0))
    if not scatter <= MOST_SCATTER * extent:
        raise ValueError(
            f"the objects are on no floor: they scatter {scatter / extent:.2g} times as much about the best plane as "
            "along it; record objects that move on the floor, in two directions"
        )
    down = -axes[:, 0] * np.sign((pose.center - middle) @ axes[:, 0])
    foot = pose.center + ((middle - pose.center) @ down) * down
    # heights tilt the floor by their moments about its middle, along its shorter side most
    moments = heights * ((position - middle) @ axes[:, 1]) / extent**2
    counts = [independent_means(values[:, None], tracks.track_id) for values in (moments, heights)]
    stds = np.sqrt([(moments**2).mean() / counts[0], (heights**2).mean() / counts[1], 0.0])
    return _upright(down, foot, pose, 1.0, stds, middle, heights)


def gravity_frame(tracks: TrackedPlaces, pose: Pose, gravity: float) -> Alignment:
    """Return the frame of a camera's centre in which objects in free flight fall along y with the acceleration given.

    Raises ValueError where stretches of tracks do not share one acceleration.
    """
    best: tuple[float, Array] | None = None
    for count in STRETCHES:
        found = _accelerations(tracks, count)
        if len(found) < LEAST_STRETCHES:
            continue
        sizes = np.linalg.norm(found, axis=1)
        near = np.linalg.norm(found[:, None] - found, axis=2) <= ALIKE * sizes[:, None]
        members = found[near[near.sum(axis=1).argmax()]]
        spread = float(np.linalg.norm(members.std(axis=0)) / np.linalg.norm(members.mean(axis=0)))
        enough = len(members) >= max(LEAST_STRETCHES, LEAST_PART * len(found))
        if enough and (best is None or spread / np.sqrt(len(members)) < best[0]):
            best = spread / np.sqrt(len(members)), members
    if best is None:
        raise ValueError(
            "the tracks share no acceleration: gravity shows in objects that fly freely, such as balls that are thrown"
        )
    mean = best[1].mean(axis=0)
    size = float(np.linalg.norm(mean))
    return _upright(
        mean / size, pose.center, pose, gravity / size, best[0] * np.array([1.0, 0.0, 1.0]), pose.center, np.zeros(0)
    )


def _accelerations(tracks: TrackedPlaces, count: int) -> Array:
    """Accelerations (k, 3) of successive stretches of `count` estimates of each track."""
    out = [np.zeros((0, 3))]
    for name in np.unique(tracks.track_id):
        rows = np.flatnonzero(tracks.track_id == name)
        for stretch in rows[: len(rows) // count * count].reshape(-1, count):
            elapsed = tracks.time_s[stretch] - tracks.time_s[stretch].mean()
            if np.ptp(elapsed) > 0.0:
                out.append(2.0 * np.polyfit(elapsed, tracks.position[stretch], 2)[:1])
    return np.concatenate(out)


def _upright(
    down: Array, origin: Array, pose: Pose, scale: float, stds: Array, turns_about: Array, left: Array
) -> Alignment:
    """Return the frame with a direction down, an origin, and forward where a camera looks, or its top points.

    `stds` (3,) are those of the vertical, rad, of the height, and of the logarithm of the scale.
    """
    along = pose.rotation[2] if abs(pose.rotation[2] @ down) < np.cos(np.deg2rad(5.0)) else -pose.rotation[1]
    forward = along - (along @ down) * down
    forward /= np.linalg.norm(forward)
    covariance = np.zeros((9, 9))
    covariance[[0, 2, 4, 6], [0, 2, 4, 6]] = stds[[0, 0, 1, 2]] ** 2
    registration = _registration(np.stack([np.cross(down, forward), down, forward]), origin, scale)
    return Alignment(registration, registration.positions(turns_about), covariance, distances=np.abs(left))


def _registration(rotation: Array, origin: Array, scale: float = 1.0) -> Registration:
    return Registration(rotation, -scale * rotation @ origin, scale, 0.0, 0.0, 1.0, 0)
