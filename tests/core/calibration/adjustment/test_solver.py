"""Bundle adjustment: against SciPy, against the Cramer-Rao bound, and its invariance to scale."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import LinAlgError
from scipy.optimize import least_squares

from stereophd.core.bounds.calibration import TruePositions, calibration_bound
from stereophd.core.calibration.adjustment import normal_equations, solver
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations
from stereophd.core.calibration.adjustment.problem import SQUARED, Loss, Problem
from stereophd.core.calibration.adjustment.solver import (
    Adjustment,
    Eliminated,
    adjust,
    factor_knots,
    gauss_newton_covariance,
    within_prior,
)
from stereophd.core.calibration.adjustment.trajectories import (
    MotionNoise,
    MotionPrior,
    fit_states,
    interpolation,
    knot_spacing,
    motion_links,
    place_knots,
    positions,
)
from stereophd.core.calibration.unknowns.observability import DETERMINED, UNDETERMINED, observability, pose_spread
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, log_scale
from stereophd.core.geometry.camera import Detector
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from tests.core.calibration.scenes import STDS, MadeUp, make_problem

STRAIGHT = ConstantVelocity([0.0, 0.0, 0.0])


def solve(
    problem: MadeUp,
    motion: Motion = STRAIGHT,
    loss: Loss = SQUARED,
    scale: ScaleMeasurement | None = None,
    deviation: float = 0.2,
) -> tuple[Problem, Adjustment]:
    """Adjust from the guess, the trajectories begun at a common depth."""
    observations = problem.observations
    count = int(observations.trajectories.max()) + 1
    detected = [observations.times[observations.trajectories == j] for j in range(count)]
    knots = place_knots(detected, knot_spacing(motion, deviation), motion)
    interpolated = interpolation(knots, observations.trajectories, observations.times)
    rough = np.empty((len(observations), 3))
    for k, camera in enumerate(problem.parameters.cameras):
        here = observations.cameras == k
        rough[here] = camera.unproject(observations.points[here], np.full(int(here.sum()), 150.0))
    states = fit_states(knots, *interpolated, rough, np.ones(len(rough)))
    whole = Problem(problem.parameters, 0, knots, observations, loss, scale)
    return whole, adjust(whole, np.zeros(problem.parameters.size), states)


def residuals(problem: Problem, values: np.ndarray, states: np.ndarray) -> np.ndarray:
    """All residuals, plainly: what the normal equations are the linearisation of."""
    observations, parameters = problem.observations, problem.parameters
    points = positions(states, *interpolation(problem.knots, observations.trajectories, observations.times))
    cameras = parameters.build(values)
    parts = [(values - parameters.prior_mean) / parameters.prior_std]
    for n, camera in enumerate(cameras):
        here = observations.cameras == n
        error = observations.points[here] - camera.project(points[here])
        parts.append((error * np.sqrt(observations.precisions[here][:, [0, 1], [0, 1]])).ravel())
    scale = np.exp(log_scale(parameters, problem.reference, values)[0])
    links = motion_links(problem.knots)
    for link, precision in zip(links.knot, links.precisions, strict=True):
        both = states[link : link + 2].reshape(4, 3)
        factor = np.linalg.cholesky(precision[2:, 2:])  # of rank 2: the last knot given the first
        step = problem.knots.times[link + 1] - problem.knots.times[link]
        change = np.stack([both[2] - both[0] - step * both[1], both[3] - both[1]])
        parts.append((factor.T @ change / problem.knots.noise_std / scale).ravel())
    return np.concatenate(parts)


@pytest.mark.parametrize("acceleration", [0.0, 0.02])
def test_optimum_is_that_of_scipy(acceleration: float) -> None:
    problem = make_problem(1, objects=3, frames=30)
    whole, found = solve(problem, ConstantVelocity([acceleration] * 3))
    size = problem.parameters.size

    def plain(x: np.ndarray) -> np.ndarray:
        return residuals(whole, x[:size], x[size:].reshape(found.states.shape))

    at = np.concatenate([found.values, found.states.ravel()])
    np.testing.assert_allclose((plain(at) ** 2).sum(), found.cost, rtol=1e-9)
    reference = least_squares(plain, at, x_scale="jac", max_nfev=5)
    # nothing left to gain, and the same covariance, from SciPy's numerical Jacobian of everything
    assert 2.0 * reference.cost >= found.cost * (1.0 - 1e-6)
    full = np.linalg.inv(reference.jac.T @ reference.jac)[:size, :size]
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), np.sqrt(np.diag(full)), rtol=0.02)


@pytest.mark.parametrize("loss", [SQUARED, Loss(normal_equations.CAUCHY, 2.0), Loss(normal_equations.FLOOR, 1e-3)])
def test_vectors_are_the_gradient_of_the_cost(loss: Loss) -> None:
    problem = make_problem(2, objects=2, frames=8)
    measurement = ScaleMeasurement("baseline", 41.0, 0.5, (0, 1))
    whole, found = solve(problem, ConstantVelocity([0.02] * 3), loss, measurement)
    linearisation = Linearisation.of(whole)
    values = found.values + 0.1 * np.array(STDS) * [1, -1, 1, 0.1, -0.02, 0.1]
    states = found.states + 0.05
    equations = linearisation.at(values, states)
    rng = np.random.default_rng(0)
    for _ in range(5):
        dv, dx = 1e-6 * rng.standard_normal(len(values)) * STDS, 1e-6 * rng.standard_normal(states.shape)
        change = linearisation.at(values + dv, states + dx).cost - linearisation.at(values - dv, states - dx).cost
        expected = -4.0 * (equations.value_vector @ dv + equations.state_vector @ dx.ravel())
        assert change == pytest.approx(expected, rel=1e-4)


def test_errors_and_covariance_are_those_of_the_bound() -> None:
    """Normalised errors over 12 scenes; their mean square is chi-square / dof, here within 5 standard errors."""
    squares, ratios = [], []
    for seed in range(12):
        problem = make_problem(seed, frames=40)
        _, found = solve(problem)
        o = problem.observations
        truth = replace(problem.parameters, cameras=problem.parameters.build(problem.truth))
        # everything was detected
        sure = [replace(c, detector=Detector(c.detector.sigma, 1.0, 0.0)) for c in truth.cameras]
        truth = replace(truth, cameras=tuple(sure))
        bound = calibration_bound(
            truth, np.zeros(6), 0, STRAIGHT, TruePositions(o.trajectories, o.cameras, o.times, problem.positions)
        )
        error = found.values - problem.truth
        squares.append(error @ np.linalg.solve(found.covariance, error) / 6)
        ratios.append(np.sqrt(np.diag(found.covariance) / np.diag(bound)))
    assert abs(np.mean(squares) - 1.0) < 5.0 * np.sqrt(2.0 / (6 * 12))
    # the same information, at the estimate and at the truth
    np.testing.assert_allclose(np.median(ratios, axis=0), 1.0, atol=0.15)


def test_an_adjustment_of_a_pass_ends_after_a_step_that_hardly_moves_the_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, found = solve(make_problem(3), ConstantVelocity([0.05] * 3))
    begin = np.zeros(problem.parameters.size), found.states
    equations = Linearisation.of(problem).at(*begin)
    values, _, length = solver.solve(equations, 0.0)
    precision = np.linalg.inv(gauss_newton_covariance(equations, problem.parameters.prior_std))
    assert length == pytest.approx(np.sqrt(values @ precision @ values), rel=1e-6)

    lengths, step = list[float](), solver.solve

    def counted(equations: NormalEquations, damping: float) -> tuple[np.ndarray, np.ndarray, float]:
        out = step(equations, damping)
        lengths.append(out[2])
        return out

    monkeypatch.setattr(solver, "solve", counted)
    rough = adjust(problem, *begin, settled=1.0)
    assert rough.converged
    assert min(lengths[:-1]) >= 1.0 > lengths[-1]
    left = rough.values - found.values
    assert left @ np.linalg.solve(found.covariance, left) < 0.1  # the last step was taken
    count = len(lengths)
    adjust(problem, *begin)
    assert len(lengths) - count > count


@pytest.mark.parametrize("acceleration", [0.0, 0.05])
def test_scale_stays_at_the_prior(acceleration: float) -> None:
    problem = make_problem(3)
    _, found = solve(problem, ConstantVelocity([acceleration] * 3))
    seen = observability(problem.parameters, 0, found.values, found.covariance)
    assert seen.status == DETERMINED
    assert seen.scale_ratio == pytest.approx(1.0, abs=0.02)
    assert (seen.ratios[:5] < 0.3).all()
    # the motion model does not pull: with the direction given, the isotropic prior alone says how far the camera is
    cameras = problem.parameters.build(found.values)
    offset = cameras[1].pose.center - cameras[0].pose.center
    guess = problem.parameters.cameras[1].pose.center - problem.parameters.cameras[0].pose.center
    distance = np.linalg.norm(offset)
    assert distance == pytest.approx(guess @ offset / distance, abs=0.05)


def test_a_known_baseline_fixes_the_scale() -> None:
    problem = make_problem(4)
    _, found = solve(problem, scale=ScaleMeasurement("baseline", 40.0, 0.1, (0, 1)))
    spread = pose_spread(problem.parameters, 0, found.values, found.covariance, "right")
    assert spread.scale * 40.0 == pytest.approx(0.1, rel=0.1)
    assert np.linalg.norm((found.values - problem.truth)[:3]) < 5.0 * spread.center


def test_an_object_that_stands_still_says_little() -> None:
    problem = make_problem(5, objects=1, still=True)
    _, found = solve(problem)
    assert observability(problem.parameters, 0, found.values, found.covariance).status == UNDETERMINED


def test_two_unknown_cameras() -> None:
    problem = make_problem(6, three=True, frames=40)
    _, found = solve(problem)
    error = found.values - problem.truth
    assert error @ np.linalg.solve(found.covariance, error) < 12 + 5.0 * np.sqrt(24)
    for name in ("right", "above"):
        assert pose_spread(problem.parameters, 0, found.values, found.covariance, name).rotation < np.deg2rad(1.0)


def test_knots_follow_a_manoeuvre_to_a_part_of_the_noise() -> None:
    motion = ConstantVelocity([0.5, 0.5, 0.5])
    spacing = knot_spacing(motion, 0.1)
    times = np.linspace(0.0, 20.0, 400)
    knots = place_knots([times], spacing, motion)
    assert len(knots.times) < 100
    path = np.column_stack([np.sin(times), np.cos(0.7 * times), 0.1 * times])
    interpolated = interpolation(knots, np.zeros(400, dtype=int), times)
    states = fit_states(knots, *interpolated, path, np.full(400, 0.1**-2))
    assert np.abs(positions(states, *interpolated) - path).max() < 0.05


def test_knots_are_at_detections_however_small_the_noise_seems() -> None:
    """All of them where objects turn quickly, the fewest that no longer interval crosses where they do not."""
    motion, rng = ConstantVelocity([0.5, 0.5, 0.5]), np.random.default_rng(4)
    detected = [rng.uniform(0.0, 20.0, 400), np.repeat(rng.uniform(3.0, 5.0, 9), 2), np.array([1.0])]
    every = place_knots(detected, knot_spacing(motion, 1e-9), motion)
    np.testing.assert_array_equal(np.diff(every.first), [400, 9, 1])
    np.testing.assert_array_equal(every.times[:400], np.sort(detected[0]))
    knots = place_knots(detected, 1.0, motion)
    assert 20 <= knots.first[1] <= 25
    assert np.isin(knots.times[: knots.first[1]], detected[0]).all()
    assert np.diff(knots.times[: knots.first[1]]).max() <= 1.0
    np.testing.assert_array_equal(place_knots([np.array([0.0, 0.01, 7.0, 7.5])], 1.0, motion).times, [0.0, 7.0, 7.5])


def test_fewer_knots_leave_the_cameras_where_they_are() -> None:
    """Knots at every detection are the motion model itself; fewer change neither cameras nor their covariance."""
    motion, made = ConstantVelocity([0.002] * 3), make_problem(3, three=True, frames=40)
    answers = []
    for deviation in (1e-6, 0.2):
        whole, found = solve(made, motion, deviation=deviation)
        answers.append((len(whole.knots.times), found))
    (many, exact), (few, found) = answers
    assert few < 0.5 * many
    std = np.sqrt(np.diag(exact.covariance))
    np.testing.assert_allclose(found.values, exact.values, atol=0.1 * std.min(), rtol=0.1)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std, rtol=0.1)


def test_motion_precision_has_no_say_on_straight_lines() -> None:
    knots = place_knots([np.arange(0.0, 11.0, 2.0), np.arange(2.0, 6.0)], 2.0, ConstantVelocity([0.1, 0.2, 0.3]))
    assert knots.count == 2
    bands = MotionPrior.of(knots).with_axes(
        MotionNoise.of(np.array([0.1, 0.0, -0.2, 0.5, 0.3, -0.4]), knots.noise_std).precision
    )
    dense = np.zeros((knots.size, knots.size))
    for k in range(12):
        dense += np.diag(bands[k, : knots.size - k], -k)
    dense += np.tril(dense, -1).T
    line = np.zeros((len(knots.times), 2, 3))
    line[:, 0] = [1.0, 2.0, 3.0] + knots.times[:, None] * [0.1, -0.2, 0.3]
    line[:, 1] = [0.1, -0.2, 0.3]
    np.testing.assert_allclose(dense @ line.ravel(), 0.0, atol=1e-8 * np.abs(dense).max())
    assert (np.linalg.eigvalsh(dense) > -1e-9 * np.abs(dense).max()).all()


def test_knots_without_information_are_held() -> None:
    """The weights of detections far off a robust loss underflow: what is left of them is no matrix to factorise."""
    bands = np.zeros((12, 12))
    bands[0, :6], bands[0, 6:], bands[1, 6:11] = 1.0, 5e-324, 5e-324
    equations = NormalEquations(0.0, bands, np.zeros((12, 2)), 4.0 * np.eye(2), np.zeros(12), np.zeros(2), np.empty(0))
    np.testing.assert_allclose(gauss_newton_covariance(equations, np.ones(2)), 0.25 * np.eye(2))


def test_information_that_rounding_makes_negative_is_cut_to_the_prior() -> None:
    """As where a trajectory goes off to 800 km, and takes more from a camera's weight than the motion adds."""
    covariance = within_prior(np.diag([4.0, -2.0]), np.array([1.0, 5.0]))
    np.testing.assert_allclose(covariance, np.diag([0.25, 25.0]))


