"""Rolling shutters of cameras that move: detections in the axes of the frame, and how they depend on the disparity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.association import detected_pixels
from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.disparity.rolling import turned_to_frame
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.geometry.trajectory import BodyTrajectory, MountedPath
from stereophd.core.multi.filter_settings.common import BirthPrior
from tests.core.disparity.cases import LENSES, birth_moments, make_camera, make_space

TIME_S = 3.0
# The camera turns by some 3 degrees and travels a tenth of a typical depth while it reads an image.
VELOCITY, RATE, READOUT_S = np.array([2.0, -1.0, 1.5]), np.array([0.2, -0.3, 0.4]), 0.1


def moving_camera(lens: str = "none", mounted: bool = False, rates: bool = True) -> Camera:
    """A camera of a rolling shutter, moving steadily or on a body that sways and turns."""
    pose = Pose(rotation_from_vector([0.2, -0.1, 0.3]), [1.0, 2.0, -0.5], VELOCITY, RATE if rates else np.zeros(3), 2.0)
    if mounted:
        rng = np.random.default_rng(8)
        quaternions = np.column_stack([np.ones(300), 0.02 * rng.standard_normal((300, 3)).cumsum(axis=0)])
        quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
        centers = 0.05 * rng.standard_normal((300, 3)).cumsum(axis=0)
        poses = np.column_stack([0.02 * np.arange(300), centers, quaternions])
        path = MountedPath(BodyTrajectory(poses), rotation_from_vector([0.1, 0.2, -0.1]), [0.3, -0.2, 0.1])
        pose = Pose.following(path)
    return replace(make_camera(lens=LENSES[lens]), pose=pose, readout_s=READOUT_S)


def rows_read(camera: Camera, positions: np.ndarray, velocities: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of objects that are at positions at the time of a frame, and the delays of their rows, solved."""
    delays = np.full(len(positions), 0.5 * READOUT_S)
    for _ in range(60):
        moved = positions + delays[:, None] * velocities
        pixels = np.stack(
            [camera.at(TIME_S + t).project(x[None])[0] for t, x in zip(delays.tolist(), moved, strict=True)]
        )
        delays = READOUT_S * pixels[:, 1] / camera.height
    assert camera.contains(pixels).all()
    return pixels, delays


def ahead(camera: Camera, count: int = 12) -> np.ndarray:
    """Positions before the middle of the image of a camera at the time of the frame."""
    rng = np.random.default_rng(1)
    return camera.at(TIME_S).pose.to_world(rng.uniform([-1.0, -0.5, 4.0], [1.0, 0.5, 9.0], (count, 3)))


@pytest.mark.parametrize("mounted", [False, True])
@pytest.mark.parametrize("lens", ["none", "brown_conrady", "fisheye"])
def test_points_at_rest_are_observed_exactly(lens: str, mounted: bool) -> None:
    camera = moving_camera(lens, mounted)
    positions = ahead(camera)
    pixels, delays = rows_read(camera, positions, np.zeros((len(positions), 3)))
    event = make_event(camera.at(TIME_S), 0, TIME_S, pixels)
    order = np.array([int(np.abs(pixels - one).sum(axis=1).argmin()) for one in event.pixels])
    space = make_space(camera.at(TIME_S))
    states = space.from_world(positions[order])
    readings = event.readings(space.packed())
    np.testing.assert_allclose(readings[:, 0], delays[order], rtol=1e-12)
    np.testing.assert_allclose(states[:, :2] + readings[:, 1:] * states[:, 2:], event.points, atol=1e-7)
    # neither the turn nor the way is small
    undistorted = camera.undistort_pixels(event.pixels)[0]
    assert np.abs(undistorted - event.points).max() > 3.0
    assert np.abs(states[:, :2] - event.points).max() > 3.0


def test_moving_objects_are_observed_to_second_order() -> None:
    """The error is within tau |v_z| / z of the displacement in the image, the part that the observation neglects."""
    camera = moving_camera()
    rng = np.random.default_rng(2)
    positions = ahead(camera)
    velocities = rng.normal(0.0, 1.0, positions.shape)
    pixels, delays = rows_read(camera, positions, velocities)
    event = make_event(camera.at(TIME_S), 0, TIME_S, pixels)
    order = np.array([int(np.abs(pixels - one).sum(axis=1).argmin()) for one in event.pixels])
    space = make_space(camera.at(TIME_S))
    states = space.from_world(np.column_stack([positions, velocities])[order])
    readings = event.readings(space.packed())
    observed = states[:, :2] + readings[:, 1:] * states[:, 2:3] + readings[:, :1] * states[:, 3:5]
    displaced = np.linalg.norm(event.points - states[:, :2], axis=1)
    # d' / d = -v_z / z
    share = delays[order] * np.abs(states[:, 5] / states[:, 2])
    errors = np.linalg.norm(event.points - observed, axis=1)
    assert (errors <= 1.0001 * share * displaced + 1e-7).all()
    assert displaced.max() > 20.0


