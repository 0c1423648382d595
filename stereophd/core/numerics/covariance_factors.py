"""Cholesky factors of covariances, also of those that rounding has made indefinite."""

import contextlib

import numpy as np

from stereophd.core.arrays import Array, Booleans

# Parts of its own variances that are added to a covariance without a factor, until it has one.
SHARES = tuple(10.0**power for power in range(-15, -1))


def covariance_factor(covariance: Array) -> Array:
    """Return the lower Cholesky factor (m, m) of a covariance (m, m).

    Where one direction is known many orders of magnitude better than others (a prior or a known length with next to no
    spread), its variance is lost in the rounding of the others. The covariance then gets a small part of its own
    variances added. Raises numpy.linalg.LinAlgError when it is far from a covariance.
    """
    variances = np.diag(np.diagonal(covariance))
    for share in (0.0, *SHARES):
        with contextlib.suppress(np.linalg.LinAlgError):
            return np.asarray(np.linalg.cholesky(covariance + share * variances))
    raise np.linalg.LinAlgError("expected a covariance, found a matrix that is not positive definite")


def is_positive_definite(covariance: Array) -> Booleans:
    """Return which symmetric matrices (..., d, d) are finite and have a Cholesky factor.

    The factor itself is computed, because a matrix that is nearly singular may pass any other criterion and then have
    none.
    """
    good = np.asarray(np.isfinite(covariance).all(axis=(-2, -1)))
    flat = good.reshape(-1)
    flat[flat] = _have_factors(covariance.reshape(-1, *covariance.shape[-2:])[flat])
    return flat.reshape(good.shape)


def _have_factors(matrices: Array) -> Booleans:
    """Bisect to find the matrix for which the factorisation fails, because it fails for all if it fails for one."""
    try:
        np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        half = len(matrices) // 2
        if half == 0:
            return np.zeros(len(matrices), dtype=bool)
        return np.concatenate([_have_factors(matrices[:half]), _have_factors(matrices[half:])])
    return np.ones(len(matrices), dtype=bool)
