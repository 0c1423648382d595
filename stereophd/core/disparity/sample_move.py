"""Compiled move of Gaussians into the disparity space of a camera (paper IV-B a-f, V-B, VI-C).

The kernels use the trips of `stereophd.core.disparity.trips`. They take samples, move them, test the field of view and
compute moments; components of which only a corner is in view are moved again with more samples.
"""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, Moved, Sources
from stereophd.core.disparity.trips import REGION_SLACK, interval_trips, region_mask, view_mask
from stereophd.core.geometry.layout import ROTATION
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.linear_algebra import cholesky, condition
from stereophd.core.numerics.moments import weighted_moments
from stereophd.core.numerics.sorting import copy_gaussian

# A component whose disparity is known to better than this fraction has no tail to look for.
WIDE_DISPARITY = 0.05


class Draws(NamedTuple):
    """Standard-normal samples with weights, for the moments of a component."""

    samples: Array  # (rows, n)
    weights: Array  # (n,)
    minimum: int  # Fewest (effective) samples in view from which a Gaussian is fitted


class EventDraws(NamedTuple):
    """Samples of an event, shared by all components: those of all, and others for corners of what is important."""

    first: Draws
    second: Draws


@compiled
def carry_components(
    which: Integers,
    sources: Sources,
    important: Booleans,
    draws: EventDraws,
    destination: Array,
    p_detect: float,
    region: Array,
    moved: Moved,
) -> None:
    """Move the components `which` into the destination's space; important ones at a corner are sampled a second time.

    Component by component, with no state shared between them: results do not depend on how the
    components are shared out over threads. Parameters as in `stereophd.core.disparity.moments.move`;
    `region` is packed as for `region_mask`, or empty; `moved` is filled in place.
    """
    move_components(which, sources, draws.first, destination, p_detect, region, moved)
    means, covariances, fraction, status = sources.means, sources.covariances, moved.fraction, moved.status
    corners = np.empty(len(which), dtype=np.int64)
    n_corners = 0
    for k in which:
        wide = covariances[k, 2, 2] > (WIDE_DISPARITY * means[k, 2]) ** 2
        if important[k] and status[k] == OUT_OF_VIEW and (wide or fraction[k] > 0.0):
            corners[n_corners] = k
            n_corners += 1
    if n_corners > 0:
        move_components(corners[:n_corners], sources, draws.second, destination, p_detect, region, moved)
    for k in which:
        if status[k] == OUT_OF_VIEW:
            fraction[k] = 0.0


@compiled
def noise_axes(destination: Array, noise_std: Array) -> Array:
    """Return the world's axes in the destination's, times the standard deviation of the noise along them (3, 3)."""
    axes = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            axes[a, b] = destination[ROTATION + 3 * a + b] * noise_std[b]
    return axes


@compiled
def move_components(
    which: Integers, sources: Sources, draws: Draws, destination: Array, p_detect: float, region: Array, moved: Moved
) -> None:
    """Move the components `which` into the destination's space and split them by the field of view.

    Component by component, with no state shared between them; parameters as in `carry_components`.
    """
    means, covariances, homes, motion = sources
    samples, sample_weights, minimum = draws
    out_means, out_covariances, fraction, status, missed_means, missed_covariances, inside = moved
    size = means.shape[1]
    count = samples.shape[1]
    points = np.empty((size + 1, count))
    mask = np.empty(count)
    seen_weights = np.empty(count)
    weights = sample_weights.copy()
    factor = np.empty((size, size))
    scratch = np.empty((size, size))
    axes = noise_axes(destination, motion.noise_std)
    noise = np.empty((6, count if size == 6 else 0))
    shape = np.full(2, np.nan)
    alike = True
    for weight in sample_weights:
        alike = alike and weight == 1.0
    for k in which:
        status[k] = OUT_OF_VIEW
        fraction[k] = 0.0
        inside[k] = 1.0
        if not cholesky(covariances[k], factor):
            continue
        interval_trips(means[k], factor, samples, axes, shape, noise, k, motion, homes[k], destination, points)
        if len(region) > 0:
            inside[k] = region_mask(points, destination, homes[k], region, REGION_SLACK, sample_weights, weights)
            if inside[k] == 0.0:
                continue
        seen = view_mask(points, destination, mask)
        if alike and inside[k] == 1.0:
            # sums of ones are exact: their number
            for i in range(count):
                seen_weights[i] = mask[i]
            whole_weight, seen_weight, unseen_weight = float(count), float(seen), float(count - seen)
            squares = seen_weight
        else:
            whole_weight, seen_weight, squares, unseen_weight = _weigh(mask, weights, seen_weights)
        fraction[k] = seen_weight / whole_weight if unseen_weight > 0.0 else 1.0
        # the effective number of samples: their count, where all weigh the same
        if seen_weight * seen_weight >= minimum * squares and seen_weight > 0.0:
            if alike and inside[k] == 1.0 and seen == count:
                weighted_moments(points, None, seen_weight, out_means[k], out_covariances[k])
            else:
                weighted_moments(points, seen_weights, seen_weight, out_means[k], out_covariances[k])
            if condition(out_covariances[k], scratch):
                status[k] = PARTLY_IN_VIEW if unseen_weight > 0.0 else IN_VIEW
        if status[k] == OUT_OF_VIEW:
            for i in range(count):
                mask[i] = 0.0
        if status[k] == PARTLY_IN_VIEW and p_detect == 0.0 and inside[k] == 1.0:
            copy_gaussian(means, covariances, k, missed_means, missed_covariances, k)
        elif status[k] == PARTLY_IN_VIEW or (status[k] == OUT_OF_VIEW and inside[k] < 1.0):
            missed_moments(
                means[k], factor, samples, weights, mask, p_detect, minimum,
                missed_means[k], missed_covariances[k]
            )  # fmt: skip
            if not condition(missed_covariances[k], scratch):
                copy_gaussian(means, covariances, k, missed_means, missed_covariances, k)