def test_noise_and_area_are_turned_with_the_pixels() -> None:
    camera = moving_camera()
    points = np.random.default_rng(3).uniform([50.0, 50.0], [750.0, 550.0], (6, 2))
    times, delays = np.full(6, TIME_S), np.linspace(0.0, 1.0, 6)
    noise = np.array([[2.0, 0.3], [0.3, 1.0]])
    found, covariances, areas = turned_to_frame(
        camera, times, delays, points, np.tile(noise, (6, 1, 1)), np.full(6, 1.5)
    )
    for k in range(6):
        columns = []
        for step in np.eye(2) * 1e-3:
            pair = points[k] + np.array([step, -step])
            turned, _, _ = turned_to_frame(
                camera, times[:2], np.full(2, delays[k]), pair, np.tile(noise, (2, 1, 1)), np.ones(2)
            )
            columns.append((turned[0] - turned[1]) / 2e-3)
        jacobian = np.column_stack(columns)
        np.testing.assert_allclose(covariances[k], jacobian @ noise @ jacobian.T, rtol=1e-5)
        assert areas[k] == pytest.approx(1.5 * abs(np.linalg.det(jacobian)), rel=1e-5)
    np.testing.assert_allclose(found[0], points[0], atol=1e-9)
    assert np.abs(found[-1] - points[-1]).max() > 50.0


def test_a_camera_that_does_not_turn_keeps_its_pixels_to_the_last_bit() -> None:
    camera = moving_camera(rates=False)
    pixels = np.random.default_rng(4).uniform([50.0, 50.0], [750.0, 550.0], (6, 2))
    event = make_event(camera.at(TIME_S), 0, TIME_S, pixels)
    np.testing.assert_array_equal(event.points, pixels[np.argsort(pixels[:, 0])])
    np.testing.assert_allclose(event.travels, event.delays[:, None] * VELOCITY, rtol=1e-9)


def test_births_are_taken_back_to_the_place_of_the_frame() -> None:
    """Seen again at its own reading a newborn is where it was detected, with the noise of the detection."""
    camera = moving_camera()
    prior = BirthPrior(disparity=DisparityPrior(mean_px=150.0, std_px=30.0), velocity_std=1.5)
    event = make_event(camera.at(TIME_S), 0, TIME_S, np.array([[10.0, 15.0], [400.0, 300.0], [790.0, 540.0]]))
    space = make_space(camera.at(TIME_S)).packed()
    for size in (3, 6):
        means, covariances = birth_moments(event, space, prior, size)
        for k, reading in enumerate(event.readings(space)):
            h = np.zeros((2, 6))
            h[:, :2], h[:, 2], h[:, 3:5] = np.eye(2), reading[1:], reading[0] * np.eye(2)
            h = h[:, :size]
            np.testing.assert_allclose(h @ means[k], event.points[k], rtol=1e-9)
            np.testing.assert_allclose(h @ covariances[k] @ h.T, event.covariances[k], atol=1e-6)
            assert np.linalg.eigvalsh(covariances[k]).min() > 0.0


@pytest.mark.parametrize("mounted", [False, True])
def test_the_events_of_a_recording_are_those_of_its_frames(mounted: bool) -> None:
    camera = moving_camera("radial", mounted)
    rng = np.random.default_rng(5)
    frames = [(0, 0.1 * k, rng.uniform([50.0, 50.0], [750.0, 550.0], (k % 4, 2)), None) for k in range(20)]
    scans = Scans.of(Recording.of([camera], frames), [camera])
    for event, (_, time_s, pixels, _) in zip(scans.events, frames, strict=True):
        alone = make_event(camera, 0, time_s, pixels)
        np.testing.assert_allclose(event.points, alone.points, atol=1e-9)
        np.testing.assert_allclose(event.covariances, alone.covariances, atol=1e-9)
        np.testing.assert_allclose(event.areas, alone.areas, rtol=1e-12)
        np.testing.assert_allclose(event.travels, alone.travels, atol=1e-12)


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_predicted_pixels_of_a_calibration_are_those_of_the_detections(speed: float) -> None:
    camera = moving_camera("brown_conrady")
    positions = ahead(camera)
    velocities = np.random.default_rng(6).normal(0.0, speed, positions.shape)
    pixels, _ = rows_read(camera, positions, velocities)
    event = make_event(camera.at(TIME_S), 0, TIME_S, pixels)
    order = np.array([int(np.abs(event.pixels - one).sum(axis=1).argmin()) for one in pixels])
    assert event.delays is not None
    assert event.travels is not None
    states, times = np.column_stack([positions, velocities]), np.full(len(order), TIME_S)
    found = detected_pixels(camera, states, times, event.delays[order], event.travels[order])
    np.testing.assert_allclose(found, event.points[order], atol=1e-6)
