"""Bodies end to end: simulate, track, import; what they cannot be combined with."""

from __future__ import annotations

import io
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import yaml

from stereophd.commands.evaluate import evaluate
from stereophd.commands.init import init
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config, make_config
from stereophd.core.geometry.camera import BOX_NOISE
from stereophd.core.multi.state.estimates import Estimates
from stereophd.errors import InputError
from stereophd.io.streams.rows import ArrowRows, document_of
from stereophd.pipeline.checks.finding import is_mistake
from stereophd.pipeline.initial.bodies import measure_bodies, refine_bodies
from stereophd.pipeline.initial.draft import _strangers
from stereophd.pipeline.stream import open_stream
from stereophd.pipeline.tracking.tracking_run import build_tracking

CONFIG = "configs/crowd.yaml"
SMALL = ["simulate.duration_s=6", "simulate.walkers.count=4"]
POINTS = ["object={shape: point}", "simulate=null", "filter.birth.depth_range=[1, 20]"]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crowd")
    simulate(load_config(CONFIG, SMALL), folder, force=True)
    return folder / "detections.parquet"


def lasting(report: dict[str, Any]) -> int:
    """Return the number of tracks that last for half of the run."""
    return sum(one["last_s"] - one["first_s"] > 3.0 for one in report["tracks"])


def test_a_log_has_boxes_and_tracks_have_extents(log: Path, tmp_path: Path) -> None:
    boxes = pq.read_table(log)
    assert {"width_px", "height_px", "object_id"} <= set(boxes.column_names)
    report = track(load_config(CONFIG, [*SMALL, "report.associations=true"]), log, tmp_path / "out")
    assert lasting(report) == 4
    assert [found["message"] for found in report["checks"] if found["status"] == "warning"] == []
    # the noise of points says nothing about the middles of boxes
    assert {camera["residual_ratio"] for camera in report["cameras"].values()} == {None}
    assert "detector.sigma" not in {found["name"] for found in report["checks"]}
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
    for name, mean, spread in (("height", 1.7, 0.4), ("width", 0.5, 0.3)):
        assert np.abs(tracks[name].to_numpy() - mean).max() < spread
        assert (tracks[f"{name}_std"].to_numpy() > 0.0).all()
    assert len(pq.read_table(tmp_path / "out" / "associations.parquet")) > 0.5 * len(boxes)
    again = track(load_config(CONFIG, [*SMALL, "report.associations=true"]), log, tmp_path / "again")
    assert again["log_likelihood"] == report["log_likelihood"]
    assert (tmp_path / "again/tracks.parquet").read_bytes() == (tmp_path / "out/tracks.parquet").read_bytes()


@pytest.mark.parametrize("source", ["log", "simulated"])
@pytest.mark.usefixtures("without_checks")
def test_tracks_do_not_depend_on_the_order_in_which_cameras_are_listed(log: Path, tmp_path: Path, source: str) -> None:
    values = yaml.safe_load(Path(CONFIG).read_text())
    names, tables = list(values["cameras"]), []
    for order in (names, [names[k] for k in (2, 0, 3, 1)]):
        values["cameras"] = {name: values["cameras"][name] for name in order}
        loaded, folder = make_config(values, "crowd", SMALL), tmp_path / order[0]
        if source == "simulated":
            simulate(loaded, folder, force=True)
        track(loaded, log if source == "log" else folder / "detections.parquet", folder / "run")
        tables.append(pq.read_table(folder / "run" / "tracks.parquet"))
    assert len(set(tables[0]["track_id"].to_pylist())) >= 4
    assert tables[1].to_pydict() == tables[0].to_pydict()


@pytest.mark.usefixtures("without_checks")
def test_pieces_and_a_grid_of_times(log: Path, tmp_path: Path) -> None:
    grid = load_config(CONFIG, [*SMALL, "report.times={grid: 0.5}"])
    report = track(grid, log, tmp_path / "out", pieces_s=3.0, overlap_s=2.0)
    assert lasting(report) == 4
    assert report["pieces"]["count"] == 2


