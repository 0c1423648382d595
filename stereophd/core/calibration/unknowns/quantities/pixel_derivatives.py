"""The view of a camera on trajectories: raw pixels and their derivatives with respect to points and time."""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import CameraView
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import pinhole
from stereophd.core.geometry.rotations import rotations


def look(camera: Camera, world: Array, velocities: Array, times: Array, log_times: Array, rows: Array) -> CameraView:
    """Project points of trajectories, world positions and velocities (n, 3) at the times of detections, into a camera.

    `times` (n,) are true ones and `log_times` (n,) those on the camera's clock, s; `rows` (n,) are those of the
    detections over the height of the image.
    """
    pose = camera.pose
    elapsed = times - pose.time_s
    turns = None
    camera_velocity, camera_rate = pose.velocity, pose.rotation_rate
    if pose.path is not None:
        found = pose.path.at(times)
        camera_velocity, camera_rate = found.velocities, found.rates
        turns = found.rotations @ pose.rotation.T
        points = product(found.rotations, world - found.centers)
    else:
        offsets = world - pose.center
        if pose.velocity.any():
            offsets = offsets - elapsed[:, None] * pose.velocity
        points = product(pose.rotation, offsets)
        if pose.rotation_rate.any():
            turns = rotations(-elapsed[:, None] * pose.rotation_rate)
            points = product(turns, points)
    visible = points[:, 2] > 0.0
    depths = np.where(visible, points[:, 2], 1.0)
    focal = np.array([camera.fx, camera.fy])
    undistorted, by_point = pinhole(np.column_stack([points[:, :2], depths]), focal)
    distorted = undistorted
    if camera.lens.code != 0:
        visible &= np.einsum("ni,ni->n", undistorted, undistorted) <= camera.lens.max_radius**2
        distorted, jacobian = camera.lens.distort(np.where(visible[:, None], undistorted, 0.0))
        scaled = jacobian * focal[:, None] * (1.0 / depths)[:, None, None]
        by_point[:, :, :2] = scaled
        by_point[:, :, 2] = -np.einsum("nij,nj->ni", scaled, undistorted)
    pixels = distorted * focal + [camera.cx, camera.cy]
    axes = pose.rotation if turns is None else turns @ pose.rotation
    by_world = row_product(by_point, axes)
    motion = np.einsum("nij,nj->ni", by_world, velocities - camera_velocity)
    if turns is not None:
        motion += np.einsum("nij,nj->ni", by_point, np.cross(points, camera_rate))
    return CameraView(
        camera, visible, elapsed, log_times, rows, points, turns, undistorted, distorted, by_point, by_world, motion,
        pixels,
    )  # fmt: skip


def product(matrices: Array, vectors: Array) -> Array:
    """Products (n, 3) of a matrix (3, 3), or one for each row (n, 3, 3), with vectors (n, 3)."""
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    return np.stack([matrices[..., i, 0] * x + matrices[..., i, 1] * y + matrices[..., i, 2] * z for i in range(3)], 1)


def row_product(rows: Array, matrices: Array) -> Array:
    """Products (n, 2, 3) of rows (n, 2, 3) with a matrix (3, 3), or one for each (n, 3, 3)."""
    return np.asarray(
        rows[:, :, 0, None] * matrices[..., None, 0, :]
        + rows[:, :, 1, None] * matrices[..., None, 1, :]
        + rows[:, :, 2, None] * matrices[..., None, 2, :]
    )


def turned(view: CameraView, axes: Array) -> Array:
    """Derivative (n, 2, 3) of the pixels for turns of the point's coordinates: point -> point - [point]_x axes d.

    The columns of `axes`, (3, 3) or (n, 3, 3), turn with the three values.
    """
    out = np.empty((len(view.points), 2, 3))
    x, y, z = view.points[:, 0], view.points[:, 1], view.points[:, 2]
    for a in range(3):
        l0, l1, l2 = axes[..., 0, a], axes[..., 1, a], axes[..., 2, a]
        t0, t1, t2 = z * l1 - y * l2, x * l2 - z * l0, y * l0 - x * l1
        for i in range(2):
            out[:, i, a] = view.by_point[:, i, 0] * t0 + view.by_point[:, i, 1] * t1 + view.by_point[:, i, 2] * t2
    return out
