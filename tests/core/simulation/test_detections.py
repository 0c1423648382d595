"""What the cameras report: noise, misses, clutter, clocks, moving cameras."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.geometry.camera import Clock
from stereophd.core.geometry.lens import Lens
from stereophd.core.simulation.detections import CLUTTER_ID, truth_rows
from tests.core.simulation.scenes import camera, frames_of, moving_object, scene

TINY = 1e-9  # noise so small that a pixel is the projection


def test_objects_are_detected_with_the_stated_probability() -> None:
    # 2 objects, 20000 frames, pD 0.8: the rate within 5 standard errors, and no dependence between objects.
    objects = [moving_object(object_id=0), moving_object((1.0, 0.0, 10.0), object_id=1)]
    frames = frames_of(scene([camera(p_detect=0.8)], objects, duration_s=2000.0))
    seen = np.array([[k in frame.object_id for k in (0, 1)] for frame in frames])
    assert len(frames) == 20000
    assert (np.abs(seen.mean(axis=0) - 0.8) < 5 * np.sqrt(0.8 * 0.2 / 20000)).all()
    assert abs(np.corrcoef(seen.T)[0, 1]) < 5 / np.sqrt(20000)
    lag = np.corrcoef(seen[:-1, 0], seen[1:, 0])[0, 1]
    assert abs(lag) < 5 / np.sqrt(20000)


def test_noise_is_white_of_the_stated_deviation() -> None:
    made = scene([camera(sigma=1.5)], [moving_object((1.0, 0.5, 10.0))], duration_s=1000.0)
    pixels = np.concatenate([frame.pixels for frame in frames_of(made)])
    residual = pixels - made.cameras[0].project(np.array([[1.0, 0.5, 10.0]]))
    number = len(residual)
    assert number == 10000
    assert (np.abs(residual.mean(axis=0)) < 5 * 1.5 / np.sqrt(number)).all()
    assert (np.abs(residual.std(axis=0) / 1.5 - 1) < 5 / np.sqrt(2 * number)).all()
    assert abs(np.corrcoef(residual.T)[0, 1]) < 5 / np.sqrt(number)


def test_clutter_is_poisson_and_uniform_over_the_image() -> None:
    frames = frames_of(scene([camera(clutter=4.0)], [], duration_s=1000.0))
    counts = np.array([len(frame.pixels) for frame in frames])
    assert abs(counts.mean() - 4.0) < 5 * np.sqrt(4.0 / counts.size)
    assert abs(counts.var() - 4.0) < 5 * np.sqrt((4.0 + 2 * 16.0) / counts.size)
    assert all((frame.object_id == CLUTTER_ID).all() for frame in frames)
    assert any(count == 0 for count in counts)  # empty frames are frames
    pixels = np.concatenate([frame.pixels for frame in frames])
    for axis, size in ((0, 640), (1, 480)):
        assert pixels[:, axis].min() >= -0.5
        assert pixels[:, axis].max() <= size - 0.5
        share = np.histogram(pixels[:, axis], 8, (-0.5, size - 0.5))[0] / len(pixels)
        assert (np.abs(share - 1 / 8) < 5 * np.sqrt(1 / 8 * 7 / 8 / len(pixels))).all()


def test_nothing_is_detected_outside_the_image() -> None:
    # On the edge of the image: half of the noisy pixels fall outside and are no detections.
    edge = (320.0 / 500.0 * 10.0, 0.0, 10.0)  # u = 639.5
    objects = [
        moving_object((edge[0] - 1e-9, *edge[1:]), object_id=0),
        moving_object((8.0, 0.0, 10.0), object_id=1),  # beside the image
        moving_object((0.0, 0.0, -10.0), object_id=2),  # behind
    ]
    frames = frames_of(scene([camera(sigma=2.0)], objects, duration_s=400.0))
    labels = np.concatenate([frame.object_id for frame in frames])
    assert set(labels) == {0}
    assert abs(labels.size / len(frames) - 0.5) < 5 * np.sqrt(0.25 / len(frames))
    assert max(frame.pixels[:, 0].max() for frame in frames if len(frame.pixels)) <= 639.5


def test_detections_of_a_frame_come_in_no_order() -> None:
    objects = [moving_object((0.5 * k, 0.0, 10.0), object_id=k) for k in range(3)]
    frames = frames_of(scene([camera(clutter=1.0)], objects, duration_s=600.0))
    first = np.array([frame.object_id[0] for frame in frames if len(frame.object_id) == 4])
    share = np.array([(first == label).mean() for label in (-1, 0, 1, 2)])
    assert (np.abs(share - 0.25) < 5 * np.sqrt(0.25 * 0.75 / first.size)).all()


@pytest.mark.parametrize(
    "lens", [Lens("radial", k1=-0.1), Lens("brown_conrady", k1=0.05, p1=0.001), Lens("fisheye", k1=0.01)]
)
def test_pixels_are_those_of_the_distorting_lens(lens: Lens) -> None:
    made = scene([camera(sigma=TINY, lens=lens)], [moving_object((2.0, -1.0, 6.0))], duration_s=1.0)
    expected = made.cameras[0].project(np.array([[2.0, -1.0, 6.0]]))[0]
    undistorted = np.array([319.5 + 500.0 / 3, 239.5 - 85.0])
    assert np.abs(expected - undistorted).max() > 1.0
    for frame in frames_of(made):
        np.testing.assert_allclose(frame.pixels[0], expected, atol=1e-6)


def test_a_moving_camera_sees_from_where_it_is() -> None:
    eye = camera(sigma=TINY, velocity=(0.5, 0.0, 0.1), rotation_rate=(0.0, 0.02, 0.01))
    item = moving_object((1.0, 0.5, 10.0), (0.3, 0.0, 0.0))
    frames = frames_of(scene([eye], [item], duration_s=5.0))
    assert len(frames) == 50
    for frame in frames:
        point = item.position + frame.log_time_s * item.velocity
        expected = eye.at(frame.log_time_s).project(point[None])[0]
        np.testing.assert_allclose(frame.pixels[0], expected, atol=1e-6)
    assert np.abs(frames[-1].pixels - frames[0].pixels).max() > 10.0


def test_log_times_are_on_the_cameras_own_clock_and_in_order() -> None:
    clocks = [Clock(0.0, 1.0), Clock(-300.0, 1.0), Clock(0.35, 1.01)]
    cameras = [camera(f"c{k}", sigma=TINY, clock=clock) for k, clock in enumerate(clocks)]
    item = moving_object((0.0, 0.0, 10.0), (0.02, 0.0, 0.0))
    phases = [0.0, 0.02, 0.04]
    made = scene(cameras, [item], duration_s=60.0, rates_hz=[10.0, 20.0, 7.0], phases_s=phases)
    frames = frames_of(made)
    keys = [(frame.log_time_s, frame.camera) for frame in frames]
    assert keys == sorted(keys)
    for index, clock in enumerate(clocks):
        own = [frame for frame in frames if frame.camera == index]
        assert [frame.frame for frame in own] == list(range(len(own)))
        true = np.array([clock.offset_s + clock.rate * frame.log_time_s for frame in own])
        expected = phases[index] + np.arange(len(own)) / [10.0, 20.0, 7.0][index]
        np.testing.assert_allclose(true, expected, atol=1e-8)
        # The object is where it is at the TRUE time: this tells the time from the pixel.
        moved = np.array([(frame.pixels[0, 0] - 319.5) * 10.0 / 500.0 / 0.02 for frame in own])
        np.testing.assert_allclose(moved, expected, atol=1e-6)


def test_ties_are_in_camera_order() -> None:
    frames = frames_of(scene([camera("b"), camera("a")], [moving_object()]))
    assert [frame.camera for frame in frames] == [0, 1] * 100


@settings(max_examples=15)
@given(st.integers(0, 2**31), st.floats(0.0, 1.0))
def test_truth_is_where_the_detections_come_from(seed: int, noise: float) -> None:
    made = scene(
        [camera("a", (-0.5, 0.0, 0.0), sigma=TINY), camera("b", (0.5, 0.0, 0.0), sigma=TINY)],
        [
            moving_object(object_id=0, velocity=(0.1, 0.0, 0.0), noise_seed=seed),
            moving_object(object_id=4, birth_s=1.03, death_s=2.4, noise_seed=seed + 1),
        ],
        duration_s=4.0,
        phases_s=[0.0, 0.03],
        acceleration_std=0.3 * noise,
    )
    truth = {
        (time, label): state
        for times, labels, states in truth_rows(made)
        for time, label, state in zip(times, labels, states, strict=True)
    }
    found = 0
    for frame in frames_of(made, seed):
        for pixel, label in zip(frame.pixels, frame.object_id, strict=True):
            point = truth[frame.log_time_s, label][:3]
            expected = made.cameras[frame.camera].project(point[None])[0]
            np.testing.assert_allclose(pixel, expected, atol=1e-6)
            found += 1
    assert found == len(truth)
    assert {label for _, label in truth} == {0, 4}


def test_a_camera_has_its_own_random_numbers() -> None:
    # Another camera in the scene changes nothing in what the first one reports.
    one = scene([camera("a", clutter=2.0, p_detect=0.7)], [moving_object()])
    two = scene([camera("a", clutter=2.0, p_detect=0.7), camera("b")], [moving_object()])
    alone = frames_of(one)
    beside = [frame for frame in frames_of(two) if frame.camera == 0]
    for left, right in zip(alone, beside, strict=True):
        np.testing.assert_array_equal(left.pixels, right.pixels)
        np.testing.assert_array_equal(left.object_id, right.object_id)
