"""Figures of a run: which residuals they leave out, and what an error of a camera would do to its estimates."""

import numpy as np
import pytest

from stereophd.pipeline.tracking.run_figures import MOST_SHOWN, CameraSums, EstimateSample, are_usual
from tests.scenes import build_camera


def test_outliers_are_judged_by_what_is_expected_of_each() -> None:
    """Most residuals may be those of one-camera tracks, which are next to nothing: the others are no outliers."""
    rng = np.random.default_rng(0)
    scale = np.where(np.arange(2000) < 1100, 0.05, 1.0)
    scale[:20] = 0.0
    squares = ((scale[:, None] * rng.normal(size=(2000, 2))) ** 2).sum(axis=1)
    assert are_usual(squares, 2.0 * scale**2, 2.0).all()
    squares[1990:] += 50.0**2
    squares[20:30] += 50.0**2
    wrong = np.flatnonzero(~are_usual(squares, 2.0 * scale**2, 2.0))
    assert wrong.tolist() == [*range(20, 30), *range(1990, 2000)]


def test_a_noise_that_is_stated_too_small_makes_no_outliers() -> None:
    squares = (np.random.default_rng(1).normal(size=(2000, 2)) ** 2).sum(axis=1)
    assert are_usual(squares, np.full(2000, 2e-4), 2e-4).all()
    assert are_usual(squares, np.zeros(2000), 2.0).all()
    assert are_usual(np.empty(0), np.empty(0), 2.0).shape == (0,)


def test_the_share_that_is_left_out_is_reported() -> None:
    """Three in ten detections are 50 px off."""
    rng, camera, count = np.random.default_rng(2), build_camera("left", (0.0, 0.0, -5.0)), 1000
    states = np.hstack([rng.normal(0.0, 0.3, (count, 3)), np.zeros((count, 3))])
    errors = rng.normal(size=(count, 2)) * np.asarray(camera.detector.sigma)
    errors[:300] += 50.0 * rng.normal(size=(300, 2))
    sums = CameraSums(frames=count, detections=count)
    pixels = camera.project_at(states[:, :3], np.zeros(count)) + errors
    sums.waiting = [(0.0, state, 1e-8 * np.eye(3), pixel) for state, pixel in zip(states, pixels, strict=True)]
    report = sums.report(camera)
    left_out = round(report["outlier_share"] * count)
    assert 0.25 * count < left_out <= 0.3 * count
    assert report["residuals"] == count - left_out
    assert report["residual_ratio"] < 2.0
    assert CameraSums().report(camera)["outlier_share"] is None


def test_an_error_of_a_pixel_moves_tracks_in_depth() -> None:
    """Two cameras beside each other: by depth^2 / (focal length x baseline), whatever the covariance is scaled by."""
    cameras = [build_camera(name, (x, 0.0, 0.0)) for name, x in (("left", -0.5), ("right", 0.5))]
    place, step = np.array([[0.1, 0.2, 9.0]]), 1e-4
    slopes = [
        np.stack([(camera.project(place + d) - camera.project(place - d))[0] / (2.0 * step) for d in step * np.eye(3)])
        / np.asarray(camera.detector.sigma) for camera in cameras
    ]  # fmt: skip
    covariance = np.linalg.inv(sum(slope @ slope.T for slope in slopes))
    sample, moves = EstimateSample(), []
    for detections in (1.0, 9.0):
        sample = EstimateSample()
        whole = np.eye(6)
        whole[:3, :3] = covariance / detections
        sample.add(0.0, np.hstack([place, np.zeros((1, 3))]), whole[None])
        error = sample.camera_error(cameras)
        assert error["move_per_px"] == pytest.approx(81.0 / (cameras[0].fx * 1.0), rel=0.05)
        moves.append(error["stds_per_px"])
    assert moves[1] == pytest.approx(3.0 * moves[0], rel=0.01)
    assert EstimateSample().camera_error(cameras) == {"move_per_px": None, "stds_per_px": None}


def test_estimates_are_thinned_evenly_however_they_come() -> None:
    found = []
    for size in (1, 7):
        sample = EstimateSample()
        for start in range(0, 14 * MOST_SHOWN, size):
            numbers = np.arange(start, min(start + size, 14 * MOST_SHOWN), dtype=float)
            sample.add(0.0, numbers[:, None], numbers[:, None])
        found.append([int(row[1][0]) for row in sample.rows])
    assert found[0] == found[1] == list(range(0, 14 * MOST_SHOWN, 16))
