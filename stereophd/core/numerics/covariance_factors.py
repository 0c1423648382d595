"""Cholesky factors of covariances, also of those that rounding has made indefinite."""

import contextlib

import numpy as np

from stereophd.core.arrays import Array

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
