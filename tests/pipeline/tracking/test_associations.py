"""Which detection belongs to which track; tracks that are left out as too short; extra columns and files of `track`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.core.disparity.events import make_event
from stereophd.core.geometry.pose import Pose
from stereophd.core.multi.association.attribution import Claims, claims_of
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.pipeline.files import read_cameras
from stereophd.pipeline.tracking.associations import (
    LEAST_PROBABILITY,
    Associations,
)
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.residuals import residuals_px
from stereophd.pipeline.tracking.run_figures import LastingTracks
from stereophd.pipeline.tracking.smoothed import RunClaims
from tests.commands.test_track import SCENE
from tests.scenes import build_camera

pytestmark = pytest.mark.usefixtures("without_checks")

COLUMNS = {
    "time_s": pa.float64(), "camera": pa.string(), "frame": pa.int64(), "u_px": pa.float64(), "v_px": pa.float64(),
    "track_id": pa.int64(), "probability": pa.float64(),
}  # fmt: skip

PINHOLE = build_camera("left", size=(640, 480), focal=500.0)


PIXELS = np.array([[10.0, 20.0], [30.0, 40.0]])


def estimates(*pairs: tuple[int, int]) -> Estimates:
    """Estimates of these (track, label)."""
    tracks, labels = (np.array([pair[k] for pair in pairs], dtype=np.int64) for k in (0, 1))
    count = len(pairs)
    return Estimates(tracks, np.zeros((count, 6)), np.zeros((count, 6, 6)), np.ones(count), labels)


def claims(*rows: tuple[int, int, float]) -> Claims:
    """Claims of these (label, detection, probability)."""
    labels, detections, probabilities = (np.array([row[k] for row in rows]) for k in range(3))
    return Claims(labels.astype(np.int64), detections.astype(np.int64), probabilities)


def test_claims_are_the_components_after_those_missed() -> None:
    labels, weights = np.array([4, 7, 4, 7, 9, 10]), np.array([0.1, 0.2, 0.8, 0.7, 0.3, 0.4])
    found = claims_of(labels, weights, 2, np.array([1, 0]))
    assert found.labels.tolist() == [4, 7, 9, 10]
    assert found.detections.tolist() == [1, 0, 0, 1]
    assert found.probabilities.tolist() == [0.8, 0.7, 0.3, 0.4]


def test_claims_wait_until_their_label_is_reported() -> None:
    event = make_event(PINHOLE, 0, 1.0, PIXELS, frame=5)
    book = Associations()
    # alternatives of label 3 add up, what is negligible is left out, and undetected objects claim nothing
    rows = claims((3, 0, 0.25), (3, 0, 0.5), (8, 1, 0.1), (9, 1, 0.1 * LEAST_PROBABILITY), (-1, 1, 0.9))
    assert book.update(event, "left", rows) == ()
    (first,) = book.report(estimates((0, 3)))
    assert (first.time_s, first.camera, first.frame) == (1.0, "left", 5)
    assert first.rows.tolist() == [0]
    assert (first.pixels.tolist(), first.track_ids.tolist(), first.probabilities.tolist()) == ([[10, 20]], [0], [0.75])
    (second,) = book.update(make_event(PINHOLE, 0, 2.0, PIXELS, frame=6), "left", claims((3, 1, 0.9), (8, 0, 0.8)))
    assert (second.pixels.tolist(), second.track_ids.tolist()) == ([[30, 40]], [0])
    book.keep(np.array([3]))
    assert list(book.report(estimates((1, 8)))) == []
    assert not book.waiting


@pytest.mark.parametrize(
    ("sure", "further", "expected"),
    [
        pytest.param([], [(1, 0, 0.9)], [(1, 0, 0.9)], id="alone"),
        pytest.param([(0, 1, 0.9)], [(1, 0, 0.9)], [(1, 0, 0.9)], id="another detection"),
        pytest.param([(0, 0, 0.25)], [(1, 0, 0.5)], [(1, 0, 0.5)], id="both fit"),
        pytest.param([(0, 0, 0.75)], [(1, 0, 0.5)], [(1, 0, 0.25)], id="what is left"),
        pytest.param([(0, 0, 1.0)], [(1, 0, 0.9)], [], id="nothing is left"),
        pytest.param([(0, 0, 0.5), (2, 0, 0.75)], [(1, 0, 0.9)], [], id="more than all is taken"),
        pytest.param([(0, 0, 0.25)], [(1, 0, 0.9), (2, 0, 0.6)], [(1, 0, 0.45), (2, 0, 0.3)], id="shared"),
        pytest.param([(0, 0, 0.75)], [(1, 0, 0.5), (1, 1, 0.5)], [(1, 0, 0.25), (1, 1, 0.5)], id="two detections"),
        pytest.param([], [(1, 0, 0.0)], [], id="negligible"),
    ],
)
def test_rows_of_a_detection_add_up_to_one(
    sure: list[tuple[int, int, float]], further: list[tuple[int, int, float]], expected: list[tuple[int, int, float]]
) -> None:
    """Rows are (track, detection, probability); those that are sure stay."""

    def rows(of: list[tuple[int, int, float]]) -> RunClaims:
        table = np.array(of).reshape(-1, 3)
        return RunClaims(table[:, 1].astype(np.int64), table[:, 0].astype(np.int64), table[:, 2])

    found = rows(further).reduced(rows(sure))
    assert list(zip(found.track_ids, found.detections, strict=True)) == [row[:2] for row in expected]
    assert found.probabilities.tolist() == pytest.approx([row[2] for row in expected])


def test_short_tracks_are_left_out() -> None:
    info = Info(0.0, 1.0, 1)
    shown = {0.0: [(0, 0)], 1.0: [(0, 0), (1, 1)], 2.0: [(0, 0), (1, 1), (2, 2)], 3.0: [(0, 0), (2, 2)], 4.0: [(2, 2)]}
    records = [Record(t, "left", int(t), 1, 0, info, estimates(*pairs)) for t, pairs in shown.items()]
    kept = [(record.time_s, record.estimates.track_ids.tolist()) for record in LastingTracks(2.0).records(records)]
    assert kept == [(0.0, [0]), (1.0, [0]), (2.0, [0, 2]), (3.0, [0, 2]), (4.0, [2])]


def test_residuals_of_a_moving_camera_and_of_a_rolling_shutter() -> None:
    state = np.array([[0.1, 0.2, 5.0, 1.0, 0.0, 0.0]])
    rolling = replace(PINHOLE, readout_s=0.1)
    seen = rolling.project(state[:, :3])
    late = state[:, :3] + rolling.row_delays(seen[:, 1])[:, None] * state[:, 3:]
    pixels = rolling.project(late)
    assert residuals_px(rolling, np.zeros(1), state, pixels) == pytest.approx(np.zeros((1, 2)), abs=1e-9)
    pose = Pose(np.eye(3), np.zeros(3), velocity=[0.1, 0.0, 0.0])
    moving = replace(PINHOLE, pose=pose)
    pixels = moving.at(3.0).project(state[:, :3]) + [[2.0, -1.0]]
    assert residuals_px(moving, np.array([3.0]), state, pixels) == pytest.approx(np.array([[2.0, -1.0]]))


@pytest.mark.parametrize("overrides", [("filter.kind=phd",), ("filter.kind=pmb",), ("report.smooth={}",)])
def test_associations_agree_with_the_truth(tmp_path: Path, overrides: tuple[str, ...]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    simulate(load_config(path), tmp_path / "log")
    log = tmp_path / "log" / "detections.parquet"
    loaded = load_config(path, [*overrides, "report.std_columns=true", "report.associations=true"])
    report = track(loaded, log, tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "associations.parquet")
    assert dict(zip(table.schema.names, table.schema.types, strict=True)) == COLUMNS
    assert b"stereophd" in table.schema.metadata

    # the rows are detections of the log, and most of a track's are those of one object
    detections = pq.read_table(log).to_pydict()
    names = ("camera", "frame", "u_px", "v_px")
    objects = dict(zip(zip(*(detections[n] for n in names), strict=True), detections["object_id"], strict=True))
    rows = table.to_pydict()
    keys = list(zip(*(rows[name] for name in names), strict=True))
    assert len(set(zip(keys, rows["track_id"], strict=True))) == len(keys)
    probable = [
        (t, objects[key]) for key, t, p in zip(keys, rows["track_id"], rows["probability"], strict=True) if p > 0.5
    ]
    of_track = {t: [o for u, o in probable if u == t] for t in set(rows["track_id"])}
    right = sum(max(map(found.count, set(found))) for found in of_track.values() if found)
    assert right >= 0.95 * len(probable) > 100
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet").to_pydict()
    assert set(rows["track_id"]) <= set(tracks["track_id"])

    # no detection is claimed more than once in all
    shares = dict.fromkeys(keys, 0.0)
    for key, probability in zip(keys, rows["probability"], strict=True):
        shares[key] += probability
    assert max(shares.values()) < 1.0 + 1e-6
    covariance = np.array(tracks["covariance"]).reshape(-1, 6, 6)
    assert np.array(tracks["std_y"]) ** 2 == pytest.approx(covariance[:, 1, 1])
    for camera in report["cameras"].values():
        assert 0.3 < camera["residual_rms_px"] < 1.5
        assert 0.2 < camera["explained_share"] < 0.8


def test_estimated_detectors_are_written_as_cameras(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    simulate(load_config(path), tmp_path / "log")
    loaded = load_config(path, ["detector=estimate", "report.min_track_length=4.0", "filter.kind=pmb"])
    report = track(loaded, tmp_path / "log" / "detections.parquet", tmp_path / "out")
    cameras = read_cameras(tmp_path / "out" / "cameras.yaml")
    for camera in cameras:
        found = report["detectors"]["cameras"][camera.name]
        assert camera.detector.p_detect == pytest.approx(found["p_detect"], rel=1e-3)
    assert not (tmp_path / "out" / "associations.parquet").exists()
    for one in report["tracks"]:
        assert one["last_s"] - one["first_s"] >= 4.0
        assert one["mean_speed"] > 0.0 < one["mean_position_std"]


def _rows(folder: Path) -> set[tuple[object, ...]]:
    """The rows of the associations of a run."""
    table = pq.read_table(folder / "associations.parquet")
    return set(zip(*(table[name].to_pylist() for name in COLUMNS), strict=True))


def _least_std(folder: Path) -> dict[int, float]:
    """Confirmed track -> the least standard deviation of its position."""
    table = pq.read_table(folder / "tracks.parquet")
    table = table.filter(pc.equal(table["status"], "confirmed"))
    covariances = np.array(table["covariance"].to_pylist()).reshape(-1, 6, 6)
    stds = np.sqrt(np.trace(covariances[:, :3, :3], axis1=1, axis2=2))
    ids = table["track_id"].to_numpy()
    return {int(one): float(stds[ids == one].min()) for one in np.unique(ids)}


@pytest.mark.parametrize(
    "more",
    [
        pytest.param((), id="filter"),
        pytest.param(("report.smooth={}",), id="smoothed"),
        pytest.param(("report.smooth={reassociate: true}",), id="chosen anew"),
        pytest.param(("report.smooth={}", "report.times=camera left"), id="smoothed, of one camera"),
        pytest.param(("report.smooth={}", "report.times=grid 1.0"), id="smoothed, on a grid"),
        pytest.param(("report.times=grid 1.0",), id="on a grid"),
    ],
)
def test_a_bound_on_the_uncertainty_takes_whole_tracks_from_the_associations(
    tmp_path: Path, more: tuple[str, ...]
) -> None:
    """A track of tracks.parquet keeps all of its rows, also those from before it was certain, and no other has any."""
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    settings = ["filter.kind=pmb", "report.associations=true", *more]
    simulate(load_config(path), tmp_path / "log")
    log = tmp_path / "log" / "detections.parquet"

    def run(name: str, *changes: str) -> Path:
        track(load_config(path, [*settings, *changes]), log, tmp_path / name)
        return tmp_path / name

    whole = run("whole")
    assert {row[5] for row in _rows(whole)} == set(_least_std(whole))
    stds = sorted(_least_std(whole).values())
    assert len(stds) >= 3
    # between the most certain tracks of this run: smoothed, no filtered track need be as certain as that
    limit = 0.5 * (stds[0] + stds[1])
    bounded = run("bounded", f"report.max_position_std={limit}")
    shown = set(_least_std(bounded))
    assert 0 < len(shown) < len(stds)
    assert _rows(bounded) == {row for row in _rows(whole) if row[5] in shown}
