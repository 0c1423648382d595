"""Compiled sample trips between disparity spaces (paper IV-B a-f, V-B, VI-C).

One trip takes a sample of a Gaussian in the disparity space of camera A to the world, moves it, and
takes it to the disparity space of camera B. With the ray ``r = ((u - cx) / fx, (v - cy) / fy, 1)``
and the inverse depth ``rho = d / (f b)`` the point of camera A is ``r / rho``; everything is kept
multiplied by rho,

    rho x_B = R_BA (r + reach rho v) + rho (t_BA + drift + noise),

so that the map is smooth through rho = 0 (a point at infinity, where motion and parallax vanish) and
singular only where the third component, rho times the depth before B, is 0. The velocity
``rho v = (r' - r rho' / rho)`` is the one term that grows without bound as rho goes to 0; a physical
limit of speed keeps it below ``rho v_max``.

The world is a destination too (`WORLD`): its coordinates are x, y and z, and the divisor is rho in the place of the
depth.

Layout: samples (rows, n) with the sample axis last, so that the loops vectorise; packed spaces as
`stereophd.core.disparity.space.DisparitySpace.packed` lays them out.
"""

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.space import BASELINE, PACKED_SIZE, VERTICAL
from stereophd.core.geometry.compiled_lenses import pixel_in_view
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, HEIGHT, LENS_CODE, LENS_NONE, ROTATION, WIDTH
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled

# A component of which this share is inside the region counts as inside.
REGION_SLACK = 0.8
# The world as a packed space: a camera of unit focal length in its origin and axes, without a baseline.
WORLD = np.zeros(PACKED_SIZE)
WORLD[[FX, FY, ROTATION, ROTATION + 4, ROTATION + 8]] = 1.0


@compiled
def relative_pose(source: Array, destination: Array) -> tuple[float, ...]:
    """Pose of the source camera's frame in the destination's: x_B = rotation x_A + translation.

    Returns the rotation row by row, then the translation: twelve numbers (an array would cost more than they do).
    """
    s, d = source[ROTATION : ROTATION + 9], destination[ROTATION : ROTATION + 9]
    x = source[CENTER] - destination[CENTER]
    y = source[CENTER + 1] - destination[CENTER + 1]
    z = source[CENTER + 2] - destination[CENTER + 2]
    return (
        d[0] * s[0] + d[1] * s[1] + d[2] * s[2],
        d[0] * s[3] + d[1] * s[4] + d[2] * s[5],
        d[0] * s[6] + d[1] * s[7] + d[2] * s[8],
        d[3] * s[0] + d[4] * s[1] + d[5] * s[2],
        d[3] * s[3] + d[4] * s[4] + d[5] * s[5],
        d[3] * s[6] + d[4] * s[7] + d[5] * s[8],
        d[6] * s[0] + d[7] * s[1] + d[8] * s[2],
        d[6] * s[3] + d[7] * s[4] + d[8] * s[5],
        d[6] * s[6] + d[7] * s[7] + d[8] * s[8],
        d[0] * x + d[1] * y + d[2] * z,
        d[3] * x + d[4] * y + d[5] * z,
        d[6] * x + d[7] * y + d[8] * z,
    )


@compiled
def disparity_scale(space: Array) -> float:
    """Focal length along the baseline times the baseline: d = scale / depth."""
    focal = space[FY] if space[VERTICAL] == 1.0 else space[FX]
    return float(focal * space[BASELINE])


