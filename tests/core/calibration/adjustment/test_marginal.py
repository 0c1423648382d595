"""The marginal posterior of the cameras: its gradient, its optimum, and where the joint optimum stands."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment import marginal
from stereophd.core.calibration.adjustment.linearisation import Linearisation, Seen
from stereophd.core.calibration.adjustment.marginal import (
    MarginalPosterior,
    Point,
    at_answer,
    curvature_covariance,
    marginal_optimum,
)
from stereophd.core.calibration.adjustment.problem import SQUARED, Problem
from stereophd.core.calibration.adjustment.solver import adjust, settled_knots
from stereophd.core.calibration.adjustment.trajectories import MotionNoise
from stereophd.core.calibration.annealing.fits import FITTED_LOSS, marginal_fit
from stereophd.core.calibration.annealing.task import Fit
from stereophd.core.calibration.unknowns.quantities.pose import CENTER
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.motion.ballistic import Ballistic
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from tests.core.calibration.adjustment.test_solver import solve
from tests.core.calibration.scenes import make_problem

from .. import problems_of_unknowns
from ..problems_of_unknowns import ACCELERATION, MOTION, SIGMA, observe, problem_of, rig, some_problem, unknowns

# Some noise of the motion: along the axes, and how they go together.
NOISE = np.array([0.1, -0.2, 0.15, 0.3, -0.1, 0.2])


def check_gradient(problem: Problem, states: np.ndarray, values: np.ndarray, **tolerance: float) -> None:
    """Compare the gradient with differences of the objective along four steps."""
    posterior = MarginalPosterior(Linearisation.of(problem))
    at = posterior.at(np.append(values, NOISE), states)
    gradient, root = posterior.gradient(at), posterior.root(at)
    rng = np.random.default_rng(3)
    for _ in range(4):
        step = 0.02 * root @ rng.standard_normal(posterior.size)
        ahead, behind = (posterior.at(at.unknowns + sign * step, at.states).objective for sign in (1.0, -1.0))
        assert ahead - behind == pytest.approx(2.0 * float(gradient @ step), **tolerance)


def test_the_marginal_posterior_has_the_gradient_of_its_objective() -> None:
    problem, states, drawn = some_problem(("center", "rotation", "focal", "clock_offset"))
    check_gradient(problem, states, drawn, rel=0.02, abs=1e-4)


@pytest.mark.parametrize("clocks", [(), ("clock_offset", "clock_rate")])
def test_the_gradient_is_exact(clocks: tuple[str, ...]) -> None:
    """Differences that followed the knots, and equations that were solved to a part, left it 1e-6 off."""
    problem, states, drawn = some_problem(("center", "rotation", "focal", "distortion", *clocks))
    posterior = MarginalPosterior(Linearisation.of(problem))
    at = posterior.at(np.append(drawn, NOISE), states)
    gradient, root = posterior.gradient(at), posterior.root(at)
    downhill = root @ (root.T @ gradient) / np.linalg.norm(root.T @ gradient)
    ahead, behind = (posterior.at(at.unknowns + step * downhill, at.states).objective for step in (0.003, -0.003))
    assert (ahead - behind) / 0.006 == pytest.approx(float(gradient @ downhill), rel=1e-7)


def test_knots_settle_in_few_steps_where_one_camera_alone_sees_an_object() -> None:
    """Steps of the normal equations alone leave 100 times as much after three of them."""
    true = unknowns(rig(), ("center", "rotation", "focal"))
    observations, _, points = observe(true.cameras, 1, 3, 12.0)
    rows = np.flatnonzero((observations.trajectories > 0) | (observations.cameras == 0) | (observations.times < 3.0))
    problem, states = problem_of(true, observations.take(rows), points[rows])
    linearisation, values = Linearisation.of(problem), np.zeros(true.size)
    states, *_ = settled_knots(linearisation, values, states)
    values = 0.3 * true.prior_std
    few, enough = (settled_knots(linearisation, values, states, most=most, settled=1e-12)[0] for most in (3, 100))
    cost = [linearisation.of_knots(values, knots)[0] for knots in (few, enough)]
    assert cost[0] - cost[1] < 1e-8


def test_the_exact_covariance_is_that_of_the_objective_where_velocities_follow_the_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Normal equations believe velocities that the noise has bent: they are 8 % off here."""
    monkeypatch.setattr(problems_of_unknowns, "ACCELERATION", 1.0)
    monkeypatch.setattr(problems_of_unknowns, "MOTION", ConstantVelocity([1.0] * 3))
    cameras = rig()[:2]
    true = unknowns(cameras, ("center", "rotation", "clock_offset"))
    observations, _, points = observe(cameras, 1, 1, 2.5)
    errors = 10.0 * SIGMA * np.random.default_rng(1).standard_normal((len(observations), 2))
    observations = replace(
        observations, points=observations.points + errors, precisions=observations.precisions / 10.0**2
    )
    problem, states = problem_of(true, observations, points)
    found = marginal_optimum(problem, adjust(problem, np.zeros(true.size), states))
    assert found.converged
    covariance = curvature_covariance(problem, found)
    posterior, at = at_answer(problem, found)
    step = covariance[-1] / np.sqrt(covariance[-1, -1])
    precision = np.linalg.inv(posterior.covariance(at))
    step = np.append(step, -np.linalg.solve(precision[-6:, -6:], precision[-6:, :-6] @ step))
    ahead, behind = (posterior.at(at.unknowns + sign * step, at.states).objective for sign in (1.0, -1.0))
    assert ahead + behind - 2.0 * at.objective == pytest.approx(1.0, abs=0.02)
    in_threads = curvature_covariance(problem, found, threads=2)
    np.testing.assert_array_equal(in_threads, covariance)
    # bends are looked at beside few draws where they are slight
    along, calls = MarginalPosterior.along, []
    monkeypatch.setattr(MarginalPosterior, "along", lambda *of: calls.append(of) or along(*of))
    curvature_covariance(problem, found)
    assert len(calls) == marginal.FIRST_BENDS


