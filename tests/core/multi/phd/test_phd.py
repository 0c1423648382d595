"""The filter on disparity space: eq. (5) by hand, the log-likelihood, the field of view, invariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.disparity import moments
from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import Sources
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.multi.base import FilterState
from stereophd.core.multi.filter_settings.common import BirthPrior, Hysteresis
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.state.mixture import GaussianMixture
from tests.core.disparity.cases import LENSES, make_camera, state_in
from tests.core.multi.scenes import make_filter, make_mixture

AREA = 800.0 * 600.0


def state_of(mixture: GaussianMixture, time_s: float = 0.0) -> FilterState:
    return FilterState(mixture, time_s, 1, 100, 50)


def one_object(multi_filter: PhdFilter, weight: float, world: list[float], camera: int = 0) -> FilterState:
    """A state with one component at a place, known to 3 px and 1 px of disparity."""
    rig = multi_filter.rig
    space = DisparitySpace(rig.cameras[camera].at(0.0), rig.baseline, rig.rectification)
    size = 3 if isinstance(multi_filter.motion, Static) else 6
    mean = state_in(space, world[:size])
    covariance = np.diag([3.0, 3.0, 0.5, 1.0, 1.0, 0.1])[:size, :size] ** 2
    return state_of(make_mixture([weight], mean[None], covariance[None], [camera], [0.0]))


def run(
    multi_filter: PhdFilter, frames: list[tuple[float, int, np.ndarray]]
) -> list[tuple[FilterState, Info, Estimates]]:
    state, out = multi_filter.init(), []
    for time_s, camera, pixels in frames:
        frozen = multi_filter.rig.cameras[camera].at(time_s)
        state, info, estimates = multi_filter.step(state, make_event(frozen, camera, time_s, pixels))
        out.append((state, info, estimates))
    return out


def made_up_frames(multi_filter: PhdFilter, count: int = 12, seed: int = 3) -> list[tuple[float, int, np.ndarray]]:
    """Three moving objects, clutter and misses, cameras in turn."""
    rng = np.random.default_rng(seed)
    start = np.array([[5.0, 3.0, 100.0], [-10.0, -8.0, 140.0], [12.0, 6.0, 180.0]])
    velocity = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -0.5], [-1.0, 0.5, 0.0]])
    frames = []
    for k in range(count):
        camera, time_s = k % len(multi_filter.rig.cameras), 0.5 * k
        pixels = multi_filter.rig.cameras[camera].at(time_s).project(start + velocity * time_s)
        pixels = pixels + rng.standard_normal(pixels.shape)
        clutter = rng.uniform([0.0, 0.0], [799.0, 599.0], (rng.poisson(5.0), 2))
        frames.append((time_s, camera, np.concatenate([pixels[rng.random(3) < 0.95], clutter])))
    return frames


@pytest.mark.parametrize("size", [3, 6])
def test_eq_5_by_hand(size: int) -> None:
    """One component in view and one detection: three components, with weights from the formula."""
    motion = Static() if size == 3 else ConstantVelocity([0.0] * 3)
    camera = make_camera(p_detect=0.9, sigma=(1.5, 1.5), clutter=10.0)
    birth = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=2.0), velocity_std=1.5)
    multi_filter = make_filter([camera], motion, birth=birth, births=0.2, survival_per_s=0.9, merge_distance=0.0)
    mean = np.array([400.0, 300.0, 8.0, 0.0, 0.0, 0.0])[:size]
    covariance = np.diag([4.0, 9.0, 1.0, 1e-6, 1e-6, 1e-8])[:size, :size].copy()
    covariance[0, 2] = covariance[2, 0] = 0.5
    state = state_of(make_mixture([0.7], mean[None], covariance[None]))
    detection = np.array([[402.0, 299.0]])
    event = make_event(camera, 0, 0.0, detection)
    new, info = multi_filter.update(state, multi_filter.predict(state, event), event)

    spread = np.array([4.0 + 2.25, 9.0 + 2.25])
    density = np.exp(-0.5 * (2.0**2 / spread[0] + 1.0 / spread[1])) / (2.0 * np.pi * np.sqrt(spread.prod()))
    joint = 0.9 * 0.7 * density
    born, false = 0.9 * 0.2 / AREA, 10.0 / AREA
    total = false + born + joint
    expected = {"missed": 0.1 * 0.7, "detected": joint / total, "born": born / total}
    assert new.mixture.size == 3
    order = np.argsort(-new.mixture.weights)
    assert new.mixture.weights[order].tolist() == pytest.approx(sorted(expected.values(), reverse=True), rel=1e-12)
    assert info.log_likelihood == pytest.approx(np.log(total) - 10.0 - 0.9 * 0.2 - 0.9 * 0.7, rel=1e-12)
    assert info.cardinality_mean == pytest.approx(sum(expected.values()), rel=1e-12)
    detected = int(np.argmin(np.abs(new.mixture.weights - expected["detected"])))
    gain = covariance[:, :2] / spread
    np.testing.assert_allclose(new.mixture.means[detected], mean + gain @ [2.0, -1.0], rtol=1e-9, atol=1e-12)
    updated = covariance - gain @ covariance[:2]
    np.testing.assert_allclose(new.mixture.covariances[detected], updated, rtol=1e-9, atol=1e-12)
    # labels: the birth has a new one, the others the old
    born_at = int(np.argmin(np.abs(new.mixture.weights - expected["born"])))
    assert new.mixture.labels[born_at] == 100
    assert set(np.delete(new.mixture.labels, born_at)) == {0}
    assert (new.next_label, new.time_s, new.n_events) == (101, 0.0, 2)


def test_survival_by_the_time_that_passes() -> None:
    multi_filter = make_filter([make_camera()], Static(), survival_per_s=0.8)
    state = one_object(multi_filter, 0.6, [0.0, 0.0, 100.0])
    for elapsed in (0.0, 0.25, 3.0):
        event = make_event(multi_filter.rig.cameras[0], 0, elapsed, np.empty((0, 2)))
        prediction = multi_filter.predict(state, event)
        np.testing.assert_allclose(prediction.mixture.weights, [0.6 * 0.8**elapsed], rtol=1e-14)


def test_empty_frames_are_information() -> None:
    camera = make_camera(p_detect=0.9, clutter=3.0)
    multi_filter = make_filter([camera], Static(), survival_per_s=1.0)
    state = one_object(multi_filter, 0.6, [0.0, 0.0, 100.0])
    for missed in range(1, 4):
        event = make_event(camera, 0, float(missed), np.empty((0, 2)))
        weight = state.mixture.weights[0]
        state, info, estimates = multi_filter.step(state, event)
        assert info.log_likelihood == pytest.approx(-3.0 - 0.9 * 0.1 - 0.9 * weight, rel=1e-12)
        np.testing.assert_allclose(state.mixture.weights, [0.6 * 0.1**missed], rtol=1e-12)
        assert len(estimates.track_ids) == 0


@pytest.mark.parametrize("lens", list(LENSES))
def test_likelihood_of_clutter_alone_does_not_depend_on_the_lens(lens: str) -> None:
    camera = make_camera(lens=LENSES[lens], p_detect=0.9, clutter=3.0)
    multi_filter = make_filter([camera])
    pixels = np.random.default_rng(1).uniform(0.0, 599.0, (7, 2))
    event = make_event(camera, 0, 0.0, pixels)
    state = multi_filter.init()
    _, info = multi_filter.update(state, multi_filter.predict(state, event), event)
    rate = 3.0 + 0.9 * 0.1
    assert info.log_likelihood == pytest.approx(7 * np.log(rate / AREA) - rate, rel=1e-12)


@pytest.mark.parametrize("lens", ["radial", "fisheye"])
def test_likelihood_is_over_distorted_pixels(lens: str) -> None:
    """The density of a detection per distorted pixel: N(z; ...) over undistorted ones, times the area."""
    camera = make_camera(lens=LENSES[lens], p_detect=0.9, clutter=3.0)
    multi_filter = make_filter([camera], Static(), survival_per_s=1.0)
    state = one_object(multi_filter, 0.8, [30.0, 20.0, 100.0])
    mean, covariance = state.mixture.means[0, :2], state.mixture.covariances[0, :2, :2]
    pixels = camera.distort_pixels(mean[None] + [2.0, 1.0])[0]
    event = make_event(camera, 0, 0.0, pixels)
    _, info = multi_filter.update(state, multi_filter.predict(state, event), event)
    h = 1e-3
    jacobian = (
        camera.undistort_pixels(pixels + h * np.eye(2))[0] - camera.undistort_pixels(pixels - h * np.eye(2))[0]
    ).T / (2.0 * h)
    spread = covariance + jacobian @ np.diag(camera.detector.sigma**2) @ jacobian.T
    residual = np.array([2.0, 1.0])
    density = np.exp(-0.5 * residual @ np.linalg.solve(spread, residual)) / (2 * np.pi * np.sqrt(np.linalg.det(spread)))
    area = abs(np.linalg.det(jacobian))
    assert abs(area - 1.0) > 0.02
    total = (3.0 + 0.09) / AREA + 0.9 * 0.8 * density * area
    assert info.log_likelihood == pytest.approx(np.log(total) - 3.0 - 0.09 - 0.9 * 0.8, rel=1e-6)


def test_total_mass_at_the_edge_of_the_image() -> None:
    """Without detections an object half in view loses p_detect of the half, and stays where it came from."""
    cameras = [make_camera(), make_camera(center=(35.0, 0.0, 0.0), p_detect=0.9)]
    multi_filter = make_filter(cameras, Static(), method="qmc", samples=1024, survival_per_s=1.0)
    state = one_object(multi_filter, 0.8, [-9.5, 0.0, 100.0])
    event = make_event(cameras[1], 1, 0.0, np.empty((0, 2)))
    prediction = multi_filter.predict(state, event)
    fraction = prediction.moved.fraction[0]
    assert 0.2 < fraction < 0.8
    new, info = multi_filter.update(state, prediction, event)
    assert new.mixture.weights.sum() == pytest.approx(0.8 * (1.0 - 0.9 * fraction), rel=1e-12)
    assert info.log_likelihood == pytest.approx(-10.0 - 0.9 * 0.1 - 0.9 * fraction * 0.8, rel=1e-12)
    assert (new.mixture.cameras[0], new.mixture.times[0]) == (0, 0.0)
    # out of view to the left: that part of the Gaussian is what is left
    space = multi_filter.rig.space(1, 0.0)
    before, after = (
        move(
            Sources(m.means, m.covariances, multi_filter.rig.packed[[0]], Static().arrays(np.zeros(1))),
            space,
            multi_filter.sets,
            0,
        )
        for m in (state.mixture, new.mixture)
    )
    assert after.fraction[0] < before.fraction[0]


@pytest.mark.parametrize("world", [[0.0, 0.0, -100.0], [300.0, 0.0, 100.0]], ids=["behind", "beside"])
def test_objects_out_of_view_are_left_alone(world: list[float]) -> None:
    cameras = [make_camera(), make_camera((0.0, np.pi if world[2] < 0 else np.pi / 2, 0.0))]
    multi_filter = make_filter(cameras, Static(), survival_per_s=1.0)
    state = one_object(multi_filter, 0.8, world, camera=1)
    event = make_event(cameras[0], 0, 5.0, np.array([[400.0, 300.0]]))
    new, info = multi_filter.update(state, multi_filter.predict(state, event), event)
    old = int(np.flatnonzero(new.mixture.labels == 0)[0])
    assert new.mixture.weights[old] == 0.8
    np.testing.assert_array_equal(new.mixture.means[old], state.mixture.means[0])
    assert (new.mixture.cameras[old], new.mixture.times[old]) == (1, 0.0)
    assert info.log_likelihood == pytest.approx(np.log((10.0 + 0.095) / AREA) - 10.0 - 0.095, rel=1e-12)


def assert_equal_states(one: FilterState, other: FilterState) -> None:
    for name in ("weights", "means", "covariances", "cameras", "times", "labels", "tracks", "reported"):
        np.testing.assert_array_equal(getattr(one.mixture, name), getattr(other.mixture, name))
    assert (one.undetected is None) == (other.undetected is None)
    if one.undetected is not None and other.undetected is not None:
        np.testing.assert_array_equal(one.undetected.counts, other.undetected.counts)
        np.testing.assert_array_equal(one.undetected.initial_share, other.undetected.initial_share)
    assert replace(one, mixture=other.mixture, undetected=other.undetected) == other


@pytest.mark.parametrize("method", ["qmc", "particle", "unscented", "linear"])
def test_order_of_detections_does_not_matter(method: str) -> None:
    multi_filter = make_filter(method=method)
    rng = np.random.default_rng(4)
    frames = made_up_frames(multi_filter)
    shuffled = [(time_s, camera, rng.permutation(pixels)) for time_s, camera, pixels in frames]
    for one, other in zip(run(multi_filter, frames), run(multi_filter, shuffled), strict=True):
        assert_equal_states(one[0], other[0])
        assert one[1] == other[1]
        np.testing.assert_array_equal(one[2].states, other[2].states)
        np.testing.assert_array_equal(one[2].track_ids, other[2].track_ids)


def test_threads_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moments, "TRIPS_PER_THREAD", 200)
    frames = made_up_frames(make_filter())
    for one, other in zip(run(make_filter(threads=1), frames), run(make_filter(threads=2), frames), strict=True):
        assert_equal_states(one[0], other[0])
        assert one[1] == other[1]


def test_a_state_can_be_used_again() -> None:
    multi_filter = make_filter()
    frames = made_up_frames(multi_filter)
    history = run(multi_filter, frames)
    state = history[5][0]
    weights, means = state.mixture.weights.copy(), state.mixture.means.copy()
    time_s, camera, pixels = frames[6]
    event = make_event(multi_filter.rig.cameras[camera], camera, time_s, pixels)
    first, _, _ = multi_filter.step(state, event)
    second, _, _ = multi_filter.step(state, event)
    assert_equal_states(first, second)
    assert_equal_states(first, history[6][0])
    np.testing.assert_array_equal(state.mixture.weights, weights)
    np.testing.assert_array_equal(state.mixture.means, means)


@pytest.mark.parametrize("method", ["qmc", "particle", "unscented", "linear"])
def test_objects_are_found_where_they_are(method: str) -> None:
    """Three objects seen by both cameras, after twelve frames: each within 3 cm, and within what is reported."""
    multi_filter = make_filter(method=method, samples=256, extraction=Hysteresis(confirm=0.5, release=0.02))
    frames = made_up_frames(multi_filter, 24)
    _, info, estimates = run(multi_filter, frames)[-1]
    truth = np.array([[5.0, 3.0, 100.0], [-10.0, -8.0, 140.0], [12.0, 6.0, 180.0]])
    truth = truth + np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -0.5], [-1.0, 0.5, 0.0]]) * frames[-1][0]
    assert info.cardinality_mean == pytest.approx(3.0, abs=1.0)
    assert len(estimates.track_ids) == len(set(estimates.track_ids)) == 3
    assert (np.diff(estimates.track_ids) > 0).all()
    for place in truth:
        k = int(np.argmin(np.linalg.norm(estimates.states[:, :3] - place, axis=1)))
        error = estimates.states[k, :3] - place
        assert np.linalg.norm(error) < 3.0
        assert error @ np.linalg.solve(estimates.covariances[k, :3, :3], error) < 25.0
        np.linalg.cholesky(estimates.covariances[k])


def test_every_covariance_of_a_run_has_full_rank() -> None:
    for method in ("qmc", "particle", "unscented", "linear"):
        for state, _, _ in run(make_filter(method=method, samples=32), made_up_frames(make_filter(), 20, seed=8)):
            np.linalg.cholesky(state.mixture.covariances)
            assert (state.mixture.weights >= 1e-6).all()


def test_same_time_in_two_cameras_and_static_objects() -> None:
    """Frames of several cameras at one time, and cameras in no fixed order."""
    multi_filter = make_filter(motion=Static(), extraction=Hysteresis(confirm=0.5, release=0.02))
    rng = np.random.default_rng(5)
    truth = np.array([[5.0, 3.0, 100.0], [-10.0, -8.0, 140.0]])
    frames = []
    for time_s in (0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 2.5, 2.5):
        camera = int(rng.integers(0, 2))
        pixels = multi_filter.rig.cameras[camera].project(truth)
        frames.append((time_s, camera, pixels + rng.standard_normal((2, 2))))
    _, _, estimates = run(multi_filter, frames)[-1]
    assert len(estimates.track_ids) == 2
    for place in truth:
        assert np.linalg.norm(estimates.states[:, :3] - place, axis=1).min() < 4.0
    assert not estimates.states[:, 3:].any()
