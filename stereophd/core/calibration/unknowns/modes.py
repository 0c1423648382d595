"""Modes of a posterior, and the mixture of Student t distributions that particles are drawn from around them."""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.covariance_factors import covariance_factor

# Degrees of freedom: tails heavier than the posterior's, finite variance.
DEGREES_OF_FREEDOM = 5.0


@dataclass(frozen=True)
class Modes:
    """Modes of the posterior, as another method has found them."""

    # `means`, `covariances`: arrays (j, m), (j, m, m): Optimum and its (Laplace) covariance.
    means: Array
    covariances: Array
    weights: Array  # (j,): Share of the particles drawn from each; positive, summing to 1

    def draw(self, count: int, spread: float, rng: np.random.Generator) -> Array:
        """Draw values (count, m) from the mixture, stratified over the modes.

        `spread` is a factor on the standard deviations of the modes.
        """
        which = np.searchsorted(np.cumsum(self.weights), (np.arange(count) + 0.5) / count)
        which = np.minimum(which, len(self.weights) - 1)
        factors = spread * np.stack([covariance_factor(covariance) for covariance in self.covariances])
        normal = rng.standard_normal((count, self.means.shape[1]))
        scale = np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, count))
        return np.asarray(self.means[which] + scale[:, None] * np.einsum("kab,kb->ka", factors[which], normal))

    def log_density(self, values: Array, spread: float) -> Array:
        """Log-density (k,) of the mixture at values (k, m)."""
        parts = [
            np.log(weight) + _log_student(values - mean, spread * covariance_factor(covariance))
            for mean, covariance, weight in zip(self.means, self.covariances, self.weights, strict=True)
        ]
        return np.asarray(np.logaddexp.reduce(parts, axis=0))

    def nearest(self, values: Array) -> Integers:
        """Mode (k,) that each of values (k, m) is nearest to, in the mode's covariance."""
        distances = [
            (np.linalg.solve(covariance_factor(covariance), (values - mean).T) ** 2).sum(axis=0)
            for mean, covariance in zip(self.means, self.covariances, strict=True)
        ]
        return np.asarray(np.argmin(distances, axis=0), dtype=np.int64)


def _log_student(differences: Array, factor: Array) -> Array:
    """Log-density (k,) of the multivariate Student t of shape L L^T at differences (k, m); Cholesky factor L."""
    size = len(factor)
    squared = (np.linalg.solve(factor, differences.T) ** 2).sum(axis=0)
    nu = DEGREES_OF_FREEDOM
    constant = gammaln(0.5 * (nu + size)) - gammaln(0.5 * nu) - 0.5 * size * np.log(nu * np.pi)
    return np.asarray(constant - np.log(np.diagonal(factor)).sum() - 0.5 * (nu + size) * np.log1p(squared / nu))
