"""What `info` finds in logs, tables, cameras and folders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.cli.app import run
from stereophd.commands.info import info
from stereophd.errors import InputError
from stereophd.io.logs.rows import LogWriter
from stereophd.report.inspection import info_text

CAMERAS = """units: {length: cm}
cameras:
  left:
    image_size_px: [640, 480]
    intrinsics: {fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0}
    pose: {center: [-5.0, 0.0, 0.0], rotation_vector_deg: [0, -10, 0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.9, clutter_per_frame: 2.0}
  right:
    image_size_px: [640, 480]
    intrinsics: {fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0}
    pose: {center: [5.0, 0.0, 0.0], rotation_vector_deg: [0, 10, 0]}
    detector: estimate
"""


def write_log(path: Path) -> Path:
    """Two cameras: 10 Hz with a gap, and 5 Hz that begins later."""
    events = [(0.1 * k, "a", k, k % 3) for k in range(100) if not 40 <= k < 45]
    events += [(4.05 + 0.2 * k, "b", 2 * k, 2) for k in range(50)]
    with LogWriter(path) as writer:
        for time, camera, frame, count in sorted(events):
            writer.write(time, camera, frame, np.arange(2.0 * count).reshape(count, 2) + 1.5)
    return path


def test_times_since_1970_show_the_frame(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.parquet") as writer:
        for frame in range(3):
            writer.write(1732545000.021 + frame / 50.0, "a", frame, np.ones((1, 2)))
    text = info_text(info(tmp_path / "log.parquet"))
    assert "3 rows, 1732545000.021 to 1732545000.061 s" in text
    assert "e+09" not in text


@pytest.mark.parametrize("piece", [7, 16384])
def test_a_log(tmp_path: Path, piece: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereophd.io.tables.reading.ROW_GROUP_ROWS", piece)
    found = info(write_log(tmp_path / "log.parquet"))
    assert found["kind"] == "detections"
    assert (found["first_s"], found["last_s"]) == (0.0, pytest.approx(13.85))
    assert found["overlap_s"] == pytest.approx(9.9 - 4.05)
    a, b = found["cameras"]["a"], found["cameras"]["b"]
    frames = [k for k in range(100) if not 40 <= k < 45]
    assert (a["frames"], a["empty_frames"]) == (95, sum(k % 3 == 0 for k in frames))
    assert a["detections"] == sum(k % 3 for k in frames)
    assert (a["most_detections_in_a_frame"], a["gaps"], a["missing_frame_numbers"]) == (2, 1, 5)
    assert a["rate_hz"] == pytest.approx(10)
    assert a["longest_interval_s"] == pytest.approx(0.6)
    assert (b["frames"], b["detections"], b["missing_frame_numbers"]) == (50, 100, 49)
    assert b["rate_hz"] == pytest.approx(5)
    assert (a["lowest_px"], a["highest_px"]) == ([1.5, 2.5], [3.5, 4.5])
    assert found["times_backwards"] == 0
    text = info_text(found)
    assert "all cameras at once for 5.85 s" in text
    assert "a: 5 frame numbers between 0 and 99 are missing" in text


def test_a_log_in_blocks_of_cameras(tmp_path: Path) -> None:
    table = pq.read_table(write_log(tmp_path / "log.parquet"))
    pq.write_table(table.sort_by([("camera", "ascending"), ("time_s", "ascending")]), tmp_path / "blocks.parquet")
    found = info(tmp_path / "blocks.parquet")
    assert found["times_backwards"] == 1
    assert found["cameras"]["b"]["frames"] == 50


def test_cameras_and_their_layout(tmp_path: Path) -> None:
    path = tmp_path / "cameras.yaml"
    path.write_text(CAMERAS)
    found = info(path)
    assert found["kind"] == "cameras"
    # axes of 10 degrees from 5 to either side meet at 5 / tan 10 degrees
    np.testing.assert_allclose(found["axes_meet_near"], [0, 0, 5 / np.tan(np.deg2rad(10))], atol=1e-9)
    assert found["axes_distance_rms"] == pytest.approx(0, abs=1e-9)
    assert "the optical axes meet near (0, 0, 28.36), to within 0 cm" in info_text(found)
    assert found["axes_meet_behind"] == []
    assert found["distances"] == {"nearest": 10.0, "farthest": 10.0}
    assert found["cameras"]["right"]["detector_is_estimated"]
    path.write_text(
        CAMERAS.replace("[0, -10, 0]", "[0, 10, 0]").replace(
            "[0, 10, 0]}\n    detector: e", "[0, -10, 0]}\n    detector: e"
        )
    )
    assert "that point is behind left, right" in info_text(info(path))


def test_a_pose_that_is_unknown_is_no_pose(tmp_path: Path) -> None:
    path = tmp_path / "cameras.yaml"
    path.write_text(
        CAMERAS.replace("pose: {center: [5.0, 0.0, 0.0], rotation_vector_deg: [0, 10, 0]}", "pose: unknown")
    )
    found = info(path)
    assert (found["cameras"]["right"]["center"], found["cameras"]["right"]["looks_along"]) == (None, None)
    assert (found["distances"], found["axes_meet_near"]) == (None, None)
    _, _, left, right = info_text(found).splitlines()
    assert "(-5, 0, 0)" in left
    assert right.split()[-3:-1] == ["unknown", "-"]


def test_tracks_truth_and_a_folder(tmp_path: Path) -> None:
    rows = {"time_s": [0.0, 1.0, 1.0, 2.0], "x": [0.0, 1, 2, 3], "y": [0.0] * 4, "z": [1.0] * 4}
    pq.write_table(pa.table({**rows, "object_id": [1, 1, 2, 1]}), tmp_path / "truth.parquet")
    pq.write_table(pa.table({**rows, "track_id": [1, 1, 2, 1]}), tmp_path / "tracks.parquet")
    found = info(tmp_path / "tracks.parquet")
    assert (found["kind"], found["objects"], found["duration_s"]["longest"]) == ("tracks", 2, 2.0)
    pq.write_table(pa.table({"object_id": [1], "time_s": [0.0], "x": [0.0], "y": [0.0], "z": [0.0]}), tmp_path / "one")
    assert "1 object, 1 row" in info_text(info(tmp_path / "one")).splitlines()
    (tmp_path / "one").unlink()
    assert found["rows_by_object"][0] == {"id": 1, "first_s": 0.0, "last_s": 2.0, "rows": 3}
    (tmp_path / "notes.txt").write_text("hello")
    origin = {"command": "track", "version": "9", "seed": 3, "config_sha256": "ab" * 32, "inputs": {"log": "cd" * 32}}
    (tmp_path / "report.json").write_text(json.dumps({"events": 5, "provenance": origin}))
    folder = info(tmp_path)
    kinds = {Path(file["path"]).name: file["kind"] for file in folder["files"]}
    assert kinds == {
        "notes.txt": "other",
        "report.json": "report",
        "tracks.parquet": "tracks",
        "truth.parquet": "truth",
    }
    text = info_text(folder)
    assert "made by stereophd 9 track, seed 3, config abababababab" in text
    assert "  from log cdcdcdcdcdcd" in text
    assert "events: 5" in info_text(info(tmp_path / "report.json"))
    for fault in ({"config_sha256": None}, {"inputs": [1]}, {"inputs": {"log": 3}}):
        (tmp_path / "report.json").write_text(json.dumps({"events": 5, "provenance": {**origin, **fault}}))
        assert info_text(info(tmp_path / "report.json")).splitlines()[1] == "events: 5"


@pytest.mark.parametrize("pictures", [0, 1, 12])
def test_a_folder_names_its_data_before_pictures(tmp_path: Path, pictures: int) -> None:
    for k in range(pictures):
        (tmp_path / f"figure{k}.{'PNG' if k % 2 else 'svg'}").write_bytes(b"\x89PNG")
    (tmp_path / "a_note.txt").write_text("hello")
    (tmp_path / "runs").mkdir()
    (tmp_path / "cameras.yaml").write_text(CAMERAS)
    (tmp_path / "report.json").write_text('{"provenance": {}}')
    for name in ("scans.parquet", "tracks.parquet"):
        pq.write_table(pa.table({"a": [1]}), tmp_path / name)
    found = info(tmp_path)
    assert len(found["files"]) == pictures + 6
    first, _, *lines = info_text(found).splitlines()
    assert first.endswith(": folder")
    data = ["scans.parquet", "tracks.parquet", "report.json", "cameras.yaml", "runs", "a_note.txt"]
    assert [line.split()[0] for line in lines[:6]] == data
    counted = {0: [], 1: ["1 picture (svg)"], 12: ["12 pictures (png, svg)"]}
    assert lines[6:] == counted[pictures]


def test_other_things_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="there is no such file"):
        info(tmp_path / "none")
    (tmp_path / "text.yaml").write_text("hello: 3\n")
    with pytest.raises(InputError, match="cameras: expected this key"):
        info(tmp_path / "text.yaml")
    (tmp_path / "page.html").write_text("<!doctype html>\x1a")
    with pytest.raises(InputError, match=r"page\.html: expected a log, a table, cameras"):
        info(tmp_path / "page.html")
    (tmp_path / "foreign.json").write_text('{"provenance": "x", "a": 1}')
    (tmp_path / "deep.json").write_text("[\n" * 1500 + "]" * 1500)
    (tmp_path / "deep.yaml").write_text("a: " + "[" * 600 + "]" * 600)
    for name in ("foreign.json", "deep.json", "deep.yaml"):
        with pytest.raises(InputError, match=name):
            info(tmp_path / name)
    # of an experiment: a value of a whole run has no time
    runs = {"experiment": ["e"] * 2, "run": [0, 1], "time_s": [None, 1.0], "quantity": ["q"] * 2, "value": [1.0, 2.0]}
    pq.write_table(pa.table(runs), tmp_path / "runs.parquet")
    found = info(tmp_path / "runs.parquet")
    assert (found["kind"], found["rows"], found["first_s"], found["last_s"]) == ("runs", 2, 1.0, 1.0)
    pq.write_table(pa.table({"a": [1]}), tmp_path / "t.parquet")
    assert "  a  int64" in info_text(info(tmp_path / "t.parquet"))
    assert run(["info", str(tmp_path / "t.parquet"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["columns"] == {"a": "int64"}
