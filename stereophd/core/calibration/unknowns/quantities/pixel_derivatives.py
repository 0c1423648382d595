"""The view of a camera on trajectories: raw pixels and their derivatives with respect to points and time."""

from __future__ import annotations

import math

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.unknowns.quantities.base import CameraView
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.compiled_lenses import distort_point_jacobian
from stereophd.core.geometry.layout import LENS_NONE
from stereophd.core.geometry.rotations import rotations
from stereophd.core.numerics.compilation.compiled import compiled

# Step of differences of a lens's derivatives, in normalised coordinates.
LENS_STEP = 1e-4


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
    ahead, visible, undistorted, distorted, by_point, by_world = project(
        points, axes, focal, lens.code, lens.coefficients, lens.max_radius
    )
    pixels = distorted * focal + [camera.cx, camera.cy]
    motion = np.einsum("nij,nj->ni", by_world, velocities - camera_velocity)
    if turns is not None:
        motion += np.einsum("nij,nj->ni", by_point, np.cross(points, camera_rate))
    return CameraView(
        camera, ahead, visible, elapsed, log_times, rows, points, turns, undistorted, distorted, by_point, by_world,
        motion, pixels,
    )  # fmt: skip


def product(matrices: Array, vectors: Array) -> Array:
    """Products (n, 3) of a matrix (3, 3), or one for each row (n, 3, 3), with vectors (n, 3)."""
    x, y, z = vectors[:, 0], vectors[:, 1], vectors[:, 2]
    return np.stack([matrices[..., i, 0] * x + matrices[..., i, 1] * y + matrices[..., i, 2] * z for i in range(3)], 1)


@compiled
def _imaged(
    code: int, coefficients: Array, max_radius: float, x: float, y: float
) -> tuple[float, float, float, float, float, float, float]:
    """Distort a point as `distort_point_jacobian`, or the one on `max_radius` before it, this part of it."""
    if code == LENS_NONE:
        return 1.0, x, y, 1.0, 0.0, 0.0, 1.0
    radius = math.hypot(x, y)
    share = 1.0 if radius <= max_radius else max_radius / radius
    x_d, y_d, j00, j01, j10, j11 = distort_point_jacobian(code, coefficients, share * x, share * y)
    if share < 1.0:  # only turns about the axis move it
        u, v = x / radius, y / radius
        turned_0, turned_1 = share * (j01 * u - j00 * v), share * (j11 * u - j10 * v)
        j00, j01, j10, j11 = -turned_0 * v, turned_0 * u, -turned_1 * v, turned_1 * u
    return share, x_d, y_d, j00, j01, j10, j11


@compiled
def project(
    points: Array, axes: Array, focal: Array, code: int, coefficients: Array, max_radius: float
) -> tuple[Booleans, Booleans, Array, Array, Array, Array]:
    """Return the fields of a `CameraView` of points (n, 3) from `ahead` to `by_world` that depend on the lens.

    `axes` (1, 3, 3) or (n, 3, 3) turn the world into the camera's axes; `focal` (2,) are in px. What lies beyond the
    `max_radius` of a lens is imaged as if on it, where the model folds back. Were it out of view, its detections would
    not let the lens become one that folds back sooner.
    """
    count = len(points)
    ahead, visible = np.empty(count, dtype=np.bool_), np.empty(count, dtype=np.bool_)
    undistorted, distorted = np.empty((count, 2)), np.empty((count, 2))
    by_point, by_world = np.empty((count, 2, 3)), np.empty((count, 2, 3))
    for n in range(count):
        turn = axes[n if axes.shape[0] > 1 else 0]
        seen = points[n, 2] > 0.0
        inverse = 1.0 / points[n, 2] if seen else 1.0
        x, y = points[n, 0] * inverse, points[n, 1] * inverse
        share, x_d, y_d, j00, j01, j10, j11 = _imaged(code, coefficients, max_radius, x, y)
        undistorted[n, 0], undistorted[n, 1] = share * x, share * y
        ahead[n], visible[n] = seen, seen and share == 1.0
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
    return ahead, visible, undistorted, distorted, by_point, by_world


def bent(view: CameraView) -> Array:
    """Second derivatives (n, 2, 3, 3) of the raw pixels by the point in the world."""
    camera, lens = view.camera, view.camera.lens
    axes = camera.pose.rotation[None] if view.turns is None else view.turns @ camera.pose.rotation
    focal = np.array([camera.fx, camera.fy])
    return np.asarray(_bends(view.points, view.ahead, axes, focal, lens.code, lens.coefficients, lens.max_radius))


@compiled
def _bends(
    points: Array, ahead: Booleans, axes: Array, focal: Array, code: int, lens: Array, max_radius: float
) -> Array:
    """`bent` by points (n, 3) and axes (1 or n, 3, 3) as those of `project`; those of the lens are differences."""
    out, by_point, slope, second = np.zeros((len(points), 2, 3, 3)), np.empty((3, 3)), np.eye(2), np.zeros((2, 3))
    half = 0.5 / LENS_STEP
    for n in np.flatnonzero(ahead):
        turn = axes[n if axes.shape[0] > 1 else 0]
        i = 1.0 / points[n, 2]
        x, y = points[n, 0] * i, points[n, 1] * i
        if code != LENS_NONE:
            _, _, _, slope[0, 0], slope[0, 1], slope[1, 0], slope[1, 1] = _imaged(code, lens, max_radius, x, y)
            _, _, _, r00, r01, r10, r11 = _imaged(code, lens, max_radius, x + LENS_STEP, y)
            _, _, _, l00, l01, l10, l11 = _imaged(code, lens, max_radius, x - LENS_STEP, y)
            _, _, _, _, d01, _, d11 = _imaged(code, lens, max_radius, x, y + LENS_STEP)
            _, _, _, _, u01, _, u11 = _imaged(code, lens, max_radius, x, y - LENS_STEP)
            second[0, 0], second[0, 1], second[0, 2] = half * (r00 - l00), half * (r01 - l01), half * (d01 - u01)
            second[1, 0], second[1, 1], second[1, 2] = half * (r10 - l10), half * (r11 - l11), half * (d11 - u11)
        for r in range(2):
            a, b, xx, xy, yy = slope[r, 0], slope[r, 1], second[r, 0], second[r, 1], second[r, 2]
            s = i * i * focal[r]
            by_point[0, 0], by_point[0, 1], by_point[1, 1] = s * xx, s * xy, s * yy
            by_point[0, 2] = -s * (x * xx + y * xy + a)
            by_point[1, 2] = -s * (x * xy + y * yy + b)
            by_point[2, 2] = s * (x * x * xx + 2.0 * x * y * xy + y * y * yy + 2.0 * (a * x + b * y))
            by_point[1, 0], by_point[2, 0], by_point[2, 1] = by_point[0, 1], by_point[0, 2], by_point[1, 2]
            for j in range(3):
                for k in range(3):
                    part = by_point[j, 0] * turn[0, k] + by_point[j, 1] * turn[1, k] + by_point[j, 2] * turn[2, k]
                    for m in range(3):
                        out[n, r, m, k] += turn[j, m] * part
    return out


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
