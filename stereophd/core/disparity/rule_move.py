"""Compiled low-order rule for moves between disparity spaces, with a measure of how well it fits.

The cubature rule (Arasaratnam and Haykin 2009; the unscented transform with kappa = 0) carries the points
mean +- sqrt(n) L e_i of the n coordinates of state and motion noise over. The even part of the map along each,

    s_i = (f(+i) + f(-i)) / 2 - f(mean),

vanishes for a linear map. With the covariance P of the images,

    N = sqrt(sum_i s_i' P^-1 s_i) / n

measures the non-linearity of the map over the Gaussian: the curvature of one standard deviation, in standard
deviations of the result. Where N is small the rule is as good as any number of samples.

The first-order move, the extended Kalman filter's, is the same rule with points that are `STEP` times as far from the
mean: their differences are the Jacobian of the trip.
"""

import math

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW, Moved, Sources
from stereophd.core.disparity.trips import interval_trips, region_mask, view_mask
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, condition, squared_distance
from stereophd.core.numerics.moments import weighted_moments

# A point of the rule represents no share of the Gaussian, so none may be outside the region.
NO_SLACK = 1.0
# Of a linear move. The error of a difference is 8e-8 of the third derivative, and 3e-13 of the values by rounding.
STEP = 2e-4


@compiled
def rule_components(
    sources: Sources,
    points: Array,
    axes: Array,
    destination: Array,
    region: Array,
    widest: float,
    max_nonlinearity: float,
    moved: Moved,
) -> NDArray[np.intp]:
    """Move components by the rule; return those (in order) that need samples instead.

    These are the components with a point outside the image or the region (a few points do not show which part of a
    Gaussian is in view), and those for which the measure exceeds `max_nonlinearity`; those whose disparity is known no
    better than to the fraction `widest` are not tried. The points (rows, 2 n + 1) are the positive ones, then their
    mirror images, then the mean; `axes` (3, 3) are those of `motion_noise`. Other parameters are those of
    `stereophd.core.disparity.sample_move.carry_components`; `moved` is filled where the rule does.
    """
    means, covariances, homes, motion = sources
    out_means, out_covariances, fraction, status, _, _, inside = moved
    size = means.shape[1]
    count = points.shape[1]
    images = np.empty((size + 1, count))
    kept = np.empty((size, count))
    mask = np.empty(count)
    weights = np.ones(count)
    weights[count - 1] = 0.0
    unit = np.ones(count)
    scratch_weights = np.empty(count)
    factor = np.empty((size, size))
    scratch = np.empty((size, size))
    noise = np.empty((6, count if size == 6 else 0))
    shape = np.full(2, np.nan)
    todo = np.empty(len(means), dtype=np.intp)
    n_todo = 0
    for k in range(len(means)):
        todo[n_todo] = k
        n_todo += 1
        status[k], fraction[k], inside[k] = OUT_OF_VIEW, 0.0, 1.0
        if covariances[k, 2, 2] > (widest * means[k, 2]) ** 2 or not cholesky(covariances[k], factor):
            continue
        interval_trips(means[k], factor, points, axes, shape, noise, k, motion, homes[k], destination, images)
        if view_mask(images, destination, mask) < count:
            continue
        if (
            len(region) > 0
            and region_mask(images, destination, homes[k], region, NO_SLACK, unit, scratch_weights) < 1.0
        ):
            continue
        kept[:] = images[:size]
        weighted_moments(images, weights, count - 1.0, out_means[k], out_covariances[k])
        if not condition(out_covariances[k], scratch):
            continue
        if max_nonlinearity < np.inf:
            cholesky(out_covariances[k], scratch)
            if not _nonlinearity(kept, scratch) <= max_nonlinearity:
                continue
        status[k], fraction[k] = IN_VIEW, 1.0
        n_todo -= 1
    return todo[:n_todo]


@compiled
def _nonlinearity(images: Array, factor: Array) -> float:
    """The measure N of images (d, 2 n + 1), given the Cholesky factor of their covariance (d, d)."""
    size, count = images.shape
    half = (count - 1) // 2
    total = 0.0
    even, scratch = np.empty(size), np.empty(size)
    for i in range(half):
        for a in range(size):
            even[a] = 0.5 * (images[a, i] + images[a, half + i]) - images[a, count - 1]
        total += squared_distance(even, factor, scratch)
    return float(math.sqrt(total) / half)
