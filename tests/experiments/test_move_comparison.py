"""Moves compared with a large sample (paper, Figures 4 and 7)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.experiments.kinds.move import (
    MoveCase,
    compare_move,
    gaussian_divergence,
    gaussian_of_object,
    reference_moments,
)
from tests.core.single import scenes

# How far the image reaches on all sides where its border must have no effect, px.
WIDE = 10_000_000


def figure_four() -> MoveCase:
    camera = scenes.camera("left", 0.0, 0.0)
    wide = replace(camera, cx=camera.cx + WIDE, cy=camera.cy + WIDE, width=2 * WIDE, height=2 * WIDE)
    space = DisparitySpace(wide)
    point, stds = np.array([400.0 + WIDE, 300.0 + WIDE, 7.0]), np.array([4.0, 4.0, 2.0])
    mean, covariance = gaussian_of_object(space, point, stds, np.array([2.0, 2.0, 0.5]), 0.5, np.random.default_rng(1))
    return MoveCase(space, space, mean, covariance, 15.0, ConstantVelocity([math.sqrt(0.08)] * 3, 6.0))


def test_divergence() -> None:
    mean, covariance = np.array([1.0, -2.0]), np.array([[2.0, 0.3], [0.3, 1.0]])
    assert gaussian_divergence(mean, covariance, mean, covariance) == pytest.approx(0.0, abs=1e-12)
    # one dimension: (r - 1 - ln r) / 2 + m^2 / (2 s^2)
    value = gaussian_divergence(np.zeros(1), np.eye(1), np.array([1.0]), 4.0 * np.eye(1))
    assert value == pytest.approx(0.5 * (0.25 - 1.0 + math.log(4.0)) + 1.0 / 8.0)


def test_gaussian_of_object() -> None:
    space = DisparitySpace(scenes.camera("left", 0.0, 0.0))
    point, stds = np.array([450.0, 300.0, 7.0]), np.array([2.0, 2.0, 0.1])
    mean, covariance = gaussian_of_object(space, point, stds, np.array([1.0, 0.0, 2.0]), 0.3, np.random.default_rng(2))
    np.testing.assert_allclose(mean[:3], point, atol=5.0 * 2.0 / math.sqrt(200_000))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[:3], stds, rtol=0.02)
    exact = space.from_world(np.array([[*space.to_world(point[None])[0], 1.0, 0.0, 2.0]]))[0]
    np.testing.assert_allclose(mean[3:], exact[3:], rtol=0.01, atol=0.01)


def test_where_the_map_is_linear_all_methods_agree() -> None:
    space = DisparitySpace(scenes.camera("left", 0.0, 0.0))
    stds = np.array([0.1, 0.1, 1e-3])
    mean, covariance = gaussian_of_object(
        space, np.array([420.0, 310.0, 8.0]), stds, np.ones(3), 1e-3, np.random.default_rng(3)
    )
    case = MoveCase(space, space, mean, covariance, 0.5, ConstantVelocity([1e-4] * 3))
    reference = reference_moments(case, np.random.default_rng(4), 400_000)
    rng, methods = np.random.default_rng(5), ("linear", "unscented", "qmc")
    for moved in [compare_move(case, method, 64, reference, rng) for method in methods]:  # type: ignore[arg-type]
        # 27 moments of a sample, each known to 1 / sqrt(n): the divergence is about 27 / (2 n)
        assert moved.divergence < 5.0 * 27 / (2 * 400_000)


def test_ranking_where_it_is_not() -> None:
    """Samples beat sigma points beat linearisation; pseudo-random draws of the same number lose to Sobol points."""
    case = figure_four()
    reference = reference_moments(case, np.random.default_rng(4), 150_000)
    again = reference_moments(case, np.random.default_rng(5), 150_000)
    own = gaussian_divergence(reference.mean, reference.covariance, again.mean, again.covariance)
    methods = [("qmc", 1024), ("qmc", 64), ("unscented", 64), ("linear", 64)]
    rng = np.random.default_rng(6)
    moved = [compare_move(case, *method, reference, rng) for method in methods]  # type: ignore[arg-type]
    large, small, unscented, linear = (m.divergence for m in moved)
    assert own < large < small < unscented < linear
    rng = np.random.default_rng(7)
    draws = [compare_move(case, "particle", 64, reference, rng).divergence for _ in range(20)]
    assert small < min(draws)


def test_part_in_view_only() -> None:
    half = math.pi / 8
    left, right = (DisparitySpace(scenes.camera(n, x, y)) for n, x, y in (("l", -100, -half), ("r", 100, half)))
    mean, covariance = gaussian_of_object(
        left, np.array([400.0, 300.0, 3.0]), np.array([5.0, 5.0, 1.5]), np.zeros(3), 0.17, np.random.default_rng(1)
    )
    case = MoveCase(left, right, mean, covariance, 0.0, ConstantVelocity([0.0] * 3))
    reference = reference_moments(case, np.random.default_rng(2), 200_000)
    moved = compare_move(case, "qmc", 1024, reference, np.random.default_rng(3))
    assert 0.2 < reference.fraction < 0.95
    assert moved.fraction == pytest.approx(reference.fraction, abs=0.02)
    assert moved.divergence < 0.05
    away = MoveCase(left, DisparitySpace(scenes.camera("back", 0.0, math.pi)), mean, covariance, 0.0, case.motion)
    with pytest.raises(ValueError, match="out of view"):
        reference_moments(away, np.random.default_rng(2), 20_000)
