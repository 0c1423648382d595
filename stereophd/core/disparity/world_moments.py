"""Compiled moments of moved Gaussians in the world."""

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.trips import WORLD, disparity_scale, interval_trips, moving_trips
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, condition
from stereophd.core.numerics.moments import weighted_moments

# In the world a Gaussian in disparity has no moments (1 / d). Samples further away than this factor times the depth of
# the mean disparity are left out.
FARTHEST_SAMPLE = 10.0


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
    size, count = means.shape[1], samples.shape[1]
    world = WORLD.copy()
    axes = np.diag(motion.noise_std)
    noise = np.empty((6, count if size == 6 else 0))
    shape = np.full(2, np.nan)
    points, weights = np.empty((size + 1, count)), np.empty(count)
    mean, covariance = np.empty(size), np.empty((size, size))
    factor, scratch = np.empty((size, size)), np.empty((size, size))
    for i in range(len(which)):
        k, row = which[i], rows[i]
        _fill_gaussian(np.nan, out_means, out_covariances, i)
        if not means[k, 2] > 0.0 or not cholesky(covariances[k], factor):
            continue
        interval_trips(means[k], factor, samples, axes, shape, noise, row, motion, homes[row], world, points)
        least, total = means[k, 2] / (FARTHEST_SAMPLE * disparity_scale(homes[row])), 0.0
        for j in range(count):
            weights[j] = 1.0 if points[size, j] >= least else 0.0
            total += weights[j]
        weighted_moments(points, weights, total, mean, covariance)
        if not condition(covariance, scratch):
            continue
        _fill_gaussian(0.0, out_means, out_covariances, i)
        for a in range(size):
            out_means[i, a] = mean[a]
            for b in range(size):
                out_covariances[i, a, b] = covariance[a, b]


@compiled
def states_in_world(states: Array, space: Array, motion: MotionArrays) -> Array:
    """World states (n, 6) of states (n, 3) or (n, 6) in a packed space (30,), after the only interval of `motion`.

    NaN at or beyond infinity; the velocity of a state (n, 3) is 0, and limited to the greatest speed.
    """
    count, size = states.shape
    samples, out = np.zeros((6, count)), np.empty((7, count))
    for a in range(size):
        for i in range(count):
            samples[a, i] = states[i, a] if states[i, 2] > 0.0 else np.nan
    moving_trips(
        np.zeros(6), np.eye(6), samples, np.zeros((6, count)), 0.0, 0.0, space, WORLD.copy(), motion.reach[0],
        motion.keep[0], motion.drift[0], motion.max_speed, out
    )  # fmt: skip
    return out[:6].T.copy()


@compiled
def _fill_gaussian(value: float, means: Array, covariances: Array, k: int) -> None:
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
