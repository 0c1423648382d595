"""Compiled first-order moves between disparity spaces, and moments in the world.

The first-order move is the extended Kalman filter's: the Jacobian of the trip of
`stereophd.core.disparity.trips.moving_trips`, carried column by column (forward differentiation).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.trips import disparity_scale, motion_noise, relative_pose
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.linear_algebra import cholesky, condition
from stereophd.core.numerics.moments import weighted_moments

Array = NDArray[np.float64]

# In the world a Gaussian in disparity has no moments (1 / d); samples more than this factor further
# away than the mean disparity are left out of them.
FARTHEST_SAMPLE = 10.0


@compiled
def linear_move(
    mean: Array,
    factor: Array,
    noise_axes: Array,
    source: Array,
    destination: Array,
    motion: MotionArrays,
    k: int,
    out_mean: Array,
    out_covariance: Array,
) -> None:
    """Carry a Gaussian (6,) over to first order.

    `noise_axes` (3, 3) holds, column by column, the noise along the world's axes in the destination's axes, scaled by
    its standard deviation; the interval is number `k` of `motion`. Other arguments as `moving_trips`.
    """
    reach, keep, max_speed, drift = motion.reach[k], motion.keep[k], motion.max_speed, motion.drift[k]
    position_noise, velocity_noise = motion.position_noise[k], motion.velocity_noise[k]
    pose = np.array(relative_pose(source, destination))
    rotation, translation = pose[:9].reshape(3, 3), pose[9:]
    per = np.array([1.0 / source[FX], 1.0 / source[FY], 1.0 / disparity_scale(source)])
    scales = np.array([destination[FX], destination[FY], disparity_scale(destination)])
    ray = np.array([(mean[0] - source[CX]) * per[0], (mean[1] - source[CY]) * per[1], 1.0])
    rho = mean[2] * per[2]
    growth = mean[5] * per[2] / (rho if rho != 0.0 else 1e-300)
    velocity = np.array([mean[3] * per[0] - ray[0] * growth, mean[4] * per[1] - ray[1] * growth, -growth])
    speed = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    slow = max_speed * abs(rho) / speed if speed > max_speed * abs(rho) else 1.0
    velocity *= slow
    axes = destination[ROTATION : ROTATION + 9].copy().reshape(3, 3)
    velocity_drift = np.zeros(3)
    for a in range(3):
        for b in range(3):
            translation[a] += axes[a, b] * drift[b]
            velocity_drift[a] += axes[a, b] * drift[3 + b]
    point = np.zeros(3)
    moved_velocity = np.zeros(3)
    for a in range(3):
        point[a] = rho * translation[a]
        for b in range(3):
            point[a] += rotation[a, b] * (ray[b] + reach * velocity[b])
            moved_velocity[a] += rotation[a, b] * (keep * velocity[b])
        moved_velocity[a] += rho * velocity_drift[a]
    per_z = 1.0 / point[2]
    x, y, rho_b = point[0] * per_z, point[1] * per_z, rho * per_z
    x_rate = (moved_velocity[0] - x * moved_velocity[2]) * per_z
    y_rate = (moved_velocity[1] - y * moved_velocity[2]) * per_z
    rho_rate = -rho_b * moved_velocity[2] * per_z
    out_mean[0] = scales[0] * x + destination[CX]
    out_mean[1] = scales[1] * y + destination[CY]
    out_mean[2] = scales[2] * rho_b
    out_mean[3] = scales[0] * x_rate
    out_mean[4] = scales[1] * y_rate
    out_mean[5] = scales[2] * rho_rate

    columns = np.zeros((6, 12))
    tangent = np.zeros(6)
    d_ray = np.zeros(3)
    d_velocity = np.zeros(3)
    d_point = np.zeros(3)
    d_moved = np.zeros(3)
    for c in range(12):
        for a in range(6):
            tangent[a] = factor[a, c] if c < 6 else 0.0
        d_ray[0], d_ray[1] = tangent[0] * per[0], tangent[1] * per[1]
        d_rho = tangent[2] * per[2]
        d_growth = (tangent[5] * per[2] - growth * d_rho) / (rho if rho != 0.0 else 1e-300)
        d_velocity[0] = slow * (tangent[3] * per[0] - d_ray[0] * growth - ray[0] * d_growth)
        d_velocity[1] = slow * (tangent[4] * per[1] - d_ray[1] * growth - ray[1] * d_growth)
        d_velocity[2] = -slow * d_growth
        for a in range(3):
            d_point[a] = d_rho * translation[a]
            d_moved[a] = d_rho * velocity_drift[a]
            for b in range(3):
                d_point[a] += rotation[a, b] * (d_ray[b] + reach * d_velocity[b])
                d_moved[a] += rotation[a, b] * (keep * d_velocity[b])
            if 6 <= c < 9:
                d_point[a] += rho * position_noise * motion.with_velocity[k] * noise_axes[a, c - 6]
                d_moved[a] += rho * velocity_noise * noise_axes[a, c - 6]
            elif c >= 9:
                d_point[a] += rho * position_noise * motion.alone[k] * noise_axes[a, c - 9]
        d_x = (d_point[0] - x * d_point[2]) * per_z
        d_y = (d_point[1] - y * d_point[2]) * per_z
        d_rho_b = (d_rho - rho_b * d_point[2]) * per_z
        columns[0, c] = scales[0] * d_x
        columns[1, c] = scales[1] * d_y
        columns[2, c] = scales[2] * d_rho_b
        vz, d_vz = moved_velocity[2], d_moved[2]
        columns[3, c] = scales[0] * (d_moved[0] - d_x * vz - x * d_vz - x_rate * d_point[2]) * per_z
        columns[4, c] = scales[1] * (d_moved[1] - d_y * vz - y * d_vz - y_rate * d_point[2]) * per_z
        columns[5, c] = scales[2] * (-d_rho_b * vz - rho_b * d_vz - rho_rate * d_point[2]) * per_z
    for a in range(6):
        for b in range(6):
            total = 0.0
            for c in range(12):
                total += columns[a, c] * columns[b, c]
            out_covariance[a, b] = total


@compiled
def linear_components(
    means: Array,
    covariances: Array,
    homes: Array,
    motion: MotionArrays,
    noise_axes: Array,
    destination: Array,
    out_means: Array,
    out_covariances: Array,
) -> None:
    """`linear_move` of every component, overwriting `out_means` (n, d) and `out_covariances` (n, d, d).

    A static component (d = 3) is moved as one with velocity 0. A component whose first-order covariance
    is not positive definite keeps what the arrays hold.
    """
    size = means.shape[1]
    source_factor = np.empty((size, size))
    scratch = np.empty((size, size))
    factor = np.zeros((6, 6))
    source_mean = np.zeros(6)
    mean = np.empty(6)
    covariance = np.empty((6, 6))
    for k in range(means.shape[0]):
        if not cholesky(covariances[k], source_factor):
            continue
        factor[:size, :size] = source_factor
        source_mean[:size] = means[k]
        linear_move(source_mean, factor, noise_axes, homes[k], destination, motion, k, mean, covariance)
        if condition(covariance[:size, :size], scratch):
            out_means[k] = mean[:size]
            out_covariances[k] = covariance[:size, :size]


@compiled
def _moving_to_world(
    mean: Array,
    factor: Array,
    samples: Array,
    noise: Array,
    motion: MotionArrays,
    k: int,
    home: Array,
    points: Array,
    weights: Array,
) -> float:
    """Samples of a moving object in the world: fill points (6, n) and weights (n,), return the sum of these.

    The object moves by interval number `k` of `motion`.
    """
    reach, keep, max_speed = motion.reach[k], motion.keep[k], motion.max_speed
    position_noise, velocity_noise = motion.position_noise[k], motion.velocity_noise[k]
    # scalars: what is read from an array inside the loop keeps it from being vectorised
    drift = motion.drift[k]
    d0, d1, d2, d3, d4, d5 = drift[0], drift[1], drift[2], drift[3], drift[4], drift[5]
    m0, m1, m2, m3, m4, m5 = mean[0] - home[CX], mean[1] - home[CY], mean[2], mean[3], mean[4], mean[5]
    l00 = factor[0, 0]
    l10, l11 = factor[1, 0], factor[1, 1]
    l20, l21, l22 = factor[2, 0], factor[2, 1], factor[2, 2]
    l30, l31, l32, l33 = factor[3, 0], factor[3, 1], factor[3, 2], factor[3, 3]
    l40, l41, l42, l43, l44 = factor[4, 0], factor[4, 1], factor[4, 2], factor[4, 3], factor[4, 4]
    l50, l51, l52, l53, l54 = factor[5, 0], factor[5, 1], factor[5, 2], factor[5, 3], factor[5, 4]
    l55 = factor[5, 5]
    # from the camera's axes back to the world's
    r = home[ROTATION : ROTATION + 9]
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8]
    c0, c1, c2 = home[CENTER], home[CENTER + 1], home[CENTER + 2]
    per_fx, per_fy, scale = 1.0 / home[FX], 1.0 / home[FY], disparity_scale(home)
    for i in range(samples.shape[1]):
        a0, a1, a2 = samples[0, i], samples[1, i], samples[2, i]
        a3, a4, a5 = samples[3, i], samples[4, i], samples[5, i]
        disparity = m2 + l20 * a0 + l21 * a1 + l22 * a2
        weights[i] = 1.0 if disparity * FARTHEST_SAMPLE >= m2 else 0.0
        per_disparity = 1.0 / disparity
        depth = scale * per_disparity
        growth = (m5 + l50 * a0 + l51 * a1 + l52 * a2 + l53 * a3 + l54 * a4 + l55 * a5) * per_disparity
        x = (m0 + l00 * a0) * per_fx * depth
        y = (m1 + l10 * a0 + l11 * a1) * per_fy * depth
        vx = (m3 + l30 * a0 + l31 * a1 + l32 * a2 + l33 * a3) * per_fx * depth - x * growth
        vy = (m4 + l40 * a0 + l41 * a1 + l42 * a2 + l43 * a3 + l44 * a4) * per_fy * depth - y * growth
        vz = -depth * growth
        speed2 = vx * vx + vy * vy + vz * vz
        slow = max_speed / math.sqrt(speed2) if speed2 > max_speed * max_speed else 1.0
        vx, vy, vz = slow * vx, slow * vy, slow * vz
        x, y, depth = x + reach * vx, y + reach * vy, depth + reach * vz
        vx, vy, vz = keep * vx, keep * vy, keep * vz
        points[0, i] = c0 + r00 * x + r10 * y + r20 * depth + position_noise * noise[0, i] + d0
        points[1, i] = c1 + r01 * x + r11 * y + r21 * depth + position_noise * noise[1, i] + d1
        points[2, i] = c2 + r02 * x + r12 * y + r22 * depth + position_noise * noise[2, i] + d2
        points[3, i] = r00 * vx + r10 * vy + r20 * vz + velocity_noise * noise[3, i] + d3
        points[4, i] = r01 * vx + r11 * vy + r21 * vz + velocity_noise * noise[4, i] + d4
        points[5, i] = r02 * vx + r12 * vy + r22 * vz + velocity_noise * noise[5, i] + d5
    total = 0.0
    for i in range(samples.shape[1]):
        total += weights[i]
    return total


@compiled
def _static_to_world(mean: Array, factor: Array, samples: Array, home: Array, points: Array, weights: Array) -> float:
    """Samples of a static object in the world; as `_moving_to_world` with states (3,) and points (3, n)."""
    scale = disparity_scale(home)
    total = 0
    for i in range(samples.shape[1]):
        a0, a1, a2 = samples[0, i], samples[1, i], samples[2, i]
        disparity = mean[2] + factor[2, 0] * a0 + factor[2, 1] * a1 + factor[2, 2] * a2
        near = disparity * FARTHEST_SAMPLE >= mean[2]
        weights[i] = 1.0 if near else 0.0
        total += near
        depth = scale / disparity
        x = (mean[0] - home[CX] + factor[0, 0] * a0) / home[FX] * depth
        y = (mean[1] - home[CY] + factor[1, 0] * a0 + factor[1, 1] * a1) / home[FY] * depth
        for a in range(3):
            r0, r1, r2 = home[ROTATION + a], home[ROTATION + 3 + a], home[ROTATION + 6 + a]
            points[a, i] = home[CENTER + a] + r0 * x + r1 * y + r2 * depth
    return float(total)


@compiled
def world_components(
    means: Array,
    covariances: Array,
    homes: Array,
    motion: MotionArrays,
    samples: Array,
    out_means: Array,
    out_covariances: Array,
) -> None:
    """Mean and covariance in the world (x, y, z, vx, vy, vz) of every component, moved by its interval.

    Components whose mean disparity is not positive (an object at infinity has no position) are left as NaN.
    """
    size = means.shape[1]
    count = samples.shape[1]
    axes = np.zeros((3, 3))
    for a in range(3):
        axes[a, a] = motion.noise_std[a]
    noise = np.empty((6, count if size == 6 else 0))
    with_velocity = alone = np.nan
    points = np.empty((size, count))
    weights = np.empty(count)
    factor = np.empty((size, size))
    mean = np.empty(size)
    covariance = np.empty((size, size))
    scratch = np.empty((size, size))
    for k in range(means.shape[0]):
        _fill_gaussian(np.nan, out_means, out_covariances, k)
        if not means[k, 2] > 0.0 or not cholesky(covariances[k], factor):
            continue
        if size == 6:
            if motion.with_velocity[k] != with_velocity or motion.alone[k] != alone:
                with_velocity, alone = motion.with_velocity[k], motion.alone[k]
                motion_noise(samples, axes, with_velocity, alone, noise)
            total = _moving_to_world(means[k], factor, samples, noise, motion, k, homes[k], points, weights)
        else:
            total = _static_to_world(means[k], factor, samples, homes[k], points, weights)
        weighted_moments(points, weights, total, mean, covariance)
        if not condition(covariance, scratch):
            continue
        _fill_gaussian(0.0, out_means, out_covariances, k)
        for a in range(size):
            out_means[k, a] = mean[a]
            for b in range(size):
                out_covariances[k, a, b] = covariance[a, b]


@compiled
def _fill_gaussian(value: float, means: Array, covariances: Array, k: int) -> None:
    """Set all elements of mean and covariance k."""
    for a in range(means.shape[1]):
        means[k, a] = value
        for b in range(means.shape[1]):
            covariances[k, a, b] = value
