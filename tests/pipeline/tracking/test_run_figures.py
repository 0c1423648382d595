"""Figures of a run: which residuals they leave out, and what an error of a camera would do to its estimates."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import make_config
from stereophd.core.multi.state.estimates import Estimates
from stereophd.pipeline.checks.run_checks import MOST_LASTING
from stereophd.pipeline.tracking.residuals import SeenTrack, are_usual
from stereophd.pipeline.tracking.run_figures import CameraSums, RunFigures
from tests.scenes import build_camera

ROOT = Path(__file__).parents[3]


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
    sums.waiting = [
        SeenTrack("left", 0, 0.0, *row, pixel)
        for *row, pixel in zip(states, [1e-8 * np.eye(3)] * count, pixels, strict=True)
    ]
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
    moves = []
    for detections in (1.0, 9.0):
        whole = np.eye(6)[None] * np.array([1.0, np.nan])[:, None, None]  # of the second nothing is known
        whole[0, :3, :3] = covariance / detections
        states = np.hstack([place, np.zeros((1, 3))])
        estimates = Estimates(np.arange(2), np.vstack([states, states]), whole, np.ones(2), np.arange(2))
        figures = RunFigures()
        figures.add_estimates(estimates, 0.0)
        error = figures.report({camera.name: camera for camera in cameras}, 1, 2)["camera_error"]
        assert error["move_per_px"] == pytest.approx(81.0 / (cameras[0].fx * 1.0), rel=0.05)
        moves.append(error["stds_per_px"])
    assert moves[1] == pytest.approx(3.0 * moves[0], rel=0.01)
    assert RunFigures().report({}, 0, 0)["camera_error"] == {"move_per_px": None, "stds_per_px": None}


@pytest.mark.parametrize(("is_gone", "share", "again"), [(True, 0.5, 0.0), (False, 0.25, 2.0 / 3.0)])
def test_misses_of_a_track_that_no_camera_detects_any_more_are_not_asked(
    is_gone: bool, share: float, again: float
) -> None:
    """Of short-lived objects, which end in view, the last misses were called detections that are hidden for long."""
    camera, sums, track, place = build_camera("left", (0.0, 0.0, -5.0)), CameraSums(), np.array([7]), np.zeros((1, 3))
    for event in range(82):
        claim = np.array([1.0 - event % 2 if event < 40 else 0.0])
        sums.placed.append((0.1 * event, track, place, claim, np.array([min(event, 40) if is_gone else event])))
        if event % 9 == 0:
            sums._look(camera)
    report = sums.report(camera)
    assert report["detected_share"] == pytest.approx(share, abs=0.02)
    assert report["missed_again"] == pytest.approx(again, abs=0.07)


def test_misses_do_not_depend_on_how_many_events_are_asked_together() -> None:
    """Of 300 objects, seven events were: misses of those that were hidden for 20 did not count (0.39 for 0.81)."""
    rng, camera, reports = np.random.default_rng(3), build_camera("left", (0.0, 0.0, -5.0)), []
    tracks, events = np.arange(5), np.arange(200)[:, None]
    claims = ((rng.random((200, 5)) < 0.9) & ((events + 7 * tracks) % 60 >= 20)).astype(float)
    before = np.cumsum(claims, axis=0).astype(int) - claims.astype(int)
    for together in (200, 7, 1):
        sums = CameraSums()
        for event in range(200):
            sums.placed.append((0.1 * event, tracks, np.zeros((5, 3)), claims[event], before[event]))
            if event % together == 0:
                sums._look(camera)
        reports.append(sums.report(camera))
    assert reports[0]["missed_again"] == pytest.approx(0.8, abs=0.05)
    for report in reports[1:]:
        assert report["in_view"] == reports[0]["in_view"]
        assert report["missed_again"] == pytest.approx(reports[0]["missed_again"])


@pytest.mark.usefixtures("without_checks")  # what is warned of is found after the run
@pytest.mark.parametrize("kind", ["pmb", "phd"])
@pytest.mark.parametrize(("true", "stated"), [(0.5, 0.95), (0.95, 0.6)])
def test_how_often_tracks_are_detected_does_not_follow_what_is_stated(
    kind: str, true: float, stated: float, tmp_path: Path
) -> None:
    """Tracks that end at their second miss in a row are counted until then, and so are those that never end."""
    values = yaml.safe_load((ROOT / "configs" / "quickstart.yaml").read_text())
    values["filter"]["kind"], values["simulate"]["duration_s"] = kind, 5.0
    for camera in values["cameras"].values():
        camera["detector"]["p_detect"] = true
    simulate(make_config(values), tmp_path / "log")
    for camera in values["cameras"].values():
        camera["detector"]["p_detect"] = stated
    report = track(make_config(values), tmp_path / "log" / "detections.parquet", tmp_path / "tracks")
    for name, figures in report["cameras"].items():
        assert figures["in_view"] > 100
        assert figures["detected_share"] == pytest.approx(true, abs=0.1)
        missed = 1.0 - figures["detected_share"]
        assert missed * (figures["missed_again"] - missed) < MOST_LASTING  # each miss is one of its own
        warned = {one["camera"] for one in report["checks"] if one["cause"] == "p_detect"}
        assert (name in warned) == (figures["in_view"] >= 200)
