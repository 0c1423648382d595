"""The view of a camera on trajectories: raw pixels and their derivatives with respect to points and time."""

import math
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.calibration.unknowns.quantities.base import CameraView, Projection, Pull
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.compiled_lenses import distort_point_jacobian
from stereophd.core.geometry.layout import LENS_NONE
from stereophd.core.geometry.trajectory import Motions
from stereophd.core.numerics.compilation.compiled import compiled

# Step of differences of a lens's derivatives, in normalised coordinates: to one side, so that they are wrong by this
# part.
LENS_STEP = 1e-7


class Places(NamedTuple):
    """From where n rows are seen by c cameras, for kernels. Poses are (k, ...): one of a camera that stands still."""

    of_row: Integers  # (n,): Camera of each row
    poses: Integers  # (n,): Pose of each row
    motions: Motions  # The poses
    intrinsics: Array  # (c, 6): fx, fy, cx, cy, code and `max_radius` of the lens, of each camera
    lenses: Array  # (c, 8): Coefficients of its lens


@dataclass(frozen=True)
class Sights:
    """The cameras and poses from which rows are seen."""

    cameras: tuple[Camera, ...]
    places: Places

    @classmethod
    def of(cls, cameras: tuple[Camera, ...], of_row: Integers, times: Array) -> Self:
        """Return those of rows of cameras (n,) at true times (n,), s."""
        found, poses, count = [], np.empty(len(of_row), dtype=np.int64), 0
        for number, camera in enumerate(cameras):
            here, is_static = np.flatnonzero(of_row == number), camera.pose.is_static
            found.append(camera.pose.motions(np.zeros(1) if is_static else times[here]))
            poses[here] = count + (0 if is_static else np.arange(len(here)))
            count += len(found[-1].centers)
        # joined copies of one vector have other strides, for which kernels would be compiled once more
        motions = Motions(*(np.ascontiguousarray(np.concatenate(parts)) for parts in zip(*found, strict=True)))
        intrinsics = np.array([[c.fx, c.fy, c.cx, c.cy, c.lens.code, c.lens.max_radius] for c in cameras])
        return cls(
            cameras, Places(of_row, poses, motions, intrinsics, np.array([c.lens.coefficients for c in cameras]))
        )

    def project(self, world: Array) -> Projection:
        """Project points (n, 3) of the world."""
        return Projection(*_projected(world, self.places))

    def bends(self, points: Array, ahead: Booleans) -> Array:
        """Second derivatives (n, 2, 3, 3) of the raw pixels by the point in the world, from `Projection`."""
        return np.asarray(_bends(points, ahead, self.places))

    def pull(self, seen: Projection, pixels: Array, lines: Array, later: Array, bends: Array) -> Pull:
        """Return the pull of weights (n, 2) of pixels, (n, 2, 3) of their derivatives by points, and (n,) of times.

        The points are in the world; `bends` are the second derivatives, of those that are seen.
        """
        return Pull(pixels, later, *_pull(seen.points, seen.by_world, pixels, lines, bends, self.places))

    def view(self, number: int, here: Integers | slice, seen: Projection, velocities: Array, *at: Array) -> CameraView:
        """View of a camera on its rows `here`, with all that derivatives by its values need.

        `velocities` (n, 3) are those of the points; `at` are true times, log times and rows of detections, as in
        `view_of`.
        """
        camera, motions, poses = self.cameras[number], self.places.motions, self.places.poses[here]
        pose, (times, log_times, rows) = camera.pose, (values[here] for values in at)
        part = seen.take(here)
        turns = rates = None
        if pose.path is not None or pose.rotation_rate.any():
            turns, rates = motions.rotations[poses] @ pose.rotation.T, motions.rates[poses]
        return CameraView(
            **vars(part), camera=camera, elapsed=times - pose.time_s, log_times=log_times, rows=rows, turns=turns,
            drift=velocities[here] - motions.velocities[poses], rates=rates,
        )  # fmt: skip


def view_of(camera: Camera, world: Array, velocities: Array, times: Array, log_times: Array, rows: Array) -> CameraView:
    """Project points of trajectories, world positions and velocities (n, 3) at the times of detections, into a camera.

    `times` (n,) are true ones and `log_times` (n,) those on the camera's clock, s; `rows` (n,) are those of the
    detections over the height of the image.
    """
    sights = Sights.of((camera,), np.zeros(len(world), dtype=np.int64), times)
    return sights.view(0, slice(None), sights.project(world), velocities, times, log_times, rows)


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
def _projected(world: Array, places: Places) -> tuple[Booleans, Booleans, Array, Array, Array, Array, Array, Array]:
    """Return the fields of `Projection` of points (n, 3).

    What lies beyond the `max_radius` of a lens is imaged as if on it, where the model folds back. Were it out of view,
    its detections would not let the lens become one that folds back sooner.
    """
    count = len(world)
    ahead, visible = np.empty(count, dtype=np.bool_), np.empty(count, dtype=np.bool_)
    points, undistorted = np.empty((count, 3)), np.empty((count, 2))
    distorted, pixels = np.empty((count, 2)), np.empty((count, 2))
    by_point, by_world = np.empty((count, 2, 3)), np.empty((count, 2, 3))
    for n in range(count):
        number, pose = places.of_row[n], places.poses[n]
        turn, center = places.motions.rotations[pose], places.motions.centers[pose]
        camera, lens = places.intrinsics[number], places.lenses[number]
        code = int(camera[4])
        d0, d1, d2 = world[n, 0] - center[0], world[n, 1] - center[1], world[n, 2] - center[2]
        for i in range(3):
            points[n, i] = turn[i, 0] * d0 + turn[i, 1] * d1 + turn[i, 2] * d2
        seen = points[n, 2] > 0.0
        inverse = 1.0 / points[n, 2] if seen else 1.0
        x, y = points[n, 0] * inverse, points[n, 1] * inverse
        share, x_d, y_d, j00, j01, j10, j11 = _imaged(code, lens, camera[5], x, y)
        undistorted[n, 0], undistorted[n, 1] = share * x, share * y
        ahead[n], visible[n] = seen, seen and share == 1.0
        distorted[n, 0], distorted[n, 1] = x_d, y_d
        for i in range(2):
            focal = camera[i]
            pixels[n, i] = distorted[n, i] * focal + camera[2 + i]
            by_x, by_y = (j00, j01) if i == 0 else (j10, j11)
            by_x, by_y = by_x * focal * inverse, by_y * focal * inverse
            by_z = -(by_x * x + by_y * y)
            if code == LENS_NONE:
                by_z = -focal * (x if i == 0 else y) * inverse
            by_point[n, i, 0], by_point[n, i, 1], by_point[n, i, 2] = by_x, by_y, by_z
            for a in range(3):
                by_world[n, i, a] = by_x * turn[0, a] + by_y * turn[1, a] + by_z * turn[2, a]
    return ahead, visible, points, undistorted, distorted, pixels, by_point, by_world