@compiled
def moving_trips(
    mean: Array,
    factor: Array,
    samples: Array,
    noise: Array,
    position_noise: float,
    velocity_noise: float,
    source: Array,
    destination: Array,
    reach: float,
    keep: float,
    drift: Array,
    max_speed: float,
    out: Array,
) -> None:
    """Carry the samples of one moving object from the source's packed space (30,) to the destination's.

    The Gaussian (6,), (6, 6) in the source's space has its covariance as lower Cholesky factor; the first six rows of
    the standard-normal samples (>= 6, n) are the state's. The noise (6, n) is that of the motion in the destination's
    axes, of position, then of velocity, before it is scaled by `position_noise` and `velocity_noise`; these, `reach`,
    `keep`, `drift` and `max_speed` are those of one interval of `stereophd.core.motion.arrays.MotionArrays`. Fills
    `out` (7, n) with (u, v, d, du, dv, dd), or the place and the velocity in the world, and the divisor: rho times the
    depth before the destination, in the world rho.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22, t0, t1, t2 = relative_pose(source, destination)
    # the drift in the destination's axes: of the position it is one more translation
    d = destination[ROTATION : ROTATION + 9]
    t0 += d[0] * drift[0] + d[1] * drift[1] + d[2] * drift[2]
    t1 += d[3] * drift[0] + d[4] * drift[1] + d[5] * drift[2]
    t2 += d[6] * drift[0] + d[7] * drift[1] + d[8] * drift[2]
    w0 = d[0] * drift[3] + d[1] * drift[4] + d[2] * drift[5]
    w1 = d[3] * drift[3] + d[4] * drift[4] + d[5] * drift[5]
    w2 = d[6] * drift[3] + d[7] * drift[4] + d[8] * drift[5]
    per_fx, per_fy, per_scale = 1.0 / source[FX], 1.0 / source[FY], 1.0 / disparity_scale(source)
    fx, fy, cx, cy = destination[FX], destination[FY], destination[CX], destination[CY]
    scale = disparity_scale(destination)
    m0, m1, m2, m3, m4, m5 = mean[0] - source[CX], mean[1] - source[CY], mean[2], mean[3], mean[4], mean[5]
    # the factor is unrolled into scalars: the loop over samples then has no loop inside it
    l00 = factor[0, 0]
    l10, l11 = factor[1, 0], factor[1, 1]
    l20, l21, l22 = factor[2, 0], factor[2, 1], factor[2, 2]
    l30, l31, l32, l33 = factor[3, 0], factor[3, 1], factor[3, 2], factor[3, 3]
    l40, l41, l42, l43, l44 = factor[4, 0], factor[4, 1], factor[4, 2], factor[4, 3], factor[4, 4]
    l50, l51, l52, l53, l54, l55 = (factor[5, 0], factor[5, 1], factor[5, 2], factor[5, 3], factor[5, 4], factor[5, 5])
    for i in range(samples.shape[1]):
        a0, a1, a2 = samples[0, i], samples[1, i], samples[2, i]
        a3, a4, a5 = samples[3, i], samples[4, i], samples[5, i]
        ray_x = (m0 + l00 * a0) * per_fx
        ray_y = (m1 + l10 * a0 + l11 * a1) * per_fy
        rho = (m2 + l20 * a0 + l21 * a1 + l22 * a2) * per_scale
        ray_x_rate = (m3 + l30 * a0 + l31 * a1 + l32 * a2 + l33 * a3) * per_fx
        ray_y_rate = (m4 + l40 * a0 + l41 * a1 + l42 * a2 + l43 * a3 + l44 * a4) * per_fy
        rho_rate = (m5 + l50 * a0 + l51 * a1 + l52 * a2 + l53 * a3 + l54 * a4 + l55 * a5) * per_scale
        growth = rho_rate / (rho if rho != 0.0 else 1e-300)
        velocity_x = ray_x_rate - ray_x * growth
        velocity_y = ray_y_rate - ray_y * growth
        velocity_z = -growth
        speed2 = velocity_x * velocity_x + velocity_y * velocity_y + velocity_z * velocity_z
        limit = max_speed * abs(rho)
        slow = limit / math.sqrt(speed2) if speed2 > limit * limit else 1.0
        velocity_x *= slow
        velocity_y *= slow
        velocity_z *= slow
        x = ray_x + reach * velocity_x
        y = ray_y + reach * velocity_y
        z = 1.0 + reach * velocity_z
        velocity_x *= keep
        velocity_y *= keep
        velocity_z *= keep
        p = rho * position_noise
        q = rho * velocity_noise
        x_b = r00 * x + r01 * y + r02 * z + rho * t0 + p * noise[0, i]
        y_b = r10 * x + r11 * y + r12 * z + rho * t1 + p * noise[1, i]
        z_b = r20 * x + r21 * y + r22 * z + rho * t2 + p * noise[2, i]
        vx_b = r00 * velocity_x + r01 * velocity_y + r02 * velocity_z + q * noise[3, i] + rho * w0
        vy_b = r10 * velocity_x + r11 * velocity_y + r12 * velocity_z + q * noise[4, i] + rho * w1
        vz_b = r20 * velocity_x + r21 * velocity_y + r22 * velocity_z + q * noise[5, i] + rho * w2
        out[0, i], out[1, i], out[2, i], out[6, i] = x_b, y_b, z_b, rho
        out[3, i], out[4, i], out[5, i] = vx_b, vy_b, vz_b
    if scale == 0.0:
        for i in range(samples.shape[1]):
            per_rho = 1.0 / out[6, i]
            for a in range(6):
                out[a, i] *= per_rho
        return
    for i in range(samples.shape[1]):
        z_b, vz_b = out[2, i], out[5, i]
        per_z = 1.0 / z_b
        x_b, y_b, rho = out[0, i] * per_z, out[1, i] * per_z, out[6, i] * per_z
        out[0, i] = fx * x_b + cx
        out[1, i] = fy * y_b + cy
        out[2, i] = scale * rho
        out[3, i] = fx * (out[3, i] - x_b * vz_b) * per_z
        out[4, i] = fy * (out[4, i] - y_b * vz_b) * per_z
        out[5, i] = -scale * rho * vz_b * per_z
        out[6, i] = z_b


@compiled
def static_trips(mean: Array, factor: Array, samples: Array, source: Array, destination: Array, out: Array) -> None:
    """Carry the samples of one static object; as `moving_trips` with states (3,) and out (4, n)."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22, t0, t1, t2 = relative_pose(source, destination)
    per_fx, per_fy, per_scale = 1.0 / source[FX], 1.0 / source[FY], 1.0 / disparity_scale(source)
    fx, fy, cx, cy = destination[FX], destination[FY], destination[CX], destination[CY]
    scale = disparity_scale(destination)
    by_rho = 1.0 if scale == 0.0 else 0.0
    by_depth = 1.0 - by_rho
    m0, m1, m2 = mean[0] - source[CX], mean[1] - source[CY], mean[2]
    for i in range(samples.shape[1]):
        a0, a1, a2 = samples[0, i], samples[1, i], samples[2, i]
        ray_x = (m0 + factor[0, 0] * a0) * per_fx
        ray_y = (m1 + factor[1, 0] * a0 + factor[1, 1] * a1) * per_fy
        rho = (m2 + factor[2, 0] * a0 + factor[2, 1] * a1 + factor[2, 2] * a2) * per_scale
        x_b = r00 * ray_x + r01 * ray_y + r02 + rho * t0
        y_b = r10 * ray_x + r11 * ray_y + r12 + rho * t1
        z_b = r20 * ray_x + r21 * ray_y + r22 + rho * t2
        divisor = by_depth * z_b + by_rho * rho
        per = 1.0 / divisor
        out[0, i] = fx * x_b * per + cx
        out[1, i] = fy * y_b * per + cy
        out[2, i] = (scale * rho + by_rho * z_b) * per
        out[3, i] = divisor


