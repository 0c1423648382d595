"""Births per second: neither the frame rate nor the number of cameras changes how many objects are expected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.births.undetected import (
    LEAST_INITIAL,
    Undetected,
    all_undetected,
    birth_rates,
    expected_births,
    undetected_shares,
)
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.state.inputs import EventNumbers
from tests.core.disparity.cases import make_camera

PRIOR = BirthPrior(per_s=0.5, initial=3.0, disparity=DisparityPrior(mean_px=7.0, std_px=2.0), velocity_std=1.5)


def event(camera: Camera, index: int, time_s: float, n_detections: int = 0) -> Event:
    return make_event(camera, index, time_s, np.full((n_detections, 2), 100.0))


def births_of(
    before: Undetected | None, prior: BirthPrior, left: np.ndarray, elapsed: float, event: Event, camera: Camera,
    known: float = 0.0,
) -> tuple[float, Undetected]:  # fmt: skip
    """`expected_births` of an event without a burst of clutter."""
    detector = camera.detector
    numbers = EventNumbers(
        event.camera, event.time_s, elapsed, 0, len(event.points), detector.p_detect, 0.0, 1.0, 1.0, 1.0,
        detector.clutter_per_frame, 0.0,
    )  # fmt: skip
    births, after, burst = expected_births(
        before or all_undetected(len(left)), birth_rates(prior), left, numbers, known
    )
    assert burst == 0
    return births, after


def first_detections(prior: BirthPrior, overlap: np.ndarray, rate_hz: float, seconds: float, p_detect: float) -> float:
    """Expected number of first detections of all cameras, each at this rate."""
    camera = make_camera(p_detect=p_detect)
    state: Undetected | None = None
    total, time_s = 0.0, 0.0
    for frame in range(round(rate_hz * seconds)):
        for index in range(len(overlap)):
            now = frame / rate_hz
            left = 1.0 - p_detect * overlap[:, index]
            births, state = births_of(state, prior, left, now - time_s, event(camera, index, now), camera)
            total, time_s = total + p_detect * births, now
    return total


@pytest.mark.parametrize("rate_hz", [1.0, 10.0, 60.0])
@pytest.mark.parametrize("cameras", [1, 2, 5])
def test_every_object_is_first_detected_once(rate_hz: float, cameras: int) -> None:
    """Cameras that look at one place: what appears in 50 s, and what was there at the start."""
    found = first_detections(PRIOR, np.ones((cameras, cameras)), rate_hz, 50.0, 0.9)
    assert found == pytest.approx(0.5 * 50.0 + 3.0, rel=0.03)


def test_cameras_that_share_no_view_have_objects_of_their_own() -> None:
    found = first_detections(PRIOR, np.eye(3), 10.0, 50.0, 0.9)
    assert found == pytest.approx(3 * (0.5 * 50.0 + 3.0), rel=0.03)


@pytest.mark.parametrize(("n_detections", "expected"), [(13, (13 - 4) / 0.9), (2, LEAST_INITIAL)])
def test_the_first_frame_says_how_many_objects_there_were(n_detections: int, expected: float) -> None:
    camera = make_camera(p_detect=0.9, clutter=4.0)
    prior = replace(PRIOR, initial=None)
    first = event(camera, 0, 0.0, n_detections)
    left = 1.0 - 0.9 * np.array([1.0, 0.6])
    births, state = births_of(None, prior, left, 0.0, first, camera)
    assert births == pytest.approx(expected)
    np.testing.assert_allclose(state.initial_share, [0.0, 1.0 - 0.9 * 0.6])
    assert state.counts[0] == pytest.approx(0.1 * expected)


def test_a_pause_leaves_as_many_objects_as_the_frame_shows() -> None:
    camera = make_camera(p_detect=0.9, clutter=4.0)
    before = Undetected(np.array([0.05, 0.0]), np.zeros(2))
    left = 1.0 - 0.9 * np.ones(2)
    after = event(camera, 0, 3600.0, 9)
    births, state = births_of(before, PRIOR, left, 3600.0, after, camera, known=2.0)
    assert births == pytest.approx((9 - 4 - 2 + 3) / 0.9)
    assert state.counts[0] == pytest.approx(0.1 * births)
    # the next frame, and a frame that known objects and clutter explain, expect the usual number
    births, _ = births_of(state, PRIOR, left, 0.1, event(camera, 0, 3600.1, 9), camera, known=5.0)
    assert births == pytest.approx(state.counts[0] + 0.05)
    births, _ = births_of(before, PRIOR, left, 3600.0, event(camera, 0, 3600.0, 4), camera, known=3.0)
    assert births == pytest.approx(1.0)


def test_a_camera_that_starts_late_expects_what_its_first_frame_shows() -> None:
    camera = make_camera(p_detect=0.9, clutter=4.0)
    before, prior = Undetected(np.zeros(2), np.array([0.0, 1.0])), replace(PRIOR, initial=None)
    births, _ = births_of(before, prior, 1.0 - 0.9 * np.eye(2)[1], 3600.0, event(camera, 1, 3600.0, 9), camera)
    # the objects of the first frame, and one standard deviation of the number of its detections
    assert births == pytest.approx((9 - 4 + 3) / 0.9)


def test_of_cameras_at_one_time_the_first_expects_the_new_objects() -> None:
    camera = make_camera(p_detect=0.9, clutter=4.0)
    state: Undetected | None = None
    births = np.zeros(3)
    for frame in range(200):
        for index in range(3):
            elapsed = 0.1 if frame > 0 and index == 0 else 0.0
            left = 1.0 - 0.9 * np.ones(3)
            births[index], state = births_of(state, PRIOR, left, elapsed, event(camera, index, 0.1 * frame), camera)
    assert births[2] < 0.02 * births[0]
    assert births[0] == pytest.approx(0.5 * 0.1 / (1.0 - 0.1**3))


def test_overlap_of_views() -> None:
    """The same view, a view beside it, and one that looks the other way."""
    cameras = [
        make_camera(),
        make_camera(),
        make_camera((0.0, 0.0, 0.0), (50.0, 0.0, 0.0)),
        make_camera((0.0, np.pi, 0.0)),
    ]
    detects = [camera.detector.p_detect for camera in cameras]
    overlap = (1.0 - undetected_shares(make_rig(cameras, 1.0, "horizontal"), PRIOR)) / detects
    np.testing.assert_allclose(overlap[:2, :2], 1.0, rtol=1e-12)
    np.testing.assert_array_equal(overlap[3, :3], 0.0)
    # 50 to the side at depths of about 130 of a view 114 wide; quantiles of the disparity stand for the prior
    rng = np.random.default_rng(1)
    pixels = rng.uniform(-0.5, [799.5, 599.5], (20_000, 2))
    disparity = rng.normal(7.0, 2.0, len(pixels))
    pixels, disparity = pixels[disparity > 0.0], disparity[disparity > 0.0]
    world = cameras[0].unproject(pixels, cameras[0].fx / disparity)
    assert overlap[0, 2] == pytest.approx(cameras[2].in_view(world).mean(), abs=0.05)
