"""Objects that move by less than is stated: the joint optimum runs away, and does not count."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import LinAlgError

from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.marginal import MarginalPosterior, marginal_optimum
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.adjustment.trajectories import (
    STATED,
    fit_states,
    interpolation,
    knot_spacing,
    place_knots,
)
from stereophd.core.calibration.annealing import fits
from stereophd.core.calibration.annealing.fits import FITTED_LOSS, adjusted_to, confirmed_fit, marginal_fit
from stereophd.core.calibration.annealing.task import Fit
from stereophd.core.motion.constant_velocity import ConstantVelocity

from ..problems_of_unknowns import ACCELERATION, observe, rig, unknowns
from .test_seen_by_one_camera import SomeTask, of_rows

# Over what the object does.
TIMES_STATED = 10.0


def stated_loosely(seed: int) -> tuple[SomeTask, Problem, np.ndarray, np.ndarray]:
    """A task, its problem of one object before two cameras for half a minute, true values, and knots at the truth."""
    motion = ConstantVelocity([TIMES_STATED * ACCELERATION] * 3)
    true = unknowns(rig("none")[:2], ("center", "rotation", "focal"))
    drawn = 0.3 * true.sample(np.random.default_rng(seed), 1)[0]
    observations, _, points = observe(true.cameras, seed, 1, 30.0)
    seen = np.isfinite(observations.points).all(axis=1)
    observations, points = of_rows(observations, np.flatnonzero(seen)), points[seen]
    knots = place_knots([observations.times], knot_spacing(motion, 0.005), motion)
    at = interpolation(knots, observations.trajectories, observations.times)
    states = fit_states(knots, *at, points, np.full(len(points), 1e4))
    guess = true.about(true.guess(drawn))
    task = SomeTask(guess, observations, filter=SimpleNamespace(motion=motion))
    return task, Problem(guess, 0, knots, observations, FITTED_LOSS), drawn, states


@pytest.mark.parametrize("seed", range(3))
def test_fits_end_near_the_marginal_optimum_where_the_joint_one_runs_away(seed: int) -> None:
    task, problem, true, states = stated_loosely(seed)
    detections = np.arange(len(problem.observations))
    joint = adjust(problem, true, states)
    passed = confirmed_fit(task, problem, true, states, detections)  # type: ignore[arg-type]
    far, near = (
        adjusted_to(
            task, Fit(begun, problem.knots, problem.observations, detections), problem.observations,  # type: ignore[arg-type]
            detections,
        ).adjustment
        for begun in (joint, replace(joint, values=true, states=states))
    )  # fmt: skip
    # joint optima are 4 to 5.5 deviations of the prior off in five of six scenes
    assert np.abs((passed.adjustment.values - true) / task.parameters.prior_std).max() < 2.0
    error = far.values - near.values
    assert error @ np.linalg.solve(near.covariance, error) < len(true)


def test_the_noise_of_the_motion_that_shows_is_where_the_marginal_posterior_is_greatest() -> None:
    _, problem, true, states = stated_loosely(0)
    still = replace(problem.weighted(np.ones(len(problem.observations))), held=np.ones(len(true), dtype=np.bool_))
    posterior = MarginalPosterior(Linearisation.of(still))
    shown = posterior.with_shown_motion(true, states, STATED)
    np.testing.assert_array_equal(shown.unknowns[: len(true)], true)
    assert np.exp(shown.unknowns[len(true)]) == pytest.approx(1.0 / TIMES_STATED, rel=0.2)
    for step in (-0.1, 0.1):
        unknowns = shown.unknowns + step * np.eye(len(shown.unknowns))[len(true)]
        assert posterior.at(unknowns, shown.states).objective > shown.objective


@pytest.mark.parametrize("quantity", ["center", "rotation"])
def test_held_values_stay(quantity: str) -> None:
    task, problem, true, states = stated_loosely(0)
    held = np.array([parameter.name.startswith(quantity) for parameter in task.parameters.parameters])
    begun = replace(adjust(problem, true, states, 1), values=true, states=states)
    found = marginal_optimum(replace(problem, held=held), begun)
    np.testing.assert_allclose(found.values[held], true[held], rtol=0.0, atol=1e-9)
    assert (np.abs(found.values[~held] - true[~held]) > 1e-6).all()


def test_the_joint_optimum_stays_where_no_marginal_one_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise LinAlgError

    task, problem, true, states = stated_loosely(0)
    monkeypatch.setattr(fits, "marginal_optimum", fails)
    detections = np.arange(len(problem.observations))
    joint = adjust(problem, true, states)
    begun = Fit(joint, problem.knots, problem.observations, detections)
    given = adjusted_to(task, begun, problem.observations, detections)  # type: ignore[arg-type]
    passed = confirmed_fit(task, problem, true, states, detections)  # type: ignore[arg-type]
    for fit in (given, passed):
        assert fit.adjustment.covariance[0, 0] < 0.5 * task.parameters.prior_std[0] ** 2
    answer = marginal_fit(task, begun)  # type: ignore[arg-type]
    assert not answer.adjustment.converged
