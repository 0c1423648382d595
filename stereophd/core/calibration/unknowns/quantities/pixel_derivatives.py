"""The view of a camera on trajectories: raw pixels and their derivatives with respect to points and time."""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.unknowns.quantities.base import CameraView
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.compiled_lenses import distort_point_jacobian
from stereophd.core.geometry.layout import LENS_NONE
from stereophd.core.geometry.rotations import rotations
from stereophd.core.numerics.compilation.compiled import compiled


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
    axes = pose.rotation[None] if turns is None else turns @ pose.rotation
    focal, lens = np.array([camera.fx, camera.fy]), camera.lens
    visible, undistorted, distorted, by_point, by_world = project(
        points, axes, focal, lens.code, lens.coefficients, lens.max_radius
    )
    pixels = distorted * focal + [camera.cx, camera.cy]
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


@compiled
def project(
    points: Array, axes: Array, focal: Array, code: int, coefficients: Array, max_radius: float
) -> tuple[Booleans, Array, Array, Array, Array]:
    """Return `visible`, `undistorted`, `distorted`, `by_point` and `by_world` of a `CameraView` of points (n, 3).

    `axes` (1, 3, 3) or (n, 3, 3) turn the world into the camera's axes; `focal` (2,) are in px.
    """
    count = len(points)
    visible, undistorted, distorted = np.empty(count, dtype=np.bool_), np.empty((count, 2)), np.empty((count, 2))
    by_point, by_world = np.empty((count, 2, 3)), np.empty((count, 2, 3))
    for n in range(count):
        turn = axes[n if axes.shape[0] > 1 else 0]
        seen = points[n, 2] > 0.0
        inverse = 1.0 / points[n, 2] if seen else 1.0
        x, y = points[n, 0] * inverse, points[n, 1] * inverse
        undistorted[n, 0], undistorted[n, 1] = x, y
        x_d, y_d, j00, j01, j10, j11 = x, y, 1.0, 0.0, 0.0, 1.0
        if code != LENS_NONE:
            seen = seen and x * x + y * y <= max_radius * max_radius
            x_d, y_d, j00, j01, j10, j11 = distort_point_jacobian(
                code, coefficients, x if seen else 0.0, y if seen else 0.0
            )
        visible[n] = seen
        distorted[n, 0], distorted[n, 1] = x_d, y_d
        for i in range(2):
            by_x, by_y = (j00, j01) if i == 0 else (j10, j11)
            by_x, by_y = by_x * focal[i] * inverse, by_y * focal[i] * inverse
            by_z = -(by_x * x + by_y * y)
            if code == LENS_NONE:
                by_z = -focal[i] * (x if i == 0 else y) * inverse
            by_point[n, i, 0], by_point[n, i, 1], by_point[n, i, 2] = by_x, by_y, by_z
            for a in range(3):
                by_world[n, i, a] = by_x * turn[0, a] + by_y * turn[1, a] + by_z * turn[2, a]
    return visible, undistorted, distorted, by_point, by_world


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