@compiled
def missed_moments(
    mean: Array,
    factor: Array,
    samples: Array,
    sample_weights: Array,
    mask: Array,
    p_detect: float,
    minimum: int,
    missed_mean: Array,
    missed_covariance: Array,
) -> None:
    """Gaussian (in its own space) of the part of a component that was not detected (paper VI-C, Fig. 8).

    The samples are weighted by their own weight times 1 - p_detect in view and 1 outside; where too few
    effective samples remain to carry a covariance, the Gaussian is kept and only its weight changes.
    """
    size = mean.shape[0]
    count = samples.shape[1]
    weights = np.empty(count)
    total, squares = _missed_weights(sample_weights, mask, p_detect, weights)
    unit_mean = np.zeros(size)
    unit_covariance = np.eye(size)
    if total * total >= minimum * squares and total > 0.0:
        # moments of states of six numbers leave the samples as they are
        points = samples if size == 6 else samples[:size].copy()
        weighted_moments(points, weights, total, unit_mean, unit_covariance)
    for a in range(size):
        missed_mean[a] = mean[a]
        for b in range(a + 1):
            missed_mean[a] += factor[a, b] * unit_mean[b]
    # the factor is lower triangular
    half = np.empty((size, size))
    for a in range(size):
        for d in range(size):
            half[a, d] = 0.0
            for c in range(a + 1):
                half[a, d] += factor[a, c] * unit_covariance[c, d]
    for a in range(size):
        for b in range(a + 1):
            value = 0.0
            for d in range(b + 1):
                value += half[a, d] * factor[b, d]
            missed_covariance[a, b] = value
            missed_covariance[b, a] = value


@compiled
def _missed_weights(sample_weights: Array, mask: Array, p_detect: float, weights: Array) -> tuple[float, float]:
    """Fill the weights (n,) of samples that were not detected; return their sum and that of their squares.

    Four sums of each kind do not wait for one another. Their order is written down: it must not depend on the caller
    (`compiled_fast`).
    """
    count = len(weights)
    for i in range(count):
        weights[i] = sample_weights[i] * (1.0 - p_detect * mask[i])
    total_a = total_b = total_c = total_d = 0.0
    squares_a = squares_b = squares_c = squares_d = 0.0
    whole = count - count % 4
    for i in range(0, whole, 4):
        a, b, c, d = weights[i], weights[i + 1], weights[i + 2], weights[i + 3]
        total_a, total_b, total_c, total_d = total_a + a, total_b + b, total_c + c, total_d + d
        squares_a, squares_b = squares_a + a * a, squares_b + b * b
        squares_c, squares_d = squares_c + c * c, squares_d + d * d
    total, squares = (total_a + total_b) + (total_c + total_d), (squares_a + squares_b) + (squares_c + squares_d)
    for i in range(whole, count):
        total += weights[i]
        squares += weights[i] * weights[i]
    return total, squares


@compiled
def _weigh(mask: Array, weights: Array, seen_weights: Array) -> tuple[float, float, float, float]:
    """Fill the weights of the samples in view; sums of all weights, of these, of their squares, and of the others."""
    whole = seen = squares = unseen = 0.0
    for i in range(len(mask)):
        weight = mask[i] * weights[i]
        seen_weights[i] = weight
        whole += weights[i]
        seen += weight
        squares += weight * weight
        unseen += (1.0 - mask[i]) * weights[i]
    return whole, seen, squares, unseen
