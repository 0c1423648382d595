"""Gaussians in disparity space as mean and covariance in the world."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.disparity.moments import world_moments
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from tests.core.disparity.cases import (
    in_deviations,
    make_camera,
    make_space,
    oracle_world,
    random_covariance,
    state_in,
    weighted,
)
from tests.core.disparity.moves import monte_carlo_margins, reference_samples, sample_sets


@pytest.mark.parametrize("method", ["qmc", "particle"])
@pytest.mark.parametrize(("rectification", "dt"), [("horizontal", 0.0), ("vertical", 2.0), ("horizontal", -1.0)])
def test_world_moments_against_sampling(method: str, rectification: str, dt: float) -> None:
    """Also with samples at and beyond infinity, which are left out by the stated rule."""
    space = make_space(make_camera((0.2, -0.3, 0.1), (5.0, 6.0, 7.0)), 1.0, rectification)
    motion = ConstantVelocity([0.5, 0.1, 0.3], max_speed=8.0)
    sets = sample_sets(method, 4096, motion)
    for std in (0.3, 4.0):
        mean = state_in(space, [*space.camera.pose.to_world([[3.0, -2.0, 120.0]])[0].tolist(), 1.0, 2.0, -1.0])
        covariance = random_covariance(np.random.default_rng(10), [2.0, 2.0, std, 4.0, 4.0, 0.2])
        samples = reference_samples()
        disparity = mean[2] + samples[:6].T @ np.linalg.cholesky(covariance)[2]
        kept = disparity >= mean[2] / 10.0
        assert kept.all() == (std == 0.3)
        world = oracle_world(mean, covariance, samples, space, dt, motion)[kept]
        found_mean, found = world_moments(
            mean[None], covariance[None], space.packed()[None], np.array([dt]), motion, sets, 0
        )
        margin, variance_margin = monte_carlo_margins(world, 4096 * kept.mean())
        expected = np.cov(world.T)
        assert in_deviations(found_mean[0] - world.mean(axis=0), expected).max() < margin
        assert (np.abs(np.diag(found[0]) / np.diag(expected) - 1.0) < variance_margin).all()
        error = in_deviations(found[0] - expected, expected)
        assert (error < np.sqrt(np.outer(variance_margin, variance_margin))).all()


def test_world_moments_of_the_same_samples() -> None:
    space = make_space(make_camera((0.2, -0.3, 0.1), (5.0, 6.0, 7.0)), 0.5, "vertical")
    motion = ConstantVelocity([0.5, 0.1, 0.3], max_speed=3.0)
    sets = sample_sets("qmc", 64, motion)
    mean = state_in(space, [*space.camera.pose.to_world([[3.0, -2.0, 120.0]])[0].tolist(), 1.0, 2.0, -1.0])
    covariance = random_covariance(np.random.default_rng(10), [2.0, 2.0, 0.3, 4.0, 4.0, 0.2])
    for dt in (0.0, 1.5, -0.5):
        world = oracle_world(mean, covariance, sets.turn(7), space, dt, motion)
        found_mean, found = world_moments(
            mean[None], covariance[None], space.packed()[None], np.array([dt]), motion, sets, 7
        )
        expected_mean, expected = weighted(world, np.ones(64))
        np.testing.assert_allclose(found_mean[0], expected_mean, rtol=1e-9)
        assert in_deviations(found[0] - expected, expected).max() < 1e-9


def test_world_moments_of_static_objects() -> None:
    space, motion = make_space(make_camera((0.2, -0.3, 0.1), (5.0, 6.0, 7.0))), Static()
    sets = sample_sets("qmc", 256, motion)
    mean, covariance = np.array([300.0, 200.0, 8.0]), np.diag([2.0, 2.0, 0.5]) ** 2
    found_mean, found = world_moments(
        mean[None], covariance[None], space.packed()[None], np.array([3.0]), motion, sets, 0
    )
    world = space.to_world(mean + sets.turn(0).T * [2.0, 2.0, 0.5])
    np.testing.assert_allclose(found_mean[0, :3], world.mean(axis=0), rtol=1e-10)
    np.testing.assert_allclose(found[0, :3, :3], np.cov(world.T, bias=True), rtol=1e-9, atol=1e-9)
    assert not found_mean[0, 3:].any()
    assert not found[0, 3:].any()
    assert not found[0, :, 3:].any()


@pytest.mark.parametrize("disparity", [0.0, -1.0])
def test_objects_at_infinity_have_no_place(disparity: float) -> None:
    space, motion = make_space(make_camera()), ConstantVelocity([0.1] * 3)
    mean = np.array([[400.0, 300.0, disparity, 0.0, 0.0, 0.0], [400.0, 300.0, 5.0, 0.0, 0.0, 0.0]])
    found_mean, found = world_moments(
        mean, np.stack([np.eye(6)] * 2), np.stack([space.packed()] * 2), np.zeros(2), motion,
        sample_sets("qmc", 64, motion), 0,
    )  # fmt: skip
    assert np.isnan(found_mean[0]).all()
    assert np.isnan(found[0]).all()
    assert np.isfinite(found_mean[1]).all()