@compiled
def _bends(points: Array, ahead: Booleans, places: Places) -> Array:
    """`Sights.bends` of points (n, 3) in the camera's axes; second derivatives of lenses are differences."""
    out, by_point = np.zeros((len(points), 2, 3, 3)), np.empty((3, 3))
    slope, second = np.empty((2, 2)), np.empty((2, 3))
    for n in np.flatnonzero(ahead):
        number, turn = places.of_row[n], places.motions.rotations[places.poses[n]]
        camera, lens = places.intrinsics[number], places.lenses[number]
        code, max_radius = int(camera[4]), camera[5]
        i = 1.0 / points[n, 2]
        x, y = points[n, 0] * i, points[n, 1] * i
        if code == LENS_NONE:
            slope[0, 0], slope[0, 1], slope[1, 0], slope[1, 1] = 1.0, 0.0, 0.0, 1.0
            second[:] = 0.0
        else:
            _, _, _, slope[0, 0], slope[0, 1], slope[1, 0], slope[1, 1] = _imaged(code, lens, max_radius, x, y)
            _, _, _, r00, r01, r10, r11 = _imaged(code, lens, max_radius, x + LENS_STEP, y)
            _, _, _, _, d01, _, d11 = _imaged(code, lens, max_radius, x, y + LENS_STEP)
            second[0, 0], second[0, 1], second[0, 2] = r00 - slope[0, 0], r01 - slope[0, 1], d01 - slope[0, 1]
            second[1, 0], second[1, 1], second[1, 2] = r10 - slope[1, 0], r11 - slope[1, 1], d11 - slope[1, 1]
            second /= LENS_STEP
        for r in range(2):
            a, b, xx, xy, yy = slope[r, 0], slope[r, 1], second[r, 0], second[r, 1], second[r, 2]
            s = i * i * camera[r]
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


@compiled
def _pull(
    points: Array, by_world: Array, pixels: Array, lines: Array, bends: Array, places: Places
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the fields of `Pull` after the first two, of points (n, 3) in the camera's axes."""
    count = len(points)
    stretches, force, undistorted = np.zeros((count, 2)), np.zeros((count, 3)), np.empty((count, 2, 2))
    turned, torque, moment, line = np.empty((count, 3)), np.empty((count, 3)), np.empty(3), np.empty(3)
    for n in range(count):
        number, turn = places.of_row[n], places.motions.rotations[places.poses[n]]
        camera, p, f = places.intrinsics[number], points[n], turned[n]
        inverse = 1.0 / p[2] if p[2] > 0.0 else 1.0
        x, y = p[0] * inverse, p[1] * inverse
        radius, moment[:] = math.hypot(x, y), 0.0
        for r in range(2):
            d, slope = lines[n, r], by_world[n, r]
            for a in range(3):
                stretches[n, r] += d[a] * slope[a]
                b, c = (a + 1) % 3, (a + 2) % 3
                moment[a] += d[b] * slope[c] - d[c] * slope[b]
                line[a] = turn[a, 0] * d[0] + turn[a, 1] * d[1] + turn[a, 2] * d[2]
                force[n, a] += pixels[n, r] * slope[a]
                for k in range(3):
                    force[n, a] += bends[n, r, a, k] * d[k]
            along_x, along_y = (line[0] - x * line[2]) * inverse, (line[1] - y * line[2]) * inverse
            if camera[4] != LENS_NONE and radius > camera[5]:  # only turns about the axis move it
                along = (y * along_x - x * along_y) / radius**2 * camera[5] / radius
                along_x, along_y = along * y, -along * x
            undistorted[n, r, 0], undistorted[n, r, 1] = along_x, along_y
        for a in range(3):
            f[a] = turn[a, 0] * force[n, 0] + turn[a, 1] * force[n, 1] + turn[a, 2] * force[n, 2]
            torque[n, a] = turn[a, 0] * moment[0] + turn[a, 1] * moment[1] + turn[a, 2] * moment[2]
        torque[n, 0] += p[1] * f[2] - p[2] * f[1]
        torque[n, 1] += p[2] * f[0] - p[0] * f[2]
        torque[n, 2] += p[0] * f[1] - p[1] * f[0]
    return stretches, force, turned, torque, undistorted
