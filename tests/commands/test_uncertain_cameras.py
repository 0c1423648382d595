"""What calibrated cameras leave uncertain: in ``cameras.yaml``, in the covariances of tracks, and in their scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd import InputError, load_config, read_cameras
from stereophd.commands.evaluate import evaluate
from stereophd.commands.evaluate_cameras import Posterior, in_frame
from stereophd.commands.init import init
from stereophd.commands.track import track
from stereophd.config.loading import load_cameras
from stereophd.core.alignment.frames import moved_camera
from stereophd.core.calibration.unknowns.considered import CameraUncertainty, CommonPart
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import view_of
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.metrics.truth.registration import Registration
from stereophd.io.cameras.writing import write_cameras
from stereophd.pipeline.cameras_covariance import in_world, rows_of, stated_uncertainty

pytestmark = pytest.mark.usefixtures("without_checks")

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
STDS = {"center_x": 0.03, "rotation_y": 2e-3, "focal": 4e-3, "clock_offset": 5e-3}


@pytest.fixture(scope="module")
def cameras() -> tuple[Camera, ...]:
    return tuple(read_cameras(SAMPLE / "hall" / "cameras.yaml"))


@pytest.fixture(scope="module")
def uncertainty(cameras: tuple[Camera, ...]) -> CameraUncertainty:
    stds = np.array(list(STDS.values()))
    correlation = 0.8 * np.eye(len(stds)) + 0.2
    parameters = tuple(Parameter(name, "right", 0.0, std) for name, std in STDS.items())
    return CameraUncertainty(ParameterSet(cameras, parameters), correlation * np.outer(stds, stds))


def pixels_of(cameras: tuple[Camera, ...], state: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the pixels of a moving point in each camera, at times on the cameras' clocks."""
    out = []
    for camera, log_time in zip(cameras, times, strict=True):
        true = np.array([camera.clock.to_true(float(log_time))])
        place = state[:3] + state[3:] * true
        out.append(view_of(camera, place[None], state[None, 3:], true, true, np.zeros(1)).pixels[0])
    return np.concatenate(out)


def test_positions_move_as_their_rays_meet_elsewhere(uncertainty: CameraUncertainty) -> None:
    """The oracle: least squares on exact pixels, with cameras that are wrong by a step."""
    cameras, state, times = uncertainty.parameters.cameras, np.array([0.4, -0.6, 7.0, 0.8, 0.1, -0.3]), np.zeros(2)
    exact = pixels_of(cameras, state, times)

    def triangulated(values: np.ndarray) -> np.ndarray:
        wrong, place = uncertainty.parameters.build(values), state.copy()
        for _ in range(6):
            slopes = np.stack(
                [(pixels_of(wrong, place + step, times) - pixels_of(wrong, place - step, times)) / 2e-5
                 for step in 1e-5 * np.eye(6)[:3]], axis=1
            )  # fmt: skip
            place[:3] += np.linalg.lstsq(slopes, exact - pixels_of(wrong, place, times))[0]
        return place[:3]

    expected = [
        (triangulated(step) - triangulated(-step)) / (2.0 * np.abs(step).sum())
        for step in 1e-4 * np.eye(uncertainty.parameters.size)
    ]
    covariance = np.zeros((1, 6, 6))
    covariance[0] = 1e-2 * np.eye(6)
    views = [
        view_of(c, state[None, :3], state[None, 3:], times[:1], times[:1], np.zeros(1)).by_world[0] for c in cameras
    ]
    covariance[0, :3, :3] = 0.2 * np.linalg.inv(sum(view.T @ view for view in views))
    found = uncertainty.moves(np.zeros(1), state[None], covariance)[0]
    np.testing.assert_allclose(found, np.transpose(expected), rtol=0.05, atol=0.02 * np.abs(expected).max())


