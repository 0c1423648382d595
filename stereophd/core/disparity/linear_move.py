"""Compiled first-order moves between disparity spaces.

The first-order move is the extended Kalman filter's: the Jacobian of the trip of
`stereophd.core.disparity.trips.moving_trips`, carried column by column (forward differentiation).
"""

from __future__ import annotations

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.trips import disparity_scale, relative_pose
from stereophd.core.geometry.layout import CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, condition


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
