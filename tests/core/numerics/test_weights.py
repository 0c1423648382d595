"""Weights, effective size, systematic resampling."""

from __future__ import annotations

import numpy as np

from stereophd.core.numerics.resampling import systematic
from stereophd.core.numerics.weights import (
    effective_sample_size,
    normalised,
    step_generator,
    weighted_mean_covariance,
)


def test_weights_are_normalised_in_logarithms() -> None:
    log_weights, total = normalised(np.array([-1e5, -1e5 + np.log(3.0), -np.inf, np.nan]))
    np.testing.assert_allclose(np.exp(log_weights), [0.25, 0.75, 0.0, 0.0], atol=1e-11)
    np.testing.assert_allclose(total, -1e5 + np.log(4.0))
    np.testing.assert_allclose(effective_sample_size(log_weights), 1.6)


def test_where_nothing_is_possible_nothing_is_learnt() -> None:
    log_weights, total = normalised(np.array([-np.inf, -np.inf]))
    np.testing.assert_allclose(np.exp(log_weights), 0.5)
    assert total == -np.inf


def test_systematic_resampling_takes_the_whole_part_of_each_expectation() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        log_weights, _ = normalised(4.0 * rng.standard_normal(40))
        found = np.bincount(systematic(np.exp(log_weights), rng.random(1)), minlength=40)
        expected = 40 * np.exp(log_weights)
        assert found.sum() == 40
        assert ((found >= np.floor(expected - 1e-9)) & (found <= np.ceil(expected + 1e-9))).all()


def test_moments_are_those_of_the_weighted_particles() -> None:
    values = np.random.default_rng(2).standard_normal((7, 3))
    weights = np.array([1, 2, 0, 1, 3, 1, 1])
    mean, covariance = weighted_mean_covariance(values, np.log(np.maximum(weights, 1e-300) / weights.sum()))
    repeated = np.repeat(values, weights, axis=0)
    np.testing.assert_allclose(mean, repeated.mean(axis=0))
    np.testing.assert_allclose(covariance, np.cov(repeated.T, bias=True))


def test_streams_of_steps_differ_and_repeat() -> None:
    seed = np.random.SeedSequence(5, spawn_key=(3,))
    draws = [step_generator(seed, step).random() for step in (0, 1, 0)]
    assert draws[0] == draws[2] != draws[1]
    assert step_generator(np.random.SeedSequence(5), 0).random() != draws[0]
