"""Normal equations of the bundle adjustment, accumulated detection by detection (compiled)."""

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled

# Losses of `accumulate`: none, Cauchy at a scale, and a normal density on a floor of false detections.
SQUARED, CAUCHY, FLOOR = 0, 1, 2
# Squared distance that a detection of a point behind its camera counts as.
BEHIND = 1e4


@compiled
def substitute_forward(factor: Array, right: Array) -> None:
    """Solve L x = b for many right sides (6 k, m) in place, with the Cholesky factor L, its columns as rows (6 k, 12).

    LAPACK reads the factor anew for each right side.
    """
    size, width = factor.shape
    for j in range(size):
        row = right[j]
        for c in range(row.shape[0]):
            row[c] /= factor[j, 0]
        for k in range(1, min(width, size - j)):
            below, part = right[j + k], factor[j, k]
            for c in range(row.shape[0]):
                below[c] -= part * row[c]


@compiled
def substitute_back(factor: Array, right: Array) -> None:
    """Solve L^T x = b for many right sides (6 k, m) in place, as `substitute_forward` does L x = b."""
    size, width = factor.shape
    for j in range(size - 1, -1, -1):
        row = right[j]
        for k in range(1, min(width, size - j)):
            below, part = right[j + k], factor[j, k]
            for c in range(row.shape[0]):
                row[c] -= part * below[c]
        for c in range(row.shape[0]):
            row[c] /= factor[j, 0]


@compiled
def add_points(knots: Integers, weights: Array, pulls: Array, matrices: Array, bands: Array) -> None:
    """Add matrices of points that knots interpolate with weights (n, 4) to that of the knots (12, 6 k).

    Those are the matrices (n, 2, 3, 3), summed with `pulls` (n, 2).
    """
    for n in range(len(knots)):
        start = 6 * knots[n]
        for b in range(4):
            for b2 in range(b + 1):
                weight = weights[n, b] * weights[n, b2]
                if weight == 0.0:
                    continue
                for a in range(3):
                    for a2 in range(3):
                        row, column = start + 3 * b + a, start + 3 * b2 + a2
                        if column <= row:
                            pulled = pulls[n, 0] * matrices[n, 0, a, a2] + pulls[n, 1] * matrices[n, 1, a, a2]
                            bands[row - column, column] += weight * pulled


@compiled
def accumulate(
    cameras: Integers,
    errors: Array,
    visible: NDArray[np.bool_],
    precisions: Array,
    counted: Array,
    by_point: Array,
    by_value: Array,
    knots: Integers,
    weights: Array,
    columns: Integers,
    loss: int,
    loss_scale: float,
    bands: Array,
    coupling: Array,
    camera_matrix: Array,
    state_vector: Array,
    camera_vector: Array,
    distances: Array,
) -> float:
    """Add the detections to the normal equations, and return their robust cost.

    With residuals e = z - projection, their precision P, the derivatives J of the projection, and the derivative w of
    the loss times the weight of the detection: matrix += w J^T P J and vector += w J^T P e.

    Parameters
    ----------
    cameras : array (n,)
        Index of the camera of each detection.
    errors, visible, precisions : arrays (n, 2), (n,) of bool, (n, 2, 2)
        Residuals in pixels, whether the camera can see the point, and inverse covariances.
    counted : array (n,)
        Weight of each detection in the cost.
    by_point, by_value : arrays (n, 2, 3), (n, 2, q)
        Derivatives of the projection with respect to the point in the world, and to the values of its camera.
    knots, weights : arrays (n,), (n, 4)
        From `trajectories.interpolation`.
    columns : array (c, q)
        Place of each camera's values among the parameters, -1 where known.
    loss, loss_scale
        Kind of the loss and its scale (`CAUCHY`: in standard deviations; `FLOOR`: height of the floor
        relative to the peak of the density).
    bands, coupling, camera_matrix, state_vector, camera_vector : arrays
        (12, 6 k), (6 k, m), (m, m), (6 k,), (m,): added to.
    distances : array (n,)
        Set to the squared Mahalanobis distance of every detection, `BEHIND` where the camera cannot see the point.
    """
    cost = 0.0
    n_params, n_values = camera_vector.shape[0], by_value.shape[2]
    pj, jpj, pulled = np.empty((2, 3)), np.empty((3, 3)), np.empty(3)
    pc, across = np.empty((2, n_values)), np.empty((3, n_values))
    for n in range(cameras.shape[0]):
        share = counted[n]
        used = 4 if weights[n, 2] != 0.0 or weights[n, 3] != 0.0 else 2
        if not visible[n]:
            distances[n] = BEHIND
            if loss == FLOOR:
                cost += -2.0 * share * np.log(loss_scale)
            elif loss == CAUCHY:
                cost += share * loss_scale**2 * np.log(1.0 + BEHIND / loss_scale**2)
            else:
                cost += share * BEHIND
            continue
        e, jp, jc, places = errors[n], by_point[n], by_value[n], columns[cameras[n]]
        p00, p01, p11 = precisions[n, 0, 0], precisions[n, 0, 1], precisions[n, 1, 1]
        distance = p00 * e[0] * e[0] + 2.0 * p01 * e[0] * e[1] + p11 * e[1] * e[1]
        distances[n] = distance
        w = share
        if loss == CAUCHY:
            cost += share * loss_scale**2 * np.log(1.0 + distance / loss_scale**2)
            w = share / (1.0 + distance / loss_scale**2)
        elif loss == FLOOR:
            peak = np.exp(-0.5 * distance)
            cost += -2.0 * share * np.log(peak + loss_scale)
            w = share * peak / (peak + loss_scale)
        else:
            cost += share * distance
        p00, p01, p11 = w * p00, w * p01, w * p11
        pe0, pe1 = p00 * e[0] + p01 * e[1], p01 * e[0] + p11 * e[1]
        for a in range(3):
            pj[0, a] = p00 * jp[0, a] + p01 * jp[1, a]
            pj[1, a] = p01 * jp[0, a] + p11 * jp[1, a]
            pulled[a] = jp[0, a] * pe0 + jp[1, a] * pe1
        for a in range(3):
            for a2 in range(3):
                jpj[a, a2] = jp[0, a] * pj[0, a2] + jp[1, a] * pj[1, a2]
        start = 6 * knots[n]
        for b in range(used):
            for a in range(3):
                state_vector[start + 3 * b + a] += weights[n, b] * pulled[a]
            for b2 in range(b + 1):
                both, below, column = weights[n, b] * weights[n, b2], 3 * (b - b2), start + 3 * b2
                for a in range(3):
                    for a2 in range(3 if b2 < b else a + 1):
                        bands[below + a - a2, column + a2] += both * jpj[a, a2]
        if n_params == 0:
            continue
        for i in range(n_values):
            pc[0, i] = p00 * jc[0, i] + p01 * jc[1, i]
            pc[1, i] = p01 * jc[0, i] + p11 * jc[1, i]
            for a in range(3):
                across[a, i] = pj[0, a] * jc[0, i] + pj[1, a] * jc[1, i]
        for i in range(n_values):
            column = places[i]
            if column < 0:
                continue
            camera_vector[column] += jc[0, i] * pe0 + jc[1, i] * pe1
            for i2 in range(n_values):
                if places[i2] >= 0:
                    camera_matrix[column, places[i2]] += jc[0, i] * pc[0, i2] + jc[1, i] * pc[1, i2]
        for b in range(used):
            for a in range(3):
                row = start + 3 * b + a
                for i in range(n_values):
                    if places[i] >= 0:
                        coupling[row, places[i]] += weights[n, b] * across[a, i]
    return cost