def test_the_exact_covariance_is_that_of_the_floor_of_a_valley_that_bends(monkeypatch: pytest.MonkeyPatch) -> None:
    """A known distance keeps the other camera on a sphere, in a direction that 15 px of noise hardly show.

    Ends of differences at a tenth of a standard deviation are far from the sphere: the direction is stated a third as
    wide as it is, even if they follow the valley to second order.
    """
    cameras = rig()[:2]
    true = unknowns(cameras, ("center", "rotation"))
    observations, _, points = observe(cameras, 1, 1, 2.5)
    errors = 30.0 * SIGMA * np.random.default_rng(1).standard_normal((len(observations), 2))
    observations = replace(
        observations, points=observations.points + errors, precisions=observations.precisions / 30.0**2
    )
    problem, states = problem_of(true, observations, points)
    distance = float(np.linalg.norm(cameras[1].pose.center - cameras[0].pose.center))
    problem = replace(problem, scale=ScaleMeasurement("baseline", distance, 3e-5 * distance, (0, 1)))
    found = marginal_optimum(problem, adjust(problem, np.zeros(true.size), states))
    stds = []
    for step in (10.0 * marginal.DIFFERENCE, marginal.DIFFERENCE, 0.1 * marginal.DIFFERENCE):
        monkeypatch.setattr(marginal, "DIFFERENCE", step)
        stds.append(np.sqrt(np.diag(curvature_covariance(problem, found))))
    np.testing.assert_allclose(stds[0][1:] / stds[2][1:], 1.0, atol=0.03)
    np.testing.assert_allclose(stds[1][1:] / stds[2][1:], 1.0, atol=0.003)