@compiled
def interval_trips(
    mean: Array, factor: Array, samples: Array, axes: Array, shape: Array, noise: Array, k: int, motion: MotionArrays,
    home: Array, destination: Array, out: Array,
) -> None:  # fmt: skip
    """Carry the samples of a component over interval k of the motion: `moving_trips`, or `static_trips` of (3,).

    `noise` (6, n) is that of `motion_noise` with parts `shape` (2,), at first NaN: of many models it has one shape for
    all intervals.
    """
    if len(mean) == 3:
        static_trips(mean, factor, samples, home, destination, out)
        return
    if motion.with_velocity[k] != shape[0] or motion.alone[k] != shape[1]:
        shape[0], shape[1] = motion.with_velocity[k], motion.alone[k]
        motion_noise(samples, axes, shape[0], shape[1], noise)
    moving_trips(
        mean, factor, samples, noise, motion.position_noise[k], motion.velocity_noise[k], home, destination,
        motion.reach[k], motion.keep[k], motion.drift[k], motion.max_speed, out
    )  # fmt: skip


@compiled
def motion_noise(samples: Array, axes: Array, with_velocity_part: float, alone_part: float, out: Array) -> None:
    """Unit noise of position and velocity, `out` (6, n), from samples (12, n), in the axes of `axes` (3, 3).

    The columns of `axes` are the world's axes in the destination's, times the standard deviation of the motion's
    noise along them; the parts are those of `stereophd.core.motion.arrays.MotionArrays`.
    """
    for i in range(samples.shape[1]):
        for a in range(3):
            position = 0.0
            velocity = 0.0
            for b in range(3):
                with_velocity = samples[6 + b, i]
                position += axes[a, b] * (with_velocity_part * with_velocity + alone_part * samples[9 + b, i])
                velocity += axes[a, b] * with_velocity
            out[a, i] = position
            out[3 + a, i] = velocity


