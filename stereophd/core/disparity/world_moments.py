"""Compiled moments of moved Gaussians in the world."""

import math

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.trips import disparity_scale, motion_noise
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, condition
from stereophd.core.numerics.moments import weighted_moments

# In the world a Gaussian in disparity has no moments (1 / d). Samples further away than this factor times the depth of
# the mean disparity are left out.
FARTHEST_SAMPLE = 10.0


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
    which: Integers,
    rows: Integers,
    means: Array,
    covariances: Array,
    homes: Array,
    motion: MotionArrays,
    samples: Array,
    out_means: Array,
    out_covariances: Array,
) -> None:
    """Mean and covariance in the world (x, y, z, vx, vy, vz) of the components `which` (m,), moved by their intervals.

    Their packed home spaces and intervals are the `rows` (m,) of `homes` and of the motion. They fill the first m rows
    of `out_means` and `out_covariances`. Components whose mean disparity is not positive (an object at infinity has no
    position) are left as NaN.
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
    for i in range(len(which)):
        k, row = which[i], rows[i]
        _fill_gaussian(np.nan, out_means, out_covariances, i)
        if not means[k, 2] > 0.0 or not cholesky(covariances[k], factor):
            continue
        if size == 6:
            if motion.with_velocity[row] != with_velocity or motion.alone[row] != alone:
                with_velocity, alone = motion.with_velocity[row], motion.alone[row]
                motion_noise(samples, axes, with_velocity, alone, noise)
            total = _moving_to_world(means[k], factor, samples, noise, motion, row, homes[row], points, weights)
        else:
            total = _static_to_world(means[k], factor, samples, homes[row], points, weights)
        weighted_moments(points, weights, total, mean, covariance)
        if not condition(covariance, scratch):
            continue
        _fill_gaussian(0.0, out_means, out_covariances, i)
        for a in range(size):
            out_means[i, a] = mean[a]
            for b in range(size):
                out_covariances[i, a, b] = covariance[a, b]


@compiled
def _fill_gaussian(value: float, means: Array, covariances: Array, k: int) -> None:
    """Set all elements of mean and covariance k."""
    for a in range(means.shape[1]):
        means[k, a] = value
        for b in range(means.shape[1]):
            covariances[k, a, b] = value


@compiled
def place_in_world(mean: Array, space: Array) -> tuple[float, float, float, float, float, float]:
    """Position and velocity in the world of a state (3,) or (6,) of positive disparity in a packed space (30,).

    The velocity of a state (3,) is 0.
    """
    z = disparity_scale(space) / mean[2]
    x, y = (mean[0] - space[CX]) / space[FX] * z, (mean[1] - space[CY]) / space[FY] * z
    vx, vy, vz = 0.0, 0.0, 0.0
    if len(mean) == 6:
        growth = mean[5] / mean[2]
        vx, vy, vz = mean[3] / space[FX] * z - x * growth, mean[4] / space[FY] * z - y * growth, -z * growth
    # column by column: from the camera's axes to the world's
    r, c = space[ROTATION : ROTATION + 9], space[CENTER : CENTER + 3]
    return (
        c[0] + r[0] * x + r[3] * y + r[6] * z,
        c[1] + r[1] * x + r[4] * y + r[7] * z,
        c[2] + r[2] * x + r[5] * y + r[8] * z,
        r[0] * vx + r[3] * vy + r[6] * vz,
        r[1] * vx + r[4] * vy + r[7] * vz,
        r[2] * vx + r[5] * vy + r[8] * vz,
    )