def test_moves_and_their_sums_do_not_depend_on_how_estimates_are_handed_over(uncertainty: CameraUncertainty) -> None:
    rng = np.random.default_rng(1)
    states, roots = rng.normal([0.4, -0.6, 7.0, 0.0, 0.0, 0.0], 0.5, (50, 6)), 0.1 * rng.normal(size=(50, 6, 6))
    covariances, times = roots @ np.swapaxes(roots, 1, 2), rng.uniform(0.0, 9.0, 50)
    whole = uncertainty.moves(times, states, covariances)
    sums, parts = CommonPart.of_none(4).including(states[:, :3], whole @ uncertainty.root), CommonPart.of_none(4)
    for rows in (slice(0, 1), slice(1, 4), slice(4, 50)):
        moves = uncertainty.moves(times[rows], states[rows], covariances[rows])
        np.testing.assert_array_equal(moves, whole[rows])
        parts = parts.including(states[rows, :3], moves @ uncertainty.root)
    assert parts.stds() == sums.stds()


def test_estimates_that_are_exact_in_a_direction_move_too(uncertainty: CameraUncertainty) -> None:
    """Moves depend on the shape of a covariance, not on its size, down to zero."""
    states, flat = np.tile([0.4, -0.6, 7.0, 0.8, 0.1, -0.3], (4, 1)), np.diag([1e-4, 0.0, 1e-4, 1.0, 1.0, 1.0])
    covariances = np.stack([flat, np.zeros((6, 6)), 1e-6 * np.eye(6), np.eye(6)])
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        moves = uncertainty.moves(np.zeros(4), states, covariances)
    assert np.isfinite(moves).all()
    assert (np.abs(moves[0, 1]) < 1e-6 * np.abs(moves[0, [0, 2]])).all()
    np.testing.assert_allclose(moves[1:3], moves[[3, 3]], rtol=1e-9)


def test_common_moves_are_those_of_a_similarity(uncertainty: CameraUncertainty) -> None:
    rng = np.random.default_rng(0)
    places = rng.normal(size=(200, 3))
    along = np.stack([np.cross([0.0, 1.0, 0.0], places), rng.normal(size=(200, 3))], axis=2)
    common, other = CommonPart.of_none(2).including(places, along * [0.2, 0.1]).stds()
    assert common == pytest.approx(np.sqrt(0.04 * (along[:, :, 0] ** 2).sum(axis=1).mean()), rel=0.03)
    assert other == pytest.approx(0.1 * np.sqrt(3.0), rel=0.1)


def test_rows_say_what_they_are_made_of(uncertainty: CameraUncertainty) -> None:
    again = stated_uncertainty(uncertainty.parameters.cameras, rows_of(uncertainty))
    assert again is not None
    assert again.parameters.names == uncertainty.parameters.names
    np.testing.assert_allclose(again.covariance, uncertainty.covariance)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"right.nothing": [1.0]}, "expected CAMERA.COMPONENT, such as left.center_x, found right.nothing"),
        ({"middle.focal": [1.0]}, "found middle.focal"),
        ({"right.focal": [0.0]}, "expected 1 numbers, the last above 0"),
        ({"right.focal": [1.0], "left.focal": [1.0]}, "expected 2 numbers"),
        ({"right.focal": [1.0], "left.focal": [2.0, 1.0]}, "without negative eigenvalues"),
    ],
)
def test_what_is_no_covariance_is_refused(tmp_path: Path, rows: dict, message: str) -> None:
    file = load_cameras(SAMPLE / "hall" / "cameras.yaml")
    write_cameras(tmp_path / "cameras.yaml", file.cameras, "m", covariance=rows)
    with pytest.raises(InputError, match=message):
        load_cameras(tmp_path / "cameras.yaml")


def test_a_world_turns_and_scales_the_uncertainty(uncertainty: CameraUncertainty) -> None:
    turn = rotation_from_vector([0.0, 0.0, np.pi / 2.0])
    world = Registration(turn, np.array([1.0, 2.0, 3.0]), 10.0, 0.0, 5.0, 1.0, 0)
    joint = np.zeros((uncertainty.parameters.size + 9,) * 2)
    joint[:-9, :-9] = uncertainty.covariance
    moved = in_world(uncertainty, world, np.zeros(3), joint)
    stds = dict(zip(moved.parameters.names, np.sqrt(np.diag(moved.covariance)), strict=True))
    assert stds == pytest.approx(
        {"right.center_y": 0.3, "right.rotation_y": 2e-3, "right.clock_offset": 5e-3, "right.focal": 4e-3}, rel=1e-4
    )
    joint[-6, -6] = 0.01  # a translation of the world moves both cameras alike
    both = in_world(uncertainty, world, np.zeros(3), joint)
    rows = [both.parameters.names.index(f"{name}.center_x") for name in ("left", "right")]
    np.testing.assert_allclose(both.covariance[np.ix_(rows, rows)], 0.01, rtol=1e-4)


