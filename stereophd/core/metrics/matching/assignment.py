"""Base distances between sets of points, and their optimal assignment, many sets at a time.

OSPA, GOSPA and everything that is counted over matched pairs (RMSE, NEES, identity switches) start
from the same assignment (paper VIII-C; Schuhmacher, Vo and Vo 2008). Sets of equal sizes are handled
as one batch; only a set whose nearest neighbours clash goes through the assignment solver.
"""

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers


def euclidean_distances(x: Array, y: Array) -> Array:
    """Return the distances (..., m, n) of estimates (..., m, d) from the truth (..., n, d), in the unit of both."""
    difference = x[..., :, None, :] - y[..., None, :, :]
    return np.asarray(np.sqrt(np.einsum("...d,...d->...", difference, difference)))


def mahalanobis_distances(x: Array, y: Array, covariance: Array) -> Array:
    """Return ``sqrt((x - y)^T P^-1 (x - y))``, (..., m, n), with P the covariance of the estimate (paper VIII-C).

    Estimates `x` are (..., m, d), the truth `y` is (..., n, d), the covariances are (..., m, d, d). Raises ValueError
    when one of them is not positive definite.
    """
    if not is_positive_definite(covariance).all():
        raise np.linalg.LinAlgError("expected positive definite covariances")
    difference = x[..., :, None, :] - y[..., None, :, :]
    squared = np.einsum("...mni,...mij,...mnj->...mn", difference, np.linalg.inv(covariance), difference)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def is_positive_definite(covariance: Array) -> NDArray[np.bool_]:
    """Return which symmetric matrices (..., d, d) are finite and have a Cholesky factor.

    The factor itself is computed, because a matrix that is nearly singular may pass any other criterion and then have
    none.
    """
    good = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)))
    flat = good.reshape(-1)
    flat[flat] = _have_factors(covariance.reshape(-1, *covariance.shape[-2:])[flat])
    return flat.reshape(good.shape)


def _have_factors(matrices: Array) -> NDArray[np.bool_]:
    """Bisect to find the matrix for which the factorisation fails, because it fails for all if it fails for one."""
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        half = len(matrices) // 2
        if half == 0:
            return np.zeros(len(matrices), dtype=bool)
        return np.concatenate([_have_factors(matrices[:half]), _have_factors(matrices[half:])])
    return np.ones(len(matrices), dtype=bool)


def optimal_assignment(costs: Array) -> Integers:
    """Assign the rows of each finite cost matrix (k, m, n) to distinct columns (k, m) at the least total cost.

    Rows left over when m > n get -1. Raises ValueError when a cost is not finite.

    Where the least entries of the rows lie in distinct columns they are the optimum: their sum is a lower bound of
    every assignment. Only the other problems are solved (Jonker-Volgenant, as in SciPy).
    """
    if not np.isfinite(costs).all():
        raise ValueError("expected finite costs of assignment")
    problems, rows, columns = costs.shape
    if rows == 0 or columns == 0:
        return np.full((problems, rows), -1, dtype=np.int64)
    if rows > columns:
        row_of_column = optimal_assignment(costs.transpose(0, 2, 1))
        column_of_row = np.full((problems, rows), -1, dtype=np.int64)
        np.put_along_axis(column_of_row, row_of_column, np.arange(columns)[None, :], axis=1)
        return column_of_row
    nearest: Integers = costs.argmin(axis=2).astype(np.int64)
    ranked = np.sort(nearest, axis=1)
    clashes = np.flatnonzero((ranked[:, 1:] == ranked[:, :-1]).any(axis=1))
    if clashes.size:
        from scipy.optimize import linear_sum_assignment  # costly to import, often not needed

        for problem in clashes:
            nearest[problem] = linear_sum_assignment(costs[problem])[1]
    return nearest
