"""Estimators of one object against least squares, one another, and the bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, Rig, make_event
from stereophd.core.disparity.prior import DisparityPrior, InitialPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.core.single.base import AnyEstimator
from stereophd.core.single.build import build_estimator
from stereophd.core.single.settings import (
    CartesianSettings,
    DisparityChoice,
    EstimatorChoice,
    InverseDepthSettings,
    ParticleSettings,
    RectifiedChoice,
)
from tests.core.single import scenes

MOMENTS = {
    "disparity": MomentsSettings(),
    "adaptive": MomentsSettings(method="adaptive"),
    "linear": MomentsSettings(method="linear"),
    "unscented": MomentsSettings(method="unscented"),
    "pseudo-random": MomentsSettings(method="particle", samples=250),
}
ALL: dict[str, EstimatorChoice] = {
    **dict.fromkeys(MOMENTS, DisparityChoice()),
    "particle": ParticleSettings(particles=2000),
    "regularised": ParticleSettings(particles=500, regularised=True, resampling="residual"),
    "inverse depth": InverseDepthSettings(),
    "extended": CartesianSettings(rule="extended"),
    "unscented, world": CartesianSettings(rule="unscented"),
}
KALMAN = [name for name in ALL if name not in ("pseudo-random", "particle", "regularised")]
STATE = np.array([2.0, -3.0, 120.0, 1.0, 0.5, 3.0])


def build(name: str, rig: Rig, motion: Motion, prior: InitialPrior) -> AnyEstimator:
    moments = MOMENTS.get(name, MomentsSettings())
    return build_estimator(ALL[name], moments, rig, motion, prior, np.random.default_rng(7))


def converging(**options: float) -> Rig:
    half = math.pi / 12
    return scenes.rig(scenes.camera("left", -20.0, -half, **options), scenes.camera("right", 20.0, half, **options))


def events(rig: Rig, state: np.ndarray, times: list[float], noise: np.random.Generator | None = None) -> list[Event]:
    """Detections of an object of constant velocity, by all cameras at all times."""
    out = []
    for time_s in times:
        for index, camera in enumerate(rig.cameras):
            when, pixel = time_s, np.zeros((1, 2))
            # a rolling shutter reads the row of the object later: a fixed point, found by iteration
            for _ in range(50):
                pixel = camera.project((state[:3] + when * state[3:])[None])
                when = time_s + float(camera.row_delays(pixel[0, 1:])[0])
            if noise is not None:
                pixel = pixel + scenes.SIGMA * noise.standard_normal((1, 2))
            out.append(make_event(camera, index, time_s, pixel))
    return out


def run(estimator: AnyEstimator, sequence: list[Event]):  # type: ignore[no-untyped-def]
    state = estimator.init()
    for event in sequence:
        state, _ = estimator.step(state, event)
    return estimator.estimate(state)


@pytest.mark.parametrize("name", ["disparity", "adaptive", "linear", "unscented"])
def test_rectified_static_is_least_squares(name: str) -> None:
    """Both algorithms give the exact Gaussian posterior: prior and detections are linear in (u, v, d)."""
    left = scenes.camera("left", 0.0, 0.0)
    # a companion of other intrinsics, beside and below
    right = scenes.camera("right", -12.0, 0.0, fx=700.0, cx=380.0)
    right = replace(right, pose=replace(right.pose, center=np.array([-12.0, 3.0, 0.0])))
    rig, prior = scenes.rig(left, right), InitialPrior(disparity=DisparityPrior(mean_px=6.0, std_px=2.0))
    sequence = events(rig, np.array([2.0, -3.0, 140.0, 0.0, 0.0, 0.0]), [0.0, 1.0], np.random.default_rng(3))
    space = DisparitySpace(left)
    first = np.array([*sequence[0].points[0], 6.0])
    information = np.diag([0.0, 0.0, 0.25])
    vector = information @ first
    for event in sequence:
        other = DisparitySpace(rig.cameras[event.camera])
        at = [other.from_world(space.to_world(y[None]))[0][:2] for y in (np.zeros(3) + first, *(first + np.eye(3)))]
        matrix = np.stack([at[k] - at[0] for k in (1, 2, 3)], axis=1)
        information = information + matrix.T @ matrix / 2.0
        vector = vector + matrix.T @ (event.points[0] - at[0] + matrix @ first) / 2.0
    expected = np.linalg.solve(information, vector)
    for settings in (DisparityChoice(), RectifiedChoice()):
        estimator = build_estimator(settings, MOMENTS[name], rig, Static(), prior, np.random.default_rng(1))
        state = estimator.init()
        for event in sequence:
            state, _ = estimator.step(state, event)
        spaces = [DisparitySpace(camera) for camera in rig.cameras]
        home = next(each for each in spaces if np.array_equal(each.packed(), state.home))
        found = space.from_world(home.to_world(state.mean[None]))[0]
        np.testing.assert_allclose(found, expected, rtol=1e-9)
        if settings.kind == "rectified":
            np.testing.assert_allclose(state.covariance, np.linalg.inv(information), rtol=1e-8, atol=1e-12)
        estimate = estimator.estimate(state)
        np.testing.assert_allclose(estimate.map[:3], space.to_world(expected[None])[0], rtol=1e-9)


def test_rectified_moving_agrees_with_the_general_algorithm() -> None:
    """The same moves in another order: equal but for the non-linearity of the motion, far below the noise."""
    rig = scenes.rig(scenes.camera("left", 0.0, 0.0), scenes.camera("right", -20.0, 0.0))
    prior, motion = (
        InitialPrior(disparity=DisparityPrior(mean_px=8.0, std_px=2.0), velocity_std=3.0),
        ConstantVelocity([0.05] * 3),
    )
    sequence = events(rig, STATE, [0.5 * k for k in range(40)], np.random.default_rng(4))
    one, two = (
        run(build_estimator(one, MomentsSettings(), rig, motion, prior, np.random.default_rng(1)), sequence)
        for one in (DisparityChoice(), RectifiedChoice())
    )
    std = np.sqrt(np.diag(one.covariance))
    assert (np.abs(one.mean - two.mean) < 0.05 * std).all()
    np.testing.assert_allclose(np.sqrt(np.diag(two.covariance)), std, rtol=0.02)


def test_rectified_refuses_other_cameras() -> None:
    prior = InitialPrior(disparity=DisparityPrior(mean_px=8.0, std_px=2.0))
    settings = RectifiedChoice(), MomentsSettings()
    with pytest.raises(ValueError, match="right to be rectified with left"):
        build_estimator(*settings, converging(), Static(), prior, np.random.default_rng(1))
    ahead = scenes.camera("right", 20.0, 0.0)
    ahead = replace(ahead, pose=replace(ahead.pose, center=np.array([20.0, 0.0, 5.0])))
    before = scenes.rig(scenes.camera("left", 0.0, 0.0), ahead)
    with pytest.raises(ValueError, match="rectified"):
        build_estimator(*settings, before, Static(), prior, np.random.default_rng(1))


@pytest.mark.parametrize("name", KALMAN)
@pytest.mark.parametrize("motion", [Static(), ConstantVelocity([0.02] * 3)], ids=["static", "moving"])
def test_exact_detections_lead_to_the_truth(name: str, motion: Motion) -> None:
    truth = STATE if isinstance(motion, ConstantVelocity) else np.array([*STATE[:3], 0.0, 0.0, 0.0])
    rig, prior = converging(), InitialPrior(disparity=DisparityPrior(mean_px=8.0, std_px=1.0), velocity_std=3.0)
    times = [0.5 * k for k in range(60)]
    estimate = run(build(name, rig, motion, prior), events(rig, truth, times))
    expected = np.array([*(truth[:3] + times[-1] * truth[3:]), *truth[3:]])
    std = np.sqrt(np.diag(estimate.covariance))
    for point in (estimate.mean, estimate.map):
        assert (np.abs(point - expected) <= 0.3 * std).all(), (point - expected) / std


@pytest.mark.parametrize("name", ALL)
def test_pure_and_patient(name: str) -> None:
    """Nothing outside the state; nothing known at first; an empty frame only lets time pass."""
    rig, motion, prior = (
        converging(),
        ConstantVelocity([0.05] * 3),
        InitialPrior(disparity=DisparityPrior(mean_px=8.0, std_px=1.0), velocity_std=3.0),
    )
    estimator = build(name, rig, motion, prior)
    sequence = events(rig, STATE, [0.0, 0.5, 1.0], np.random.default_rng(5))
    state = estimator.init()
    assert estimator.estimate(state) is None
    nothing = make_event(rig.cameras[0], 0, -1.0, np.empty((0, 2)))
    state, log_likelihood = estimator.step(state, nothing)
    assert estimator.estimate(state) is None
    assert log_likelihood == 0.0
    for event in sequence:
        before = state
        state, log_likelihood = estimator.step(before, event)
        again, _ = estimator.step(before, event)
        np.testing.assert_array_equal(estimator.estimate(state).mean, estimator.estimate(again).mean)
        assert np.isfinite(log_likelihood)
    known = estimator.estimate(state)
    later, _ = estimator.step(state, replace(nothing, time_s=2.0))
    coasted = estimator.estimate(later)
    drift = coasted.mean - known.mean
    # the mean of a non-linear map of a Gaussian that has grown: to a fraction of its standard deviation
    std = np.sqrt(np.diag(coasted.covariance))
    assert (np.abs(drift - np.array([*known.mean[3:], 0.0, 0.0, 0.0])) < 0.5 * std).all()
    assert np.trace(coasted.covariance) > np.trace(known.covariance)
    with pytest.raises(ValueError, match="at most one detection"):
        estimator.step(state, make_event(rig.cameras[0], 0, 2.0, np.array([[10.0, 10.0], [20.0, 20.0]])))


@pytest.mark.parametrize("name", KALMAN)
def test_rolling_shutter(name: str) -> None:
    """A detection is of the time of its row: an object that falls 20 cm a frame is not misplaced."""
    truth = np.array([0.0, -60.0, 200.0, 5.0, 40.0, 0.0])
    rig = converging(readout_s=0.4)
    prior, motion = (
        InitialPrior(disparity=DisparityPrior(mean_px=4.5, std_px=0.5), velocity_std=20.0),
        ConstantVelocity([0.1] * 3),
    )
    times = [0.1 * k for k in range(25)]
    estimate = run(build(name, rig, motion, prior), events(rig, truth, times))
    expected = np.array([*(truth[:3] + times[-1] * truth[3:]), *truth[3:]])
    std = np.sqrt(np.diag(estimate.covariance))
    assert (np.abs(estimate.mean - expected) <= 0.3 * std).all(), (estimate.mean - expected) / std


@pytest.mark.parametrize("name", ["disparity", "inverse depth", "extended", "unscented, world"])
def test_moving_camera(name: str) -> None:
    """One camera that moves sideways locates a static object; its pose is taken at the time of each event."""
    camera = scenes.camera("moving", -20.0, 0.0)
    camera = replace(camera, pose=replace(camera.pose, velocity=np.array([10.0, 0.0, 0.0])))
    rig, truth = scenes.rig(camera), np.array([2.0, -3.0, 120.0])
    estimator = build(name, rig, Static(), InitialPrior(disparity=DisparityPrior(mean_px=8.0, std_px=1.0)))
    state = estimator.init()
    for k in range(40):
        frozen = camera.at(0.1 * k)
        state, _ = estimator.step(state, make_event(frozen, 0, 0.1 * k, frozen.project(truth[None])))
    estimate = estimator.estimate(state)
    assert (np.abs(estimate.mean[:3] - truth) <= 0.3 * np.sqrt(np.diag(estimate.covariance))[:3]).all()


def test_detection_where_no_sample_is_in_view() -> None:
    """A camera that sees none of the prior still locates the object: lines stay lines."""
    left, right = scenes.camera("left", 0.0, 0.0), scenes.camera("right", 100.0, math.pi / 3)
    rig, truth = scenes.rig(left, right), np.array([0.0, 0.0, 50.0])
    estimator = build("disparity", rig, Static(), InitialPrior(disparity=DisparityPrior(mean_px=3.0, std_px=0.5)))
    sequence = [make_event(camera, k, 0.0, camera.project(truth[None])) for k, camera in enumerate(rig.cameras)]
    estimate = run(estimator, sequence)
    assert np.linalg.norm(estimate.map[:3] - truth) < 1.0


def test_object_beyond_infinity_has_no_place() -> None:
    """The Gaussian may be centred at or beyond infinity; the estimate is then NaN, and not an error."""
    rig = scenes.rig(scenes.camera("left", 0.0, 0.0), scenes.camera("right", -20.0, 0.0))
    for name in ("disparity", "inverse depth"):
        estimator = build(name, rig, Static(), InitialPrior(disparity=DisparityPrior(mean_px=0.2, std_px=0.5)))
        sequence = [
            make_event(rig.cameras[0], 0, 0.0, np.array([[400.0, 300.0]])),
            make_event(rig.cameras[1], 1, 0.0, np.array([[380.0, 300.0]])),
        ]
        estimate = run(estimator, sequence)
        assert np.isnan(estimate.mean).all()
        assert np.isnan(estimate.map).all()
