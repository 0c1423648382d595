"""Every motion model simulated, moved between cameras, tracked, smoothed, stitched and calibrated with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.problem import SQUARED, Problem
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.adjustment.trajectories import (
    fit_states,
    interpolation,
    knot_spacing,
    place_knots,
    positions,
)
from stereophd.core.disparity.events import Event, Rig, make_event, make_rig
from stereophd.core.disparity.moments import world_moments
from stereophd.core.disparity.moved import IN_VIEW
from stereophd.core.disparity.prior import DisparityPrior, InitialPrior
from stereophd.core.motion.base import Motion
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.core.simulation.objects import MovingObject, Path
from stereophd.core.single.build import build_estimator
from stereophd.core.single.settings import (
    CartesianSettings,
    DisparityChoice,
    EstimatorChoice,
    InverseDepthSettings,
    ParticleSettings,
)
from stereophd.core.trajectories.joins import stitch
from stereophd.core.trajectories.smoothing import Trajectory, extend_back, smooth
from tests.core.calibration.scenes import make_problem
from tests.core.disparity.cases import converging, make_camera, oracle_world, random_covariance, state_in, weighted
from tests.core.disparity.moves import Case, sample_sets
from tests.core.motion.examples import MOVING, WORDS, example
from tests.core.multi.pmb.test_pmb import make_pmb
from tests.core.multi.scenes import make_filter

START = np.array([2.0, -5.0, 110.0, 1.0, -2.0, 0.5])
TIMES = 0.3 * np.arange(20)
every = pytest.mark.parametrize("word", WORDS)
moving = pytest.mark.parametrize("word", MOVING)


def path(motion: Motion, seed: int, times: np.ndarray = TIMES) -> np.ndarray:
    """States (k, 6) of a simulated object."""
    item = MovingObject(0, 0.0, np.inf, START[:3], START[3:] * motion.moves, seed)
    return Path(item, motion).states(times)


def rig() -> Rig:
    """Two cameras that miss nothing and see no clutter to speak of."""
    quiet = {"p_detect": 1.0, "clutter": 1e-3}
    left = make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0), **quiet)  # type: ignore[arg-type]
    right = make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0), **quiet)  # type: ignore[arg-type]
    return make_rig([left, right], 1.0, "horizontal")


def events(cameras: Rig, states: np.ndarray, seed: int, times: np.ndarray = TIMES) -> list[Event]:
    """Detections of an object by both cameras in turn."""
    rng, out = np.random.default_rng((seed, 1)), []
    for time_s, state in zip(times, states, strict=True):
        for index, camera in enumerate(cameras.cameras):
            pixels = camera.project(state[None, :3]) + rng.standard_normal((1, 2)) * camera.detector.sigma
            out.append(make_event(camera, index, float(time_s), pixels))
    return out


@every
def test_without_noise_a_simulated_object_follows_the_transition(word: str) -> None:
    motion = example(word, acceleration_std=0.0)
    states = path(motion, 1)
    for time_s, state in zip(TIMES, states, strict=True):
        matrix, _, drift = motion.transition(float(time_s))
        np.testing.assert_allclose(state, matrix @ states[0] + drift, atol=1e-12)


@every
@pytest.mark.parametrize("dt", [0.5, -0.3, 0.0])
def test_moves_are_the_trips_of_their_samples(word: str, dt: float) -> None:
    motion = example(word)
    size = motion.state_size
    home, destination = converging(20.0, 0.26)
    covariance = random_covariance(np.random.default_rng(1), [1.0, 1.2, 0.15, 1.0, 1.0, 0.02][:size])
    case = Case(state_in(home, START[:size]), covariance, home, destination, dt, motion)
    sets = sample_sets("qmc", 128, motion)
    moved = case.move(sets, turn=2)
    assert moved.status[0] == IN_VIEW
    mean, spread = weighted(case.trip(sets.turn(2))[0], np.ones(128))
    np.testing.assert_allclose(moved.means[0], mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(moved.covariances[0], spread, rtol=1e-7, atol=1e-9)
    # rules of low order agree with the samples, the map being nearly linear
    std = np.sqrt(np.diag(spread))
    for method in ("unscented", "linear"):
        other = case.move(sample_sets(method, 128, motion), turn=2)
        np.testing.assert_allclose((other.means[0] - mean) / std, 0.0, atol=0.02)
        np.testing.assert_allclose(other.covariances[0] / np.outer(std, std), spread / np.outer(std, std), atol=0.03)
    found, covariances = world_moments(
        case.mean[None], covariance[None], home.packed()[None], np.array([dt]), motion, sets, 2
    )
    mean, spread = weighted(oracle_world(case.mean, covariance, sets.turn(2), home, dt, motion), np.ones(128))
    np.testing.assert_allclose(found[0, :size], mean, rtol=1e-9)
    np.testing.assert_allclose(covariances[0, :size, :size], spread, rtol=1e-6, atol=1e-9)


def build(kind: str, motion: Motion) -> DisparityFilter:
    cameras = list(rig().cameras)
    return make_pmb(cameras, motion) if kind == "pmb" else make_filter(cameras, motion)


@every
@pytest.mark.parametrize("kind", ["phd", "pmb"])
def test_tracked_objects_have_the_errors_that_the_filter_states(word: str, kind: str) -> None:
    """NEES of the position after two seconds: 3 on average; of 12 objects at 6 times each, that hang together."""
    motion = example(word)
    multi_filter, squares = build(kind, motion), []
    for seed in range(12):
        states = path(motion, seed)
        state = multi_filter.init()
        for number, event in enumerate(events(multi_filter.rig, states, seed)):
            state, _, estimates = multi_filter.step(state, event)
            if number % 2 == 1 and number >= 16 and number % 4 == 3:
                assert len(estimates.states) == 1
                error = (estimates.states[0] - states[number // 2])[:3]
                squares.append(error @ np.linalg.solve(estimates.covariances[0][:3, :3], error))
    assert 2.0 < np.mean(squares) < 4.2


SINGLES: dict[str, EstimatorChoice] = {
    "disparity": DisparityChoice(),
    "inverse_depth": InverseDepthSettings(),
    "extended": CartesianSettings(rule="extended"),
    "unscented": CartesianSettings(rule="unscented"),
    "particle": ParticleSettings(particles=4000, regularised=True),
}


@every
@pytest.mark.parametrize("estimator", sorted(SINGLES))
def test_single_object_estimators(word: str, estimator: str) -> None:
    """Mean NEES of the position at the end of six objects: below the 99.9 % quantile of chi-square(18) / 6."""
    motion, cameras = example(word), rig()
    prior = InitialPrior(disparity=DisparityPrior(mean_px=8.0, std_px=2.0), velocity_std=2.0)
    squares = []
    for seed in range(6):
        states = path(motion, seed)
        moments, rng = MomentsSettings(samples=128), np.random.default_rng(seed)
        built = build_estimator(SINGLES[estimator], moments, cameras, motion, prior, rng)
        state = built.init()
        for event in events(cameras, states, seed):
            state, _ = built.step(state, event)
        # and half a second later, without a detection
        for later, truth in ((0.0, states[-1]), (0.5, None)):
            estimate = built.estimate(built.at(state, float(TIMES[-1]) + later))
            assert estimate is not None
            if truth is None:
                truth, spread = motion.transition(later).predict(states[-1], np.zeros((6, 6)))
            else:
                spread = np.zeros((6, 6))
            error = (estimate.mean - truth)[:3]
            whole = estimate.covariance[:3, :3] - 0.99 * spread[:3, :3]
            squares.append(error @ np.linalg.solve(whole, error))
    assert np.mean(squares) < 42.3 / 6.0


def filtered(motion: Motion, states: np.ndarray, seed: int, noise: float = 0.3) -> Trajectory:
    """The Kalman filter over noisy positions of an object."""
    rng, observe = np.random.default_rng((seed, 2)), np.eye(3, 6)
    mean, covariance = np.zeros(6), np.diag([1e4] * 3 + [25.0] * 3)
    means, covariances = [], []
    for k, state in enumerate(states):
        if k:
            mean, covariance = motion.transition(float(TIMES[k] - TIMES[k - 1])).predict(mean, covariance)
        gain = covariance @ observe.T @ np.linalg.inv(observe @ covariance @ observe.T + noise**2 * np.eye(3))
        mean = mean + gain @ (state[:3] + noise * rng.standard_normal(3) - observe @ mean)
        covariance = covariance - gain @ observe @ covariance
        means.append(mean)
        covariances.append(covariance)
    count = len(states)
    return Trajectory(0, np.arange(count), TIMES, np.array(means), np.array(covariances), np.ones(count))


@moving
def test_smoothed_states_have_the_errors_that_the_smoother_states(word: str) -> None:
    """Mean NEES of whole states, from the start on: 6, within 5 standard errors of 60 objects."""
    motion, squares = example(word), []
    for seed in range(60):
        states = path(motion, seed)
        smoothed = smooth(filtered(motion, states, seed), motion)
        for k in (0, 7, 14):
            error = smoothed.states[k] - states[k]
            squares.append(error @ np.linalg.solve(smoothed.covariances[k], error))
    assert abs(np.mean(squares) - 6.0) < 5.0 * np.sqrt(12.0 / 60.0)


@moving
def test_tracks_are_continued_back_and_joined(word: str) -> None:
    motion = example(word)
    states = path(example(word, acceleration_std=0.0), 3)
    whole = Trajectory(0, np.arange(20), TIMES, states, np.tile(0.01 * np.eye(6), (20, 1, 1)), np.ones(20))
    late = Trajectory(0, whole.events[8:], TIMES[8:], states[8:], whole.covariances[8:], np.ones(12))
    np.testing.assert_allclose(extend_back(late, np.arange(8), TIMES[:8], motion).states, states, atol=1e-10)
    early = Trajectory(1, whole.events[:3], TIMES[:3], states[:3], whole.covariances[:3], np.ones(3))
    assert stitch([late, early], motion, 3.0) == {0: 1}


@moving
def test_fitted_trajectories_follow_the_motion(word: str) -> None:
    """Between its knots and beyond them; without noise one knot carries the whole trajectory."""
    for motion in (example(word), example(word, acceleration_std=0.0)):
        states = path(example(word, acceleration_std=0.0), 4)
        knots = place_knots([TIMES[TIMES <= 3.0]], knot_spacing(motion, 0.2), motion)
        assert motion.noisy or len(knots.times) == 1
        inner = TIMES <= 3.0
        at = interpolation(knots, np.zeros(int(inner.sum()), dtype=int), TIMES[inner])
        fitted = fit_states(knots, *at, states[inner, :3], np.full(int(inner.sum()), 1e4))
        everywhere = interpolation(knots, np.zeros(len(TIMES), dtype=int), TIMES)
        np.testing.assert_allclose(positions(fitted, *everywhere), states[:, :3], atol=1e-4)


@moving
def test_calibration_with_its_trajectories(word: str) -> None:
    """From near the truth: errors of the poses agree with their covariance, chi-square(6) within 5 std."""
    made = make_problem(5, objects=4, frames=40)
    # over 40 s objects neither stop nor leave
    slowly: dict[str, dict[str, object]] = {
        "ballistic": {"gravity": (0.0, 0.02, 0.0)},
        "damped_velocity": {"time_constant_s": 30.0},
    }
    motion = example(word, acceleration_std=0.002, **slowly.get(word, {}))
    seen, parameters = made.observations, made.parameters
    truth = parameters.build(made.truth)
    starts = {j: made.positions[np.argmax((seen.trajectories == j) & (seen.times == 0.0))] for j in range(4)}
    rng, points, world = np.random.default_rng(6), seen.points.copy(), made.positions.copy()
    for j, start in starts.items():
        item = MovingObject(j, 0.0, np.inf, start, rng.normal(0.0, 0.3, 3), j)
        here = np.flatnonzero(seen.trajectories == j)
        times, index = np.unique(seen.times[here], return_inverse=True)
        world[here] = Path(item, motion).states(times)[index, :3]
    for number, camera in enumerate(truth):
        here = seen.cameras == number
        points[here] = camera.project(world[here]) + 1.4 * rng.standard_normal((int(here.sum()), 2))
    observations = replace(seen, points=points)
    knots = place_knots([np.arange(40.0)] * 4, knot_spacing(motion, 0.2), motion)
    at = interpolation(knots, seen.trajectories, seen.times)
    states = fit_states(knots, *at, world, np.full(len(world), 0.04))
    problem = Problem(parameters, 0, knots, observations, SQUARED)
    found = adjust(problem, made.truth, states)
    assert found.converged
    error = found.values - made.truth
    assert error @ np.linalg.solve(found.covariance, error) < 6.0 + 5.0 * np.sqrt(12.0)
    # squared distances of two coordinates, less what 14 parameters of each object take up
    assert 1.6 < found.distances.mean() < 2.1
