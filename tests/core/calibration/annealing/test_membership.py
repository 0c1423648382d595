"""Members of trajectories: what a fit predicts of a detection without it."""

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment, adjust
from stereophd.core.calibration.annealing.membership import GATE, Predictions
from tests.core.calibration.problems_of_unknowns import some_problem


@pytest.fixture(scope="module")
def solved() -> tuple[Problem, Adjustment]:
    problem, states, drawn = some_problem(("center", "rotation", "focal", "clock_offset"))
    return problem, adjust(problem, drawn, states)


def some_rows(problem: Problem) -> np.ndarray:
    return np.arange(0, len(problem.observations), 37)


def test_a_member_is_judged_as_the_fit_without_it_would(solved: tuple[Problem, Adjustment]) -> None:
    problem, found = solved
    rows = some_rows(problem)
    member, density = Predictions.of(problem, found).judged(problem.observations.take(rows), np.ones(len(rows)))
    for number, row in enumerate(rows[:4]):
        weights = np.ones(len(problem.observations))
        weights[row] = 0.0
        without = problem.weighted(weights)
        predictions = Predictions.of(without, adjust(without, found.values, found.states))
        expected, other_density = predictions.judged(problem.observations.take(rows[number : number + 1]), np.zeros(1))
        assert member[number] == pytest.approx(expected[0], rel=0.02, abs=0.02)
        assert density[number] == pytest.approx(other_density[0], abs=0.02)


def test_cameras_that_are_wrong_within_their_uncertainty_lose_no_detections(
    solved: tuple[Problem, Adjustment],
) -> None:
    """Random set-up 5011: what the noise alone would keep agrees with the wrong cameras, and keeps them wrong."""
    problem, found = solved
    seen = problem.observations
    # one camera has made few of the detections so far
    few = np.where(seen.cameras == 2, 1e-3, 1.0)
    weighted = problem.weighted(few)
    known = adjust(weighted, found.values, found.states)
    eigenvalues, vectors = np.linalg.eigh(known.covariance / np.outer(*[problem.parameters.prior_std] * 2))
    step = 2.0 * np.sqrt(eigenvalues[-1]) * vectors[:, -1] * problem.parameters.prior_std
    held = replace(weighted, held=np.ones(len(step), dtype=np.bool_))
    wrong = replace(adjust(held, known.values + step, known.states), covariance=known.covariance)
    rows = np.flatnonzero(seen.cameras == 2)
    by_noise = wrong.distances[rows]
    judged, _ = Predictions.of(weighted, wrong).judged(seen.take(rows), np.zeros(len(rows)))
    assert (by_noise > GATE).mean() > 0.3
    assert (judged < GATE).mean() > 0.97


def test_what_a_pass_has_held_does_not_count_as_uncertain_as_its_prior(solved: tuple[Problem, Adjustment]) -> None:
    problem, found = solved
    names = problem.parameters.names
    still = replace(problem, held=np.array([not name.endswith("focal") for name in names]))
    passed = adjust(still, found.values, found.states)
    seen = problem.observations
    free, held = (Predictions.of(problem, fit).judged(seen, np.ones(len(seen)))[0] for fit in (found, passed))
    np.testing.assert_allclose(held, free, rtol=0.05, atol=0.05)
