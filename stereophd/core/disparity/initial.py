"""The Gaussian of an object that one camera has just seen for the first time (paper V-A).

The pixel is observed; the depth comes from a prior on disparity, the velocity from N(0, sigma^2 I) in the
world. Mapped to disparity space the velocity is

    du = d a_u . v,  dv = d a_v . v,  dd = d^2 a_d . v,      (v in the camera's axes)

with a_u = (fx, 0, cx - u) / s, a_v = (0, fy, cy - v) / s, a_d = (0, 0, -1) / s and s = f b: a polynomial
in the disparity. Its moments under the prior are therefore known in closed form, and the Gaussian
given here is the one that infinitely many samples would give. (A diagonal prior in px/s would lose
near, fast objects and make far ones fly; the paper's experiments use one, so it can be had.)
"""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.space import BASELINE, VERTICAL
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.numerics.compilation.compiled import compiled


class FirstSight(NamedTuple):
    """Prior of the objects that a camera sees for the first time."""

    space: Array  # (30,): Packed space of the camera
    # `mean`, `std`: Mean and standard deviation of the disparity, px.
    mean: float
    std: float
    velocity_std: float  # Standard deviation of each component of velocity in the world, length/s
    # (r,) or empty: Where objects can be (`stereophd.core.geometry.region`): depths along a ray are those inside it.
    region: Array


@compiled
def initial_moments(points: Array, noises: Array, prior: FirstSight, size: int, readings: Array) -> tuple[Array, Array]:
    """Return the Gaussians (m, d), (m, d, d) of objects of which only one detection each is known.

    They are in the disparity space of the camera of the prior, given undistorted pixels (m, 2) and their covariances
    (m, 2, 2), px^2; the size d is 6, or 3 for static objects. Readings (m, 3) have the time of each detection after
    that of the Gaussian, s, and the change of its u and v with the disparity (`stereophd.core.disparity.rolling`);
    (0, 3): nothing of it.
    """
    count, rolling = len(points), len(readings) > 0
    means = np.zeros((count, size))
    covariances = np.zeros((count, size, size))
    space, velocity_std = prior.space, prior.velocity_std
    focal = space[FY] if space[VERTICAL] == 1.0 else space[FX]
    scale = focal * space[BASELINE]
    # rows of the map from camera velocity to (du / d, dv / d, dd / d^2)
    rows = np.zeros((3, 3))
    rows[0, 0], rows[1, 1], rows[2, 2] = space[FX] / scale, space[FY] / scale, -1.0 / scale
    for j in range(count):
        mean, std = _inside(points[j], prior, scale)
        # E[d^2], E[d^3], E[d^4] of the prior, by the powers of d that each pair of components carries
        second = mean**2 + std**2
        third = mean**3 + 3.0 * mean * std**2
        fourth = mean**4 + 6.0 * mean**2 * std**2 + 3.0 * std**4
        for a in range(2):
            means[j, a] = points[j, a]
            for b in range(2):
                covariances[j, a, b] = noises[j, a, b]
        means[j, 2] = mean
        covariances[j, 2, 2] = std**2
        if size == 3:
            if rolling:
                _seen_from_frame(readings[j], means[j], covariances[j])
            continue
        rows[0, 2] = (space[CX] - points[j, 0]) / scale
        rows[1, 2] = (space[CY] - points[j, 1]) / scale
        for a in range(3):
            for b in range(3):
                power = second if a < 2 and b < 2 else (fourth if a == 2 and b == 2 else third)
                product = rows[a, 0] * rows[b, 0] + rows[a, 1] * rows[b, 1] + rows[a, 2] * rows[b, 2]
                variance = product * velocity_std**2 * power
                covariances[j, 3 + a, 3 + b] = variance
                if rolling:
                    # back from the time of the row to that of the frame: y - delay (du, dv, dd), velocities of mean 0
                    delay = readings[j, 0]
                    covariances[j, a, b] += delay**2 * variance
                    covariances[j, a, 3 + b] = -delay * variance
                    covariances[j, 3 + a, b] = -delay * variance
        if rolling:
            _seen_from_frame(readings[j], means[j], covariances[j])
    return means, covariances


@compiled
def _inside(point: Array, prior: FirstSight, scale: float) -> tuple[float, float]:
    """Return mean and standard deviation of the disparity along the ray of a pixel (2,), given the region.

    The prior without a region covers two standard deviations either side. What of that lies inside the region is
    covered instead, or all that does where the ray is inside it nearer or farther only. A ray outside leaves the prior
    as it is: what it sees is left out as it moves.
    """
    space, region, mean, std = prior.space, prior.region, prior.mean, prior.std
    if len(region) == 0:
        return mean, std
    ray = ((point[0] - space[CX]) / space[FX], (point[1] - space[CY]) / space[FY], 1.0)
    low, high = max(region[0], 0.0), region[1]
    for first in range(2, len(region), 4):
        along, room = 0.0, region[first + 3]
        for axis in range(3):
            room -= region[first + axis] * space[CENTER + axis]
            for k in range(3):
                along += region[first + axis] * space[ROTATION + 3 * k + axis] * ray[k]
        if along == 0.0:
            if room < 0.0:
                return mean, std
        elif along > 0.0:
            high = min(high, room / along)
        else:
            low = max(low, room / along)
    if not high > low:
        return mean, std
    most, least = mean + 2.0 * std, max(mean - 2.0 * std, 0.0)
    nearest, farthest = scale / low if low > 0.0 else np.inf, scale / high
    if nearest >= most and farthest <= least:
        return mean, std
    if farthest < most and nearest > least:
        most, least = min(most, nearest), max(least, farthest)
    elif np.isfinite(nearest):
        most, least = nearest, farthest
    else:
        return mean, std
    return (most + least) / 2.0, max((most - least) / 4.0, 1e-3 * most)


@compiled
def _seen_from_frame(reading: Array, mean: Array, covariance: Array) -> None:
    """Take an object to where the camera at the time of its frame would have seen it: z - s d for a detection z."""
    for a in range(2):
        mean[a] -= reading[1 + a] * mean[2]
        for b in range(len(mean)):
            covariance[a, b] -= reading[1 + a] * covariance[2, b]
        for b in range(len(mean)):
            covariance[b, a] -= reading[1 + a] * covariance[b, 2]