def test_a_new_configuration_keeps_what_is_uncertain(uncertainty: CameraUncertainty, tmp_path: Path) -> None:
    file = load_cameras(SAMPLE / "hall" / "cameras.yaml")
    write_cameras(tmp_path / "cameras.yaml", file.cameras, "m", covariance=rows_of(uncertainty))
    init(tmp_path / "study", None, tmp_path / "cameras.yaml")
    kept = load_config(tmp_path / "study" / "config.yaml").config.cameras_covariance
    assert kept == load_cameras(tmp_path / "cameras.yaml").covariance


def test_tracks_and_scores_count_the_cameras(uncertainty: CameraUncertainty, tmp_path: Path) -> None:
    file = load_cameras(SAMPLE / "hall" / "cameras.yaml")
    write_cameras(tmp_path / "cameras.yaml", file.cameras, "m", covariance=rows_of(uncertainty))
    tables = {}
    for name, path in (("known", SAMPLE / "hall" / "cameras.yaml"), ("uncertain", tmp_path / "cameras.yaml")):
        loaded = load_config(SAMPLE / "hall.yaml", ["report.std_columns=true"], cameras_path=path)
        report = track(loaded, SAMPLE / "hall" / "detections.parquet", tmp_path / name)
        tables[name] = pq.read_table(tmp_path / name / "tracks.parquet")
    assert "covariance_cameras" not in tables["known"].column_names
    known, whole, part = (
        np.asarray(tables[name][column].combine_chunks().flatten()).reshape(-1, 6, 6)
        for name, column in (("known", "covariance"), ("uncertain", "covariance"), ("uncertain", "covariance_cameras"))
    )
    np.testing.assert_allclose(whole, known + part, atol=1e-12)
    assert (np.trace(part[:, :3, :3], axis1=1, axis2=2) > 0.0).all()
    assert not part[:, 3:].any()
    np.testing.assert_allclose(np.square(tables["uncertain"]["std_x"]), whole[:, 0, 0])
    assert report["cameras_part"]["common_std"] > report["cameras_part"]["other_std"] > 0.0
    confirmed = tables["uncertain"]["status"].to_numpy(zero_copy_only=False) == "confirmed"
    stds, ids = np.sqrt(np.trace(whole[:, :3, :3], axis1=1, axis2=2)), tables["uncertain"]["track_id"].to_numpy()
    for one in report["tracks"]:
        assert one["mean_position_std"] == pytest.approx(stds[confirmed & (ids == one["track_id"])].mean())
    scores = evaluate(tmp_path / "uncertain" / "tracks.parquet", SAMPLE / "hall" / "truth.parquet", cutoff=1.0)["nees"]
    alone = evaluate(tmp_path / "known" / "tracks.parquet", SAMPLE / "hall" / "truth.parquet", cutoff=1.0)["nees"]
    assert scores["without_cameras"] == pytest.approx(alone["position"])
    assert scores["position"] < alone["position"]
    assert "without_cameras" not in alone


@pytest.mark.parametrize("has_scale", [True, False])
def test_true_cameras_come_into_the_frame_of_a_posterior(uncertainty: CameraUncertainty, has_scale: bool) -> None:
    """Frame and clock of the reference camera, and a scale that is not known, are no errors."""
    values = np.array([0.02, 1e-3, -2e-3, 4e-3])
    posterior = Posterior(uncertainty.parameters, 0, values[None], np.zeros(1), has_scale)
    estimated = uncertainty.parameters.build(values)
    world = Registration(
        rotation_from_vector([0.4, 1.0, -0.2]), np.array([5.0, 6.0, 7.0]), 1.0 if has_scale else 3.0, 0.0, 9.0, 1.0, 0
    )
    true = [moved_camera(camera, world) for camera in reversed(estimated)]
    found = uncertainty.parameters.difference(in_frame(posterior, estimated, true))
    np.testing.assert_allclose(found, values, atol=1e-9)