@compiled
def view_mask(points: Array, destination: Array, mask: Array) -> int:
    """Mark the samples in view of the destination (in front, inside the distorted image); count them."""
    depth = points[points.shape[0] - 1]
    right, bottom = destination[WIDTH] - 0.5, destination[HEIGHT] - 0.5
    count = 0
    if destination[LENS_CODE] != LENS_NONE:
        for i in range(points.shape[1]):
            seen = depth[i] > 0.0 and pixel_in_view(destination, points[0, i], points[1, i])
            mask[i] = 1.0 if seen else 0.0
            count += seen
    else:
        for i in range(points.shape[1]):
            u, v = points[0, i], points[1, i]
            seen = (depth[i] > 0.0) & (u >= -0.5) & (u <= right) & (v >= -0.5) & (v <= bottom)
            mask[i] = 1.0 if seen else 0.0
            count += seen
    return count


@compiled
def region_mask(
    points: Array, destination: Array, home: Array, region: Array, slack: float, sample_weights: Array, weights: Array
) -> float:
    """Share of a component inside the region; where it is small, set weights outside to 0.

    The region is packed (`stereophd.core.geometry.region`); depths are those before the home camera. A Gaussian always
    has a tail outside. It therefore counts as inside, unchanged, as long as a share of at least the slack is inside:
    otherwise an object in the region would lose its existence step by step.
    """
    scale = disparity_scale(destination)
    depths = points[points.shape[0] - 1]
    world = np.empty(3)
    total = 0.0
    kept = 0.0
    for i in range(points.shape[1]):
        total += sample_weights[i]
        weights[i] = 0.0
        inverse = points[2, i] / scale
        # rho = inverse * depth of the trip: not positive at or beyond infinity
        if not inverse * depths[i] > 0.0:
            continue
        x = (points[0, i] - destination[CX]) / destination[FX] / inverse
        y = (points[1, i] - destination[CY]) / destination[FY] / inverse
        z = 1.0 / inverse
        depth = 0.0
        for a in range(3):
            world[a] = (
                destination[CENTER + a]
                + destination[ROTATION + a] * x
                + destination[ROTATION + 3 + a] * y
                + destination[ROTATION + 6 + a] * z
            )
            depth += home[ROTATION + 6 + a] * (world[a] - home[CENTER + a])
        good = region[0] <= depth <= region[1]
        for n in range(2, len(region), 4):
            outward = region[n] * world[0] + region[n + 1] * world[1] + region[n + 2] * world[2]
            good = good and outward <= region[n + 3]
        if good:
            weights[i] = sample_weights[i]
            kept += weights[i]
    if kept >= slack * total:
        for i in range(len(weights)):
            weights[i] = sample_weights[i]
        return 1.0
    return kept / total
