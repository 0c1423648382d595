"""Stretches of a log that disagree widen what is stated; those of a right model do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.marginal import marginal_optimum
from stereophd.core.calibration.adjustment.problem import SQUARED, Problem
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.adjustment.stretches import disagreement_of_stretches, widening
from stereophd.core.calibration.adjustment.trajectories import fit_states, interpolation, place_knots
from stereophd.core.geometry.lens import Lens
from tests.core.calibration.problems_of_unknowns import (
    MOTION,
    STDS,
    in_turn,
    observe,
    problem_of,
    rig,
    some_problem,
    unknowns,
)


def test_scores_of_the_stated_information_widen_nothing() -> None:
    scores = np.random.default_rng(0).standard_normal((64, 8)) / 8.0
    np.testing.assert_array_equal(widening(scores, 8.0), np.eye(8))


def test_errors_that_outlast_a_stretch_are_seen_when_stretches_are_joined() -> None:
    rng = np.random.default_rng(0)
    scores = np.repeat(rng.standard_normal((16, 3)), 4, axis=0) / 8.0
    scores[:, 0] *= 3.0
    root = widening(scores, 3.0)
    # each error is that of four stretches: the answer is 6 times as uncertain as is stated along the first direction
    assert np.linalg.norm(root[0]) == pytest.approx(6.0, rel=0.4)


@pytest.mark.parametrize("seed", range(5))
def test_what_trajectories_pull_at_neighbours_in_opposite_directions_widens_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.standard_normal((64, 6)) / 8.0
    scores[:, 0] += 1.5 * np.diff(rng.standard_normal(65)) / 8.0
    assert (scores[:, 0] ** 2).sum() > 4.0
    np.testing.assert_array_equal(widening(scores, 6.0), np.eye(6))


@pytest.mark.parametrize(("seed", "center_std"), [(0, 0.3), (1, 0.3), (1, 1.5), (2, 1.5), (3, 1.5)])
def test_stretches_of_a_right_model_agree(seed: int, center_std: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """No stretch tells the scale, however little the prior says of it."""
    monkeypatch.setitem(STDS, "center", center_std)
    problem, states, drawn = some_problem(("center", "rotation", "focal"), seed)
    marginal = marginal_optimum(problem, adjust(problem, drawn, states))
    more, factor, _ = disagreement_of_stretches(problem, marginal)
    assert factor < 1.5
    np.testing.assert_array_equal(more, more.T)


@pytest.mark.parametrize("seed", range(3))
def test_what_stretches_say_of_the_noise_of_the_motion_is_not_said_of_cameras(seed: int) -> None:
    """Objects that hover and swerve in turn: the noise of their motion differs, and the cameras are the same."""
    true = unknowns(rig("none"), ("center", "rotation", "focal"))
    drawn = 0.3 * true.sample(np.random.default_rng(seed), 1)[0]
    observations, _, points = observe(true.cameras, seed, 4, 12.0, agility=in_turn)
    seen = np.isfinite(observations.points).all(axis=1)
    problem, states = problem_of(true.about(true.guess(drawn)), observations.take(seen), points[seen])
    marginal = marginal_optimum(problem, adjust(problem, drawn, states))
    more, of_all, of_cameras = disagreement_of_stretches(problem, marginal)
    assert of_all > 2.0
    assert of_cameras < 1.5
    covariance = marginal.covariance
    widened = np.linalg.eigvals(np.linalg.solve(covariance, covariance + more)).real.max()
    assert of_cameras == pytest.approx(np.sqrt(widened), rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_knots_that_are_far_apart_let_stretches_agree(seed: int) -> None:
    """Objects that move straight need few knots, and each pair of them was counted in one of the stretches between."""
    true = unknowns(rig("none"), ("center", "rotation", "focal"))
    drawn = 0.3 * true.sample(np.random.default_rng(seed), 1)[0]
    observations, times, points = observe(true.cameras, seed, 3, 12.0, agility=np.zeros_like)
    knots = place_knots([times[observations.trajectories == j] for j in range(3)], 2.5, MOTION)
    at = interpolation(knots, observations.trajectories, times)
    states = fit_states(knots, *at, points, np.full(len(points), 1e4))
    problem = Problem(true.about(true.guess(drawn)), 0, knots, observations, SQUARED)
    marginal = marginal_optimum(problem, adjust(problem, drawn, states))
    assert disagreement_of_stretches(problem, marginal)[1] < 1.5


def test_stretches_disagree_where_an_unstated_lens_is_strong() -> None:
    true = tuple(replace(camera, lens=Lens("radial", k1=-0.4)) for camera in rig())
    observations, _, points = observe(true, 1, 4, 8.0)
    cameras = tuple(replace(camera, lens=Lens()) for camera in true)
    problem, states = problem_of(unknowns(cameras, ("center", "rotation")), observations, points)
    marginal = marginal_optimum(problem, adjust(problem, np.zeros(problem.parameters.size), states))
    more, factor, _ = disagreement_of_stretches(problem, marginal)
    assert factor > 3.0
    assert (np.linalg.eigvalsh(more) > -1e-12).all()