@pytest.mark.usefixtures("without_checks")
def test_smoothed_bodies_go_on_after_a_gap(log: Path, tmp_path: Path) -> None:
    table = pq.read_table(log)
    times, objects = table["time_s"].to_numpy(), table["object_id"].to_numpy()
    gone = (objects == 2) & (times > 2.5) & (times < 4.0)
    pq.write_table(table.filter(~gone), tmp_path / "gap.parquet")
    smooth = [*SMALL, "report.smooth={max_gap_s: 2}"]
    report = track(load_config(CONFIG, smooth), tmp_path / "gap.parquet", tmp_path / "out")
    assert lasting(report) == 4
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
    for one in report["tracks"]:
        own = tracks.filter(pc.equal(tracks["track_id"], one["track_id"]))
        assert np.abs(own["height"].to_numpy() - 1.7).max() < 0.4
    inside = (tracks["time_s"].to_numpy() > 3.2) & (tracks["time_s"].to_numpy() < 3.8)
    assert len(set(tracks["track_id"].to_numpy()[inside])) == 3


@pytest.mark.usefixtures("without_checks")
def test_points_do_not_read_boxes(log: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.parquet"
    pq.write_table(pq.read_table(log).drop_columns(["width_px", "height_px"]), bare)
    loaded = load_config(CONFIG, POINTS)
    track(loaded, log, tmp_path / "with")
    track(loaded, bare, tmp_path / "without")
    with_boxes, without = (pq.read_table(tmp_path / name / "tracks.parquet") for name in ("with", "without"))
    assert with_boxes.equals(without)
    assert "height" not in with_boxes.column_names
    with pytest.raises(InputError, match="expected the columns width_px and height_px"):
        track(load_config(CONFIG), bare, tmp_path / "bodies")
    assert not (tmp_path / "bodies" / "tracks.parquet").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["filter.kind=phd"], "filter.kind: expected pmb .*, found phd"),
        (["motion={model: static}"], "motion.model: expected one whose objects move .*, found static"),
        (["report.smooth={reassociate: true}"], "report.smooth.reassociate: expected false"),
        (["cameras.northeast.readout_s=0.01"], "cameras.northeast.readout_s: expected 0"),
        (["object={shape: point}"], "filter.birth: expected exactly one of disparity and depth_range, found none"),
        (["object.up=null"], "object: expected width and up, or neither of them"),
        (["object.up=[0, 0, 0]"], "object: up: expected a direction"),
        (["object.width=null", "object.up=null"], "object: expected up where objects stand on the ground"),
    ],
)
def test_what_bodies_do_not_go_with_is_refused(log: Path, tmp_path: Path, changes: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        track(load_config(CONFIG, changes), log, tmp_path / "out")


def test_size_and_ground_are_those_of_the_boxes(log: Path) -> None:
    loaded = load_config(CONFIG)
    cameras = loaded.build_cameras()
    events = list(open_stream(loaded.config, cameras, log))
    bodies = measure_bodies(cameras, [events])
    assert bodies is not None
    assert bodies.up is not None
    assert bodies.ground is not None
    # of four people of 1.7 +- 0.1 m, from boxes seen from above
    np.testing.assert_allclose(bodies.height[0], 1.7, atol=0.15)
    np.testing.assert_allclose(bodies.width[0], 0.5, atol=0.1)
    np.testing.assert_array_equal(bodies.up, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(bodies.ground[2], 0.0, atol=0.1)
    refined = refine_bodies(bodies, loaded, cameras, [events])
    np.testing.assert_allclose(refined.height[0], 1.7, atol=0.1)
    assert refined.ground is not None
    np.testing.assert_allclose(refined.ground[2], 0.0, atol=0.05)
    # without boxes, and where boxes have no partner, nothing is known
    assert measure_bodies(cameras, [[replace(event, sizes=None) for event in events]]) is None
    assert measure_bodies(cameras, [[event for event in events if event.camera == 0]]) is None


def test_detectors_of_boxes_are_estimated(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereophd.pipeline.detectors.passes.MOST_RUNS", 3)
    run = build_tracking(load_config(CONFIG, ["detector=estimate"]))
    found = run.with_estimated_detectors(open_stream(run.loaded.config, run.cameras, log))
    assert found.detectors is not None
    assert {camera.detector.box_noise for camera in found.cameras} == {found.cameras[0].detector.box_noise}
    np.testing.assert_allclose(found.cameras[0].detector.box_noise, BOX_NOISE, rtol=0.3)
    for entry in found.detectors["cameras"].values():
        assert 0.9 < entry["p_detect"] < 1.0
        assert 0.2 < entry["clutter_per_frame"] < 1.2


@pytest.mark.parametrize(("rate", "named"), [(1.0, set()), (1.2, {"southeast"})])
def test_a_camera_whose_boxes_do_not_agree_is_named(log: Path, tmp_path: Path, rate: float, named: set[str]) -> None:
    """Rays of boxes miss by too much to tell a wrong clock, which was written as noise without a word."""
    table = pq.read_table(log).drop_columns("object_id").to_pandas()
    table = table[table["time_s"] < 2.5]
    table.loc[table["camera"] == "southeast", "time_s"] *= rate
    table.sort_values("time_s", kind="stable").to_parquet(tmp_path / "detections.parquet", index=False)
    described = yaml.safe_load((log.parent / "cameras.yaml").read_text())
    for camera in described["cameras"].values():
        del camera["detector"], camera["frame_rate_hz"]
    (tmp_path / "cameras.yaml").write_text(yaml.safe_dump(described))
    report = init(tmp_path / "out", tmp_path / "detections.parquet")
    assert {one["camera"] for one in report["checks"] if one["cause"] == "boxes_disagree"} == named
    assert (report["must_be_calibrated"], report["must_be_corrected"]) == (False, bool(named))
    assert all(one["source"] for one in report["detectors"].values())
    for detector in report["detectors"].values():
        np.testing.assert_allclose(detector["box_noise"] or BOX_NOISE, BOX_NOISE, rtol=0.3)


@pytest.mark.parametrize(
    ("wrong", "of", "named"),
    [("abcd", "abcd", "abcd"), ("b", "abcd", "b"), ("bd", "abcd", "bd"), ("b", "ab", "ab"), ("", "abc", "")],
)
def test_cameras_beside_a_wrong_one_are_not_called_wrong(
    monkeypatch: pytest.MonkeyPatch, wrong: str, of: str, named: str
) -> None:
    """By a likelihood that right cameras raise together, and a wrong one lowers with each beside it.

    Each is computed once. Where no cameras agree, poses may be guesses, which `calibrate` corrects.
    """
    asked = []

    def likelihood(_loaded: object, _parts: object, group: tuple[int, ...]) -> float:
        asked.append(group)
        pairs = combinations([of[k] for k in group], 2)
        return float(sum(50.0 if not {*pair} & {*wrong} else -100.0 for pair in pairs))

    monkeypatch.setattr("stereophd.pipeline.initial.draft._log_likelihood", likelihood)
    loaded = SimpleNamespace(cameras=dict.fromkeys(of))
    found = tuple(_strangers(loaded, [[]]))  # type: ignore[arg-type]
    assert [one.camera for one in found] == [*named]
    assert {*map(is_mistake, found)} <= {named != of}
    assert len(asked) == len({*asked})


@pytest.mark.parametrize(
    ("gains", "named"),
    [((50.0, 50.0, 50.0, 50.0), 0), ((50.0, 50.0, -100.0, -100.0), 2), ((150.0, -100.0, -100.0, -100.0), 2)],
)
def test_cameras_that_agree_at_both_ends_are_compared_there_alone(
    monkeypatch: pytest.MonkeyPatch, gains: tuple[float, ...], named: int
) -> None:
    """A wrong rate shows at one of them, however well the cameras agree at the other."""
    asked = set()

    def likelihood(_loaded: object, parts: list[int], group: tuple[int, ...]) -> float:
        asked.update(parts)
        return sum(gains[part] for part in parts) if len(group) == 2 else 0.0

    monkeypatch.setattr("stereophd.pipeline.initial.draft._log_likelihood", likelihood)
    found = tuple(_strangers(SimpleNamespace(cameras=dict.fromkeys("ab")), [0, 1, 2, 3]))  # type: ignore[arg-type]
    assert len(found) == named
    assert asked == ({0, 1, 2, 3} if named else {0, 3})


@pytest.mark.usefixtures("without_checks")
def test_bad_boxes_are_bad_rows(log: Path, tmp_path: Path) -> None:
    table = pq.read_table(log)
    widths = table["width_px"].to_numpy().copy()
    widths[5] = -3.0
    bad = tmp_path / "bad.parquet"
    place = table.column_names.index("width_px")
    pq.write_table(table.set_column(place, "width_px", [widths]), bad)
    with pytest.raises(InputError, match=r"row 5: width_px, height_px: expected positive numbers, found -3.0"):
        track(load_config(CONFIG), bad, tmp_path / "out")
    report = track(load_config(CONFIG, ["input.on_bad_row=drop"]), bad, tmp_path / "dropped")
    assert report["input"]["invalid_box"] == 1
    widths[5] = np.nan
    pq.write_table(table.set_column(place, "width_px", [widths]), bad)
    with pytest.raises(InputError, match="row 5: width_px"):
        track(load_config(CONFIG), bad, tmp_path / "out")


@pytest.mark.usefixtures("without_checks")
def test_spheres_have_one_extent(tmp_path: Path) -> None:
    spheres = [
        "object={shape: ellipsoid, height: {mean: 0.3, std: 0.03}}", "simulate.walkers=null", "simulate.duration_s=6",
        "simulate.objects={count: 3, box: {x: [2, 8], y: [2, 6], z: [0.5, 1.5]}, velocity_std: 0.2}",
    ]  # fmt: skip
    simulate(load_config(CONFIG, spheres), tmp_path / "scene")
    report = track(load_config(CONFIG, spheres), tmp_path / "scene" / "detections.parquet", tmp_path / "out")
    assert lasting(report) == 3
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
    assert tracks["height"].to_numpy() == pytest.approx(tracks["width"].to_numpy(), rel=0.01)
    assert tracks["height"].to_numpy() == pytest.approx(0.3, abs=0.15)


def test_walkers_need_a_ground(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"simulate\.walkers: expected object.ground"):
        simulate(load_config(CONFIG, ["object.ground=null"]), tmp_path / "scene")
    with pytest.raises(InputError, match=r"simulate\.walkers: expected object.shape ellipsoid"):
        simulate(load_config(CONFIG, ["object={shape: point}", "filter.birth.depth_range=[1, 20]"]), tmp_path / "scene")


@pytest.mark.usefixtures("without_checks")
def test_tracks_are_scored_on_the_ground_and_in_a_region(log: Path, tmp_path: Path) -> None:
    track(load_config(CONFIG, SMALL), log, tmp_path / "out")
    tracks, truth = tmp_path / "out" / "tracks.parquet", log.parent / "truth.parquet"
    whole = evaluate(tracks, truth, cutoff=1.0, switch_cost=1.0)
    assert whole["clear_mot"]["mota"] > 0.95
    assert whole["clear_mot"]["mostly_tracked"] == 4
    assert 0.0 < whole["tgospa"]["mean"] < 1.0
    flat = evaluate(tracks, truth, cutoff=1.0, plane=(0.0, 0.0, 1.0))
    assert flat["rmse"]["position"] < whole["rmse"]["position"]
    assert flat["nees"]["position"] is None
    assert "tgospa" not in flat
    part = evaluate(tracks, truth, cutoff=1.0, region={"x": (0.0, 5.0)})
    assert 0 < part["pairs"]["matched"] < whole["pairs"]["matched"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"plane": (0.0, 0.0, 0.0)}, "`plane`: expected a normal"),
        ({"region": {"w": (0.0, 1.0)}}, "`region`: expected x, y or z"),
        ({"region": {"x": (1.0, 0.0)}}, "`region`: expected x, y or z"),
        ({"switch_cost": 0.0}, "`switch_cost`: expected a number above 0, found 0"),
        ({"plane": (0.0, 0.0, 1.0), "base": "mahalanobis"}, "`plane`: expected `base` euclidean"),
    ],
)
def test_places_that_cannot_be_are_refused(words: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        evaluate("tracks.parquet", "truth.parquet", cutoff=1.0, **words)


def test_bodies_have_their_extents_in_live_documents() -> None:
    one = np.ones((1, 4))
    estimates = Estimates(np.array([3]), np.ones((1, 6)), np.eye(6)[None], np.ones(1), np.array([3]), extents=1.7 * one)
    track_of_body = document_of(0.5, "a", 2, estimates, False).tracks[0]
    assert [getattr(track_of_body, name) for name in ("height", "width", "height_std", "width_std")] == [1.7] * 4
    records = io.BytesIO()
    rows = ArrowRows(records)
    for shown in (estimates, replace(estimates, extents=None)):
        rows.add(document_of(0.5, "a", 2, shown, False))
    assert pa.ipc.open_stream(records.getvalue()).read_all()["height"].to_pylist() == [1.7, None]
