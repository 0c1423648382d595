"""Detections that share an error: cells, components of variance, and what a fit absorbs of them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.problem import Observations, Problem
from stereophd.core.calibration.adjustment.shared_errors import cells_of, shared_errors, variance_components
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.annealing import fits
from stereophd.core.calibration.annealing.task import Fit
from tests.core.calibration.adjustment.test_solver import solve
from tests.core.calibration.problems_of_unknowns import some_problem
from tests.core.calibration.scenes import MadeUp, make_problem


def test_cells_are_runs_within_a_radius_of_their_first_detection() -> None:
    points = np.array([[0.0, 0.0], [3.0, 4.0], [9.0, 0.0], [10.0, 0.0], [0.0, 0.0], [50.0, 50.0]])
    count = len(points)
    observations = Observations(
        np.array([0, 0, 0, 0, 0, 1]), np.zeros(count, dtype=np.int64), np.arange(count, dtype=np.float64), points,
        np.zeros((count, 2, 2)), np.zeros(count), np.zeros(count),
    )  # fmt: skip
    cells = cells_of(observations, 5.5)
    assert (np.diff(cells) != 0).tolist() == [False, True, False, True, True]
    assert len(np.unique(cells)) == 4
    # the order of the rows does not matter
    order = np.array([5, 3, 1, 4, 2, 0])
    shuffled = replace(
        observations, trajectories=observations.trajectories[order], times=observations.times[order],
        points=points[order],
    )  # fmt: skip
    assert (cells_of(shuffled, 5.5) == cells[order]).all()


def test_components_of_variance_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    cells = np.repeat(np.arange(400), rng.integers(1, 40, 400))
    residuals = 0.4 * rng.standard_normal((len(cells), 2)) + 0.8 * rng.standard_normal((400, 2))[cells]
    own, shared = variance_components(residuals, cells)
    np.testing.assert_allclose(np.sqrt([own, shared]), [0.4, 0.8], rtol=0.06)
    assert variance_components(residuals, np.arange(len(cells)))[1] == 0.0


def with_shared_errors(size: float) -> tuple[Problem, np.ndarray, np.ndarray]:
    """A fit to detections whose errors are shared in cells of 40 pixels, beside errors of their own."""
    made = make_problem(3, objects=12)
    observations = made.observations
    cells = cells_of(observations, 40.0)
    errors = size * np.random.default_rng(2).standard_normal((int(cells.max()) + 1, 2))[cells]
    made = MadeUp(**{**vars(made), "observations": replace(observations, points=observations.points + errors)})
    problem, found = solve(made)
    return problem, found.values, found.states


def test_errors_of_their_own_keep_their_weight_and_shared_ones_lose_it() -> None:
    problem, values, states = with_shared_errors(0.0)
    found = shared_errors(Linearisation.of(problem), values, states, 40.0, np.random.default_rng(0))
    assert (found.shared == 0.0).all()
    assert (found.weights == 1.0).all()
    problem, values, states = with_shared_errors(3.0)
    found = shared_errors(Linearisation.of(problem), values, states, 40.0, np.random.default_rng(0))
    assert (found.shared > 1.5).all()
    assert (found.shared < 5.0).all()
    assert found.weights.mean() < 0.5


def test_a_detection_of_weight_two_counts_as_two() -> None:
    made = make_problem(3, objects=3)
    problem, found = solve(made)
    rows = np.concatenate([np.arange(len(made.observations))] * 2)
    fields = {name: value[rows] for name, value in vars(made.observations).items() if value is not None}
    twice = Observations(**fields)
    weighted = replace(made.observations, weights=np.full(len(made.observations), 2.0))
    one = adjust(replace(problem, observations=twice), found.values, found.states)
    other = adjust(replace(problem, observations=weighted), found.values, found.states)
    np.testing.assert_allclose(one.values, other.values, atol=1e-9)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6)


@pytest.mark.parametrize(("size", "shared"), [(0.0, False), (0.6, True)])
def test_errors_that_the_marginal_optimum_shows_to_be_shared_count_less(
    monkeypatch: pytest.MonkeyPatch, size: float, shared: bool
) -> None:
    problem, states, values = some_problem(("center", "rotation"))
    observations, rows = problem.observations, np.arange(len(problem.observations))
    cells = cells_of(observations, 40.0)
    errors = size * np.random.default_rng(2).standard_normal((int(cells.max()) + 1, 2))[cells]
    observations = replace(observations, points=observations.points + errors)
    problem = replace(problem, observations=observations)
    joint = Fit(adjust(problem, values, states), problem.knots, observations, rows)
    task: Any = SimpleNamespace(
        parameters=problem.parameters, reference=problem.reference, scale=problem.scale,
        settings=SimpleNamespace(shared_error_px=40.0), recording=SimpleNamespace(pixels=observations.points),
        filter=SimpleNamespace(motion=problem.knots.motion),
    )  # fmt: skip
    monkeypatch.setattr(fits, "refitted", lambda task, fit, **_: weighed(task, fit))
    found, _ = fits.stated_fit(task, joint)
    if shared:
        assert found.observations.weights is not None
        assert found.observations.weights.min() < 0.5
    else:
        assert found.observations.weights is None
        np.testing.assert_array_equal(found.adjustment.values, fits.marginal_fit(task, joint)[0].adjustment.values)


def weighed(task: Any, fit: Fit) -> Fit:
    """The fit with the weights that its residuals show, its detections as they are."""
    weights = fits._weights(task, fit, fit.observations, fit.detections)
    return replace(fit, observations=replace(fit.observations, weights=weights))
