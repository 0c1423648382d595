"""Compiled linear algebra of small matrices: factors, ranks, and what keeps covariances positive definite."""

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.numerics.compilation.compiled import compiled

# A covariance has full rank if it still factorises with its diagonal lowered by this fraction: a bound on single pivots
# is not enough, because after a small pivot the rounding of the next one can exceed it.
RANK_MARGIN = 1e-12


@compiled
def cholesky(matrix: Array, factor: Array) -> bool:
    """Lower Cholesky factor of a symmetric matrix (d, d); False if it is not positive definite."""
    size = matrix.shape[0]
    for j in range(size):
        for i in range(j, size):
            total = matrix[i, j]
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
def has_full_rank(matrix: Array, factor: Array) -> bool:
    """Whether a symmetric matrix (d, d) is positive definite with a margin; `factor` is scratch.

    The pivots of the factorisation L D L^T, without its square roots; L D is kept above the diagonal.
    """
    size = matrix.shape[0]
    for j in range(size):
        pivot = matrix[j, j] * (1.0 - RANK_MARGIN)
        for k in range(j):
            pivot -= factor[j, k] * factor[k, j]
        if not 0.0 < pivot < np.inf:
            return False
        per_pivot = 1.0 / pivot
        for i in range(j + 1, size):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[k, j]
            factor[j, i] = total
            factor[i, j] = total * per_pivot
    return True


@compiled
def condition(matrix: Array, factor: Array) -> bool:
    """Make a covariance positive definite in place; False if it holds NaN or cannot be helped.

    The diagonal is raised by growing fractions of itself, from 1e-9 to 1e-3, until the factorisation
    succeeds: a covariance that leaves the moment transforms always has full rank.
    """
    if has_full_rank(matrix, factor):
        return True
    raised = 1e-9
    while raised < 2e-3:
        for j in range(matrix.shape[0]):
            if not matrix[j, j] > 0.0 or matrix[j, j] == np.inf:
                return False
            matrix[j, j] *= 1.0 + raised
        if has_full_rank(matrix, factor):
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
