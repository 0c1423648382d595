"""Compiled linear algebra of small matrices: factors, ranks, and what keeps covariances positive definite."""

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.numerics.compilation.compiled import compiled

# A covariance has full rank if it still factorises with its diagonal lowered by this fraction: a bound on single pivots
# is not enough, because after a small pivot the rounding of the next one can exceed it.
RANK_MARGIN = 1e-12


@compiled
def cholesky(matrix: Array, factor: Array, margin: float = 0.0) -> bool:
    """Lower Cholesky factor of a symmetric matrix (d, d); False if it is not positive definite, with a margin.

    The diagonal counts as lower by the margin, as a part of itself.
    """
    size = matrix.shape[0]
    for j in range(size):
        for i in range(j, size):
            total = matrix[i, j] * (1.0 - margin if i == j else 1.0)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not 0.0 < total < np.inf:
                    return False
                factor[j, j] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
        for k in range(j + 1, size):
            factor[j, k] = 0.0
    return True


@compiled
def condition(matrix: Array, factor: Array) -> bool:
    """Make a covariance positive definite in place; False if it holds NaN or cannot be helped.

    The diagonal is raised by growing fractions of itself, from 1e-9 to 1e-3, until the factorisation
    succeeds: a covariance that leaves the moment transforms always has full rank.
    """
    if cholesky(matrix, factor, RANK_MARGIN):
        return True
    raised = 1e-9
    while raised < 2e-3:
        for j in range(matrix.shape[0]):
            if not matrix[j, j] > 0.0 or matrix[j, j] == np.inf:
                return False
            matrix[j, j] *= 1.0 + raised
        if cholesky(matrix, factor, RANK_MARGIN):
            return True
        raised *= 10.0
    return False


@compiled
def squared_distance(difference: Array, factor: Array, scratch: Array) -> float:
    """Squared Mahalanobis distance of a difference (d,), given the Cholesky factor (d, d)."""
    total = 0.0
    for a in range(difference.shape[0]):
        value = difference[a]
        for b in range(a):
            value -= factor[a, b] * scratch[b]
        scratch[a] = value / factor[a, a]
        total += scratch[a] * scratch[a]
    return total
