"""Compiled moments of weighted samples, and of mixtures."""

from stereophd.core.arrays import Array
from stereophd.core.numerics.compilation.compiled import compiled, compiled_fast


@compiled
def weighted_moments(points: Array, weights: Array | None, total: float, mean: Array, covariance: Array) -> None:
    """Mean (d,) and covariance (d, d) of the columns of points (>= d, n); may overwrite points.

    Columns of weight 0 may hold NaN or infinity. Without weights (None) all columns weigh 1, which takes three quarters
    of the time.
    """
    if mean.shape[0] == 6:
        _moving_moments(points, weights, total, mean, covariance)
    else:
        _any_moments(points, weights, total, mean, covariance)


@compiled
def add_part(share: float, mean: Array, covariance: Array, about: Array, total: Array) -> None:
    """Add to `total` (d, d) the share of a Gaussian (d,), (d, d) in the second moments of a mixture about a point."""
    for a in range(len(about)):
        for b in range(len(about)):
            total[a, b] += share * (covariance[a, b] + (mean[a] - about[a]) * (mean[b] - about[b]))


@compiled
def _any_moments(points: Array, weights: Array | None, total: float, mean: Array, covariance: Array) -> None:
    """`weighted_moments` of states of any size."""
    size = mean.shape[0]
    samples = points.shape[1]
    for a in range(size):
        row = points[a]
        shift = 0.0
        for i in range(samples):
            weight = 1.0 if weights is None else weights[i]
            shift += row[i] * weight if weight > 0.0 else 0.0
        shift /= total
        mean[a] = shift
        for i in range(samples):
            weight = 1.0 if weights is None else weights[i]
            row[i] = row[i] - shift if weight > 0.0 else 0.0
    for a in range(size):
        row = points[a]
        for b in range(a + 1):
            other = points[b]
            second = 0.0
            for i in range(samples):
                weight = 1.0 if weights is None else weights[i]
                second += weight * row[i] * other[i]
            covariance[a, b] = second / total
            covariance[b, a] = covariance[a, b]


@compiled_fast
def _moving_moments(points: Array, weights: Array | None, total: float, mean: Array, covariance: Array) -> None:
    """`weighted_moments` of states (6,), with all sums of a pass in registers: half the time of `_any_moments`."""
    samples = points.shape[1]
    m0 = m1 = m2 = m3 = m4 = m5 = 0.0
    for i in range(samples):
        weight = 1.0 if weights is None else weights[i]
        counts = weight > 0.0
        m0 += weight * points[0, i] if counts else 0.0
        m1 += weight * points[1, i] if counts else 0.0
        m2 += weight * points[2, i] if counts else 0.0
        m3 += weight * points[3, i] if counts else 0.0
        m4 += weight * points[4, i] if counts else 0.0
        m5 += weight * points[5, i] if counts else 0.0
    m0, m1, m2, m3, m4, m5 = m0 / total, m1 / total, m2 / total, m3 / total, m4 / total, m5 / total
    mean[0], mean[1], mean[2], mean[3], mean[4], mean[5] = m0, m1, m2, m3, m4, m5
    c00 = c10 = c11 = c20 = c21 = c22 = c30 = c31 = c32 = c33 = 0.0
    for i in range(samples):
        weight = 1.0 if weights is None else weights[i]
        counts = weight > 0.0
        a0 = points[0, i] - m0 if counts else 0.0
        a1 = points[1, i] - m1 if counts else 0.0
        a2 = points[2, i] - m2 if counts else 0.0
        a3 = points[3, i] - m3 if counts else 0.0
        w1, w2, w3 = weight * a1, weight * a2, weight * a3
        c00 += weight * a0 * a0
        c10 += w1 * a0
        c11 += w1 * a1
        c20 += w2 * a0
        c21 += w2 * a1
        c22 += w2 * a2
        c30 += w3 * a0
        c31 += w3 * a1
        c32 += w3 * a2
        c33 += w3 * a3
    c40 = c41 = c42 = c43 = c44 = c50 = c51 = c52 = c53 = c54 = c55 = 0.0
    for i in range(samples):
        weight = 1.0 if weights is None else weights[i]
        counts = weight > 0.0
        a0 = points[0, i] - m0 if counts else 0.0
        a1 = points[1, i] - m1 if counts else 0.0
        a2 = points[2, i] - m2 if counts else 0.0
        a3 = points[3, i] - m3 if counts else 0.0
        a4 = points[4, i] - m4 if counts else 0.0
        a5 = points[5, i] - m5 if counts else 0.0
        w4, w5 = weight * a4, weight * a5
        c40 += w4 * a0
        c41 += w4 * a1
        c42 += w4 * a2
        c43 += w4 * a3
        c44 += w4 * a4
        c50 += w5 * a0
        c51 += w5 * a1
        c52 += w5 * a2
        c53 += w5 * a3
        c54 += w5 * a4
        c55 += w5 * a5
    covariance[0, 0], covariance[1, 0], covariance[1, 1] = c00, c10, c11
    covariance[2, 0], covariance[2, 1], covariance[2, 2] = c20, c21, c22
    covariance[3, 0], covariance[3, 1], covariance[3, 2], covariance[3, 3] = c30, c31, c32, c33
    covariance[4, 0], covariance[4, 1], covariance[4, 2], covariance[4, 3] = c40, c41, c42, c43
    covariance[4, 4], covariance[5, 4], covariance[5, 5] = c44, c54, c55
    covariance[5, 0], covariance[5, 1], covariance[5, 2], covariance[5, 3] = c50, c51, c52, c53
    for a in range(6):
        for b in range(a + 1):
            covariance[a, b] /= total
            covariance[b, a] = covariance[a, b]