def test_knots_are_eliminated_as_by_a_dense_solver() -> None:
    rng = np.random.default_rng(0)
    bands = 0.05 * rng.standard_normal((12, 30))
    bands[0] = 2.0
    bands[np.arange(12)[:, None] + np.arange(30) >= 30] = 0.0
    lower = sum(np.diag(bands[k, : 30 - k], -k) for k in range(12))
    coupling, vector = rng.standard_normal((30, 3)), rng.standard_normal(30)
    equations = NormalEquations(0.0, bands, coupling, np.eye(3), vector, np.zeros(3), np.empty(0))
    coupling[:, 1] = 0.0  # as that of a held value
    eliminated, step = Eliminated.of(equations, factor_knots(bands)), rng.standard_normal(3)
    expected = np.linalg.solve(lower + np.tril(lower, -1).T, np.column_stack([coupling, vector]))
    following, alone = -expected[:, :3], expected[:, 3]
    np.testing.assert_allclose(eliminated.following(), following, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(eliminated.followed(step), following @ step, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(eliminated.knots_after(step), alone + following @ step, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(eliminated.of_knots(vector[:, None]), alone[:, None], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(eliminated.schur, np.eye(3) + coupling.T @ following, rtol=1e-9)
    np.testing.assert_allclose(eliminated.right, -coupling.T @ alone, rtol=1e-9)


def test_an_adjustment_goes_on_where_no_share_of_a_step_lowers_the_cost() -> None:
    """Knots that are nearly singular make steps that are too long at every share; damped ones are not."""
    motion, floor = ConstantVelocity([0.02] * 3), Loss(normal_equations.FLOOR, 1e-3)
    _, found = solve(make_problem(27, objects=3, frames=30), motion, floor)
    assert found.cost < 1600.0  # 1,739 where it gives up at the first such step


def test_where_all_values_are_held_only_trajectories_are_adjusted() -> None:
    problem, fit = solve(make_problem(0))
    values, states = problem.parameters.prior_mean, fit.states
    held = replace(problem, held=np.ones(problem.parameters.size, dtype=np.bool_))
    every, alone = Linearisation.of(problem).at(values, states), Linearisation.of(held).at(values, states)
    assert alone.cost == pytest.approx(every.cost)
    np.testing.assert_allclose(alone.bands, every.bands)
    np.testing.assert_allclose(alone.state_vector, every.state_vector)
    found = adjust(held, values, states)
    assert found.converged
    np.testing.assert_array_equal(found.values, values)
    np.testing.assert_allclose(found.covariance, np.diag(problem.parameters.prior_std**2))


def test_a_matrix_that_is_not_positive_definite_is_not_factored_whatever_the_unit() -> None:
    bands = np.zeros((12, 6))
    bands[0] = [1.0, 2.0, -0.04, 1.0, 1.0, 0.0]  # of the last nothing is known: it is held
    for unit in (1.0, 1e6):
        with pytest.raises(LinAlgError):
            factor_knots(unit * bands)
    assert factor_knots(np.abs(bands))[0, -1] == 1.0


def test_a_value_known_to_nothing_of_its_prior_leaves_the_others_their_covariance() -> None:
    precision = np.array([[1e8, 3e3], [3e3, 1.5]])
    determinant = 1e8 * 1.5 - 3e3**2
    expected = np.array([[1.5, -3e3], [-3e3, 1e8]]) / determinant
    np.testing.assert_allclose(within_prior(precision, np.array([1e13, 1.0])), expected, rtol=1e-9)


def test_a_search_that_does_not_count_beyond_the_prior_ends_there() -> None:
    problem, found = solve(make_problem(1))
    narrow = tuple(replace(one, std=1e-3 * one.std) for one in problem.parameters.parameters)
    problem = replace(problem, parameters=replace(problem.parameters, parameters=narrow))
    start = np.zeros(problem.parameters.size)
    ended, whole = (adjust(problem, start, found.states, within_prior_only=only) for only in (True, False))
    assert problem.parameters.prior_disagreement(ended.values) is not None
    assert not ended.converged
    assert whole.converged
    assert whole.cost < ended.cost


def test_held_values_stay_and_keep_the_covariance_of_the_prior() -> None:
    made = make_problem(1, objects=4)
    problem, found = solve(made)
    held = np.array([True, False, False, False, False, True])
    begin = np.where(held, 0.3 * problem.parameters.prior_std, found.values)
    fixed = adjust(replace(problem, held=held), begin, found.states)
    assert (fixed.values[held] == begin[held]).all()
    assert (fixed.values[~held] != begin[~held]).all()
    np.testing.assert_allclose(np.diag(fixed.covariance)[held], problem.parameters.prior_std[held] ** 2)
    assert (fixed.covariance[np.ix_(held, ~held)] == 0.0).all()
    assert fixed.cost >= found.cost - 1e-9
