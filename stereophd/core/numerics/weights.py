"""Weights of particles: normalisation, effective size, moments, random streams."""

import numpy as np

from stereophd.core.arrays import Array


def normalised(log_weights: Array) -> tuple[Array, float]:
    """Normalise log-weights (k,); return them and the logarithm of their sum.

    Where no weight is above zero nothing is known: all weigh the same, and the sum is -infinity.
    """
    usable = np.where(np.isnan(log_weights), -np.inf, log_weights)
    largest = usable.max()
    if not np.isfinite(largest):
        return np.full(len(usable), -np.log(len(usable))), float(-np.inf)
    total = float(largest + np.log(np.exp(usable - largest).sum()))
    return usable - total, total


def effective_sample_size(log_weights: Array) -> float:
    """Effective number of particles, 1 / sum of squared weights, of normalised log-weights (k,)."""
    return float(1.0 / np.exp(2.0 * log_weights).sum())


def weighted_mean_covariance(values: Array, log_weights: Array) -> tuple[Array, Array]:
    """Mean (m,) and covariance (m, m) of particles (k, m) with normalised log-weights (k,)."""
    weights = np.exp(log_weights)
    mean = weights @ values
    centred = values - mean
    return mean, (weights[:, None] * centred).T @ centred


def step_generator(seed: np.random.SeedSequence, step: int) -> np.random.Generator:
    """Random numbers of one step of a sampler: the same whether it runs through or is resumed there."""
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, step)))