def test_bends_are_those_of_trajectories_that_follow_along_their_own_valley(monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera alone sees the object for long: after one step of its knots deviations were 40 % and 5 times larger.

    The second of them was wider than the prior.
    """
    monkeypatch.setattr(problems_of_unknowns, "ACCELERATION", 0.3)
    monkeypatch.setattr(problems_of_unknowns, "MOTION", ConstantVelocity([0.3] * 3))
    names = ("center", "rotation", "focal", "principal_point", "distortion", "clock_offset", "readout")
    true = unknowns(rig()[:2], names)
    observations, _, points = observe(true.cameras, 1, 1, 6.0)
    rows = np.flatnonzero((observations.cameras == 0) | (observations.times < 2.0))
    seen = observations.take(rows)
    errors = 20.0 * SIGMA * np.random.default_rng(1).standard_normal((len(seen), 2))
    seen = replace(seen, points=seen.points + errors, precisions=seen.precisions / (1.0 + 20.0**2))
    problem, states = problem_of(true, seen, points[rows])
    found = marginal_optimum(problem, adjust(problem, np.zeros(true.size), states))
    stds = []
    for step in (marginal.BEND_DIFFERENCE, 3.0 * marginal.BEND_DIFFERENCE):
        monkeypatch.setattr(marginal, "BEND_DIFFERENCE", step)
        stds.append(np.sqrt(np.diag(curvature_covariance(problem, found))))
    np.testing.assert_allclose(stds[1] / stds[0], 1.0, atol=0.02)
    assert (stds[1] < 1.01 * true.prior_std).all()


def test_the_gradient_knows_how_the_knots_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it misses is of second order in what they have to go; by the normal equations it was of first order."""
    problem, states, drawn = some_problem(("center", "rotation", "focal", "clock_offset"))
    posterior = MarginalPosterior(Linearisation.of(problem))
    at = posterior.at(np.append(drawn, NOISE), states)
    settled, root, missed = posterior.gradient(at), posterior.root(at), []
    away = np.random.default_rng(4).standard_normal(states.shape)

    def as_they_are(
        linearisation: Linearisation, values: Array, knots: Array, *_: object
    ) -> tuple[Array, float, Seen, None]:
        seen = linearisation.residuals(values, knots, linearisation.placed(values), by_values=False)
        return knots, 0.0, seen, None

    monkeypatch.setattr(marginal, "settled_knots", as_they_are)
    for step in (1e-4, 1e-3):
        beside = posterior.at(at.unknowns, at.states + step * away)
        missed.append(float(np.linalg.norm(root.T @ (posterior.gradient(beside) - settled))))
    assert missed[0] < 0.02 * missed[1]


def test_the_gradient_minimises_the_knots_where_one_camera_alone_sees_an_object_for_long() -> None:
    """To first order in the step the knots follow so badly that differences of the volume are wrong."""
    true = unknowns(rig(), ("center", "rotation", "focal"))
    drawn = true.sample(np.random.default_rng(100), 1)[0]
    observations, _, points = observe(true.cameras, 1, 3, 12.0)
    rows = np.flatnonzero((observations.trajectories > 0) | (observations.cameras == 0) | (observations.times < 3.0))
    problem, states = problem_of(true.about(true.guess(drawn)), observations.take(rows), points[rows])
    check_gradient(problem, states, drawn, abs=1e-3)


@pytest.mark.parametrize("motion", [MOTION, Ballistic([ACCELERATION] * 3, gravity=[0.0, 9.8, 0.0])])
def test_the_equations_of_the_knots_alone_are_those_of_all(motion: Motion) -> None:
    problem, states, drawn = some_problem(("center", "rotation", "clock_offset"))
    problem = replace(problem, knots=replace(problem.knots, motion=motion))
    linearisation = Linearisation.of(problem)
    whole = linearisation.at(drawn, states, NOISE)
    _, bands, vector, _ = linearisation.of_knots(drawn, states, NOISE)
    np.testing.assert_allclose(bands, whole.bands, rtol=1e-12)
    np.testing.assert_allclose(vector, whole.state_vector, rtol=1e-9, atol=1e-9 * np.abs(whole.state_vector).max())


def test_held_values_are_coupled_to_no_noise_of_the_motion() -> None:
    """Others are as before: a larger scale is a larger noise."""
    problem, states, drawn = some_problem(("center", "rotation"))
    held, count = np.arange(problem.parameters.size) % 2 == 0, problem.parameters.size
    every, others = (
        MarginalPosterior(Linearisation.of(each)).at(np.append(drawn, NOISE), states).equations.matrix[count:, :count]
        for each in (problem, replace(problem, held=held))
    )
    assert every[:, held].any()
    assert every[:, ~held].any()
    np.testing.assert_array_equal(others, np.where(held, 0.0, every))


def test_a_step_to_values_of_no_camera_is_shortened() -> None:
    """A focal length of 0 is none."""
    problem, states, drawn = some_problem(("center", "rotation", "focal"))
    posterior = MarginalPosterior(Linearisation.of(problem))
    at = posterior.at(np.append(drawn, NOISE), states)
    step = np.zeros(posterior.size)
    step[problem.parameters.names.index("cam1.focal")] = -1000.0
    shares = [share for share, _ in marginal._tried(posterior, at, step)]
    assert shares[0] == 0.5


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_marginal_posterior_does_not_tell_the_scale(factor: float) -> None:
    """Cameras and knots stretched about the reference change nothing but the prior, whatever the noise."""
    problem, states, drawn = some_problem(("center", "rotation", "clock_offset"))
    parameters = problem.parameters
    origin = parameters.cameras[0].pose.center
    posterior = MarginalPosterior(Linearisation.of(problem))

    def without_prior(values: np.ndarray, knots: np.ndarray) -> float:
        at = posterior.at(np.append(values, NOISE), knots)
        return at.objective - 0.5 * float((((values - parameters.prior_mean) / parameters.prior_std) ** 2).sum())

    stretched = drawn.copy()
    for camera in parameters.build(drawn)[1:]:
        places = parameters.index(camera.name, CENTER)
        stretched[places] += (factor - 1.0) * (camera.pose.center - origin)
    about = np.stack([origin, np.zeros(3)])
    assert without_prior(stretched, about + factor * (states - about)) == pytest.approx(
        without_prior(drawn, states), abs=1e-5
    )


@pytest.mark.parametrize("factor", [0.75, 1.3])
def test_a_wrong_noise_of_the_motion_is_found(factor: float) -> None:
    """The optimum is that of the right noise; with the noise held as stated focal lengths are several errors off."""
    problem, states, drawn = some_problem(("center", "rotation", "focal", "clock_offset"))
    right = marginal_optimum(problem, adjust(problem, drawn, states))
    stated = replace(problem, knots=replace(problem.knots, noise_std=factor * problem.knots.noise_std))
    found = marginal_optimum(stated, adjust(stated, drawn, states))
    assert np.log(factor) + found.motion_noise[0] == pytest.approx(right.motion_noise[0], abs=0.05)
    std = np.sqrt(np.diag(right.covariance))
    np.testing.assert_allclose((found.values - right.values) / std, 0.0, atol=0.35)


@pytest.mark.parametrize(("place", "deviations"), [(-1, 6.0), (-1, -15.0), (-4, 15.0)])
def test_the_marginal_optimum_is_found_from_far_away(place: int, deviations: float) -> None:
    """A joint optimum may lie far off, along a direction that the data hardly show: no detection is lost on the way."""
    problem, states, drawn = some_problem(("center", "rotation", "focal"), loss=FITTED_LOSS)
    near = marginal_optimum(problem, adjust(problem, drawn, states))
    prior_std = problem.parameters.prior_std
    variances, directions = np.linalg.eigh(near.covariance / np.outer(prior_std, prior_std))
    away = deviations * np.sqrt(variances[place]) * directions[:, place] * prior_std
    held = replace(problem, loss=SQUARED, held=np.ones(problem.parameters.size, dtype=np.bool_))
    found = marginal_optimum(problem, adjust(held, drawn + away, states))
    np.testing.assert_allclose((found.values - near.values) / np.sqrt(np.diag(near.covariance)), 0.0, atol=0.1)


def test_detections_that_the_loss_leaves_out_are_left_out_of_the_volume_too() -> None:
    problem, states, drawn = some_problem(("center", "rotation", "focal"), loss=FITTED_LOSS)
    wrong = np.arange(10, len(problem.observations), 40)
    points = problem.observations.points.copy()
    points[wrong] += 30.0
    problem = replace(problem, observations=replace(problem.observations, points=points))
    found = marginal_optimum(problem, adjust(problem, drawn, states))
    assert (found.distances[wrong] > marginal.LEFT_OUT).all()
    weights = np.ones(len(points))
    weights[wrong] = 0.0
    without = problem.weighted(weights)
    expected = marginal_optimum(without, adjust(without, drawn, states))
    std = np.sqrt(np.diag(expected.covariance))
    np.testing.assert_allclose((found.values - expected.values) / std, 0.0, atol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=0.02)


def test_a_search_that_ends_too_early_has_not_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, states, drawn = some_problem(("center", "rotation", "focal"))
    joint = adjust(problem, drawn, states)
    assert marginal_optimum(problem, joint).converged
    monkeypatch.setattr(marginal, "MOST_STEPS", 1)
    monkeypatch.setattr(marginal, "MOST_WEIGHTINGS", 1)
    assert not marginal_optimum(problem, joint).converged


def test_trajectories_are_integrated_out_for_poses_alone_too() -> None:
    problem, states, drawn = some_problem(("center", "rotation"))
    joint = adjust(problem, drawn, states)
    task: Any = SimpleNamespace(
        parameters=problem.parameters, reference=problem.reference, scale=problem.scale,
        filter=SimpleNamespace(motion=problem.knots.motion),
    )  # fmt: skip
    fit = Fit(joint, problem.knots, problem.observations, np.arange(len(problem.observations)))
    fit = marginal_fit(task, fit)
    found, posterior = fit.adjustment, MarginalPosterior(Linearisation.of(problem))
    np.testing.assert_allclose(fit.knots.noise_std, MotionNoise.of(found.motion_noise, problem.knots.noise_std).std)
    reached = posterior.at(np.append(found.values, found.motion_noise), states).objective
    assert reached < posterior.at(np.append(joint.values, np.zeros(6)), states).objective - 1.0


def test_the_scale_of_objects_that_stand_still_is_left_to_the_prior() -> None:
    """Their knots have no velocity: a volume that counts one would take the scene for too small."""
    made = make_problem(3, objects=8, still=True)
    problem, joint = solve(made, Static())
    assert len(problem.knots.links()) == 0
    found = marginal_optimum(problem, joint)
    np.testing.assert_array_equal(found.motion_noise, np.zeros(6))
    std = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(found.values, joint.values, atol=0.2 * std.max())


def test_a_noise_of_the_motion_far_from_what_is_stated_is_found_and_used() -> None:
    problem, states, drawn = some_problem(("center", "rotation"))
    fits = [stated_of(problem, states, drawn, wrong) for wrong in (1.0, 20.0)]
    np.testing.assert_allclose(fits[1].knots.noise_std, fits[0].knots.noise_std, rtol=0.3)
    right, other = (fit.adjustment for fit in fits)
    assert np.log(20.0) + other.motion_noise[0] == pytest.approx(right.motion_noise[0], abs=0.3)
    error = other.values - right.values
    assert error @ np.linalg.solve(right.covariance, error) < 0.25 * len(error)


def stated_of(problem: Problem, states: np.ndarray, drawn: np.ndarray, wrong: float) -> Fit:
    """The marginal fit where the noise of the motion is stated as this many times what it is."""
    stated = replace(problem, knots=replace(problem.knots, noise_std=wrong * problem.knots.noise_std))
    fit = Fit(adjust(stated, drawn, states), stated.knots, stated.observations, np.arange(len(stated.observations)))
    task: Any = SimpleNamespace(
        parameters=stated.parameters, reference=stated.reference, scale=stated.scale,
        filter=SimpleNamespace(motion=ConstantVelocity(wrong * problem.knots.noise_std)),
    )  # fmt: skip
    return marginal_fit(task, fit)


def test_steps_to_the_marginal_optimum_that_are_too_long_are_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of six times the right one would never settle; a quarter of each does."""
    problem, states, _ = some_problem(("center", "rotation", "focal", "clock_offset"))
    joint = adjust(problem, np.zeros(problem.parameters.size), states)
    expected = marginal_optimum(problem, joint)
    std = np.sqrt(np.diag(expected.covariance))
    assert np.abs((expected.values - joint.values) / std).max() > 1.0
    right_root = MarginalPosterior.root

    def too_long(posterior: MarginalPosterior, at: Point) -> np.ndarray:
        return np.sqrt(6.0) * right_root(posterior, at)

    monkeypatch.setattr(MarginalPosterior, "root", too_long)
    found = marginal_optimum(problem, joint)
    np.testing.assert_allclose((found.values - expected.values) / std, 0.0, atol=0.3)


def test_the_covariance_knows_all_that_there_is_of_the_noise_of_the_motion() -> None:
    """The normal equations know half of it: the curvature of the objective would be twice theirs."""
    problem, states, _ = some_problem(("center",))
    joint = adjust(problem, np.zeros(problem.parameters.size), states)
    found = marginal_optimum(problem, joint)
    posterior, at = at_answer(problem, found)
    curvatures = np.diag(np.linalg.inv(posterior.covariance(at)))
    for place in range(problem.parameters.size, posterior.size):
        step = np.zeros(posterior.size)
        step[place] = 0.05
        gradients = [posterior.gradient(posterior.at(at.unknowns + s * step, at.states)) for s in (1.0, -1.0)]
        expected = (gradients[0] - gradients[1])[place] / 0.1
        assert curvatures[place] == pytest.approx(expected, rel=0.25)


def test_objects_that_accelerate_along_a_slanted_line_leave_the_cameras_where_they_are() -> None:
    """As people on a slope do: a noise alike along all axes would bend the scene until they accelerated so."""
    true = unknowns(rig()[:2], ("center", "rotation", "focal", "principal_point"))
    slanted = np.array([[0.5, 0.0, 0.0], [0.0, 0.2, 0.5], [0.0, 0.5, 1.2]])
    observations, _, points = observe(true.cameras, 5, 4, 10.0, slanted)
    problem, states = problem_of(true, observations, points)
    found = marginal_optimum(problem, adjust(problem, np.zeros(true.size), states))
    assert found.converged
    error = found.values
    assert error @ np.linalg.solve(found.covariance, error) < true.size + 4.0 * np.sqrt(2.0 * true.size)
    assert found.motion_noise[5] < -0.5


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_many_short_trajectories_neither_stretch_the_scene_nor_still_the_motion(
    monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Each of them has a first state, whose density must not prefer a larger scene or a smaller noise."""
    monkeypatch.setattr(problems_of_unknowns, "ACCELERATION", 0.02)
    monkeypatch.setattr(problems_of_unknowns, "MOTION", ConstantVelocity([0.02] * 3))
    true = unknowns(rig()[:2], ("center", "rotation", "focal"))
    observations, _, points = observe(true.cameras, seed, 20, 2.0)
    problem, states = problem_of(true, observations, points)
    found = marginal_optimum(problem, adjust(problem, np.zeros(true.size), states))
    error = found.values
    assert found.converged
    assert abs(found.motion_noise[0]) < 0.3
    assert error @ np.linalg.solve(found.covariance, error) < true.size + 3.0 * np.sqrt(2.0 * true.size)


def test_the_gradient_of_objects_that_stand_still() -> None:
    problem, joint = solve(make_problem(3, objects=8, still=True), Static())
    posterior = MarginalPosterior(Linearisation.of(problem))
    at = posterior.at(joint.values, joint.states)
    gradient, root = posterior.gradient(at), posterior.root(at)
    for step in 0.02 * root.T:
        ahead, behind = (posterior.at(at.unknowns + sign * step, at.states).objective for sign in (1.0, -1.0))
        assert ahead - behind == pytest.approx(2.0 * float(gradient @ step), rel=0.02, abs=1e-4)


def test_steps_near_an_optimum_correct_the_curvature() -> None:
    rng = np.random.default_rng(1)
    precision, covariance = (m @ m.T + np.eye(4) for m in rng.standard_normal((2, 4, 4)))
    secants = [(step, precision @ step) for step in rng.standard_normal((4, 4))]
    bent = marginal._bent(covariance, secants)
    np.testing.assert_allclose(bent @ secants[-1][1], secants[-1][0])
    assert np.linalg.eigvalsh((bent + bent.T) / 2.0)[0] > 0.0


def test_a_search_that_changes_of_the_gradient_mislead_goes_on_without_them() -> None:
    """One ended half a deviation from the optimum after 3 steps, as the curvature was that of other noise."""
    problem, states, drawn = some_problem(("center", "rotation", "focal"))
    posterior = MarginalPosterior(Linearisation.of(problem))
    at = marginal._minimised(posterior, posterior.at(np.append(drawn, NOISE), states), 0.5, [])[0]
    root = posterior.root(at)
    flat = 1e-3 * np.linalg.inv(root).T @ (root.T @ posterior.gradient(at))
    secants = [(root @ root.T @ posterior.gradient(at), flat)]
    _, _, left = marginal._minimised(posterior, posterior.at(at.unknowns + root[:, 0], at.states), 0.05, secants)
    assert left <= 0.05
