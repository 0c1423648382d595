"""`evaluate` on hand-made tables: which scans are scored, and the figures that come out."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from stereophd.commands.evaluate import evaluate
from stereophd.errors import GateError, InputError
from stereophd.io.tables.schemas import TRACKS

CAMERA = """\
    image_size_px: [800, 600]
    intrinsics: {fx: 900.0, fy: 900.0, cx: 400.0, cy: 300.0}
    pose: {center: [0.0, 0.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 10.0}
"""

# The unit for which a cutoff is known.
CENTIMETRES = {"length_unit": "cm"}


def write(path: Path, columns: dict, metadata: dict | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns).replace_schema_metadata(metadata), path)
    return path


def write_tracks(path: Path, rows: list[tuple], *, std: float = 1.0, metadata: dict | None = CENTIMETRES) -> Path:
    """Rows: (time, camera, frame, track, x); all points lie on the x axis and move at 1/s."""
    time, camera, frame, track, x = map(list, zip(*rows, strict=True)) if rows else ([],) * 5
    zeros, count = np.zeros(len(rows)), len(rows)
    # Position and velocity differ, and so do the axes, so that the right part has to be read.
    variance = np.array([std, 2 * std, 3 * std, 7, 8, 9]) ** 2
    covariance = np.tile(np.diag(variance), (count, 1, 1)).reshape(-1)
    columns = {
        "time_s": pa.array(time, pa.float64()),
        "camera": pa.array(camera, pa.string()),
        "frame": pa.array(frame, pa.int64()),
        "track_id": pa.array(track, pa.int64()),
        "x": pa.array(x, pa.float64()),
        **dict.fromkeys(("y", "z"), zeros),
        "vx": zeros + 1.0,
        **dict.fromkeys(("vy", "vz"), zeros),
        "covariance": pa.FixedSizeListArray.from_arrays(pa.array(covariance), type=TRACKS.field("covariance").type),
        "existence": zeros + 1.0,
    }
    return write(path, columns, metadata)


def write_scans(path: Path, events: list[tuple]) -> Path:
    time, camera, frame = map(list, zip(*events, strict=True))
    return write(path, {"time_s": [float(t) for t in time], "camera": camera, "frame": frame})


def write_truth(path: Path, rows: list[tuple], *, velocity: bool = False, metadata: dict | None = None) -> Path:
    """Rows: (time, object, x)."""
    time, label, x = (np.array(column) for column in zip(*rows, strict=True))
    zeros = np.zeros(len(rows))
    columns = {"time_s": time.astype(float), "object_id": label, "x": x.astype(float), "y": zeros, "z": zeros}
    if velocity:
        columns |= {"vx": zeros + 1.0, "vy": zeros, "vz": zeros}
    return write(path, columns, metadata)


def per_scan(folder: Path) -> dict:
    return pq.read_table(folder / "per_scan.parquet").to_pydict()


@pytest.fixture
def run(tmp_path):
    """One object that moves along x at 1/s for 10 s, seen by two cameras each second."""
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, t) for t in range(10)])
    rows = [(float(t), camera, t, 8, t + 0.5) for t in range(10) for camera in ("a", "b")]
    return write_tracks(tmp_path / "run" / "tracks.parquet", rows), truth, tmp_path


def test_figures_of_a_constant_offset(run):
    tracks, truth, folder = run
    report = evaluate(tracks, truth, folder / "out", plots=False)
    assert report["ospa"] == {
        "mean": pytest.approx(0.5),
        "localisation": pytest.approx(0.5),
        "cardinality": 0.0,
        "order": 2.0,
        "cutoff": 20.0,
        "base": "euclidean",
    }
    assert report["gospa"]["mean"] == pytest.approx(0.5)
    assert report["rmse"] == {"position": pytest.approx(0.5), "velocity": pytest.approx(0.0, abs=1e-12)}
    assert report["position_error"] == {"median": pytest.approx(0.5), "p90": pytest.approx(0.5), "n": 10}
    assert report["cardinality"]["bias"] == report["cardinality"]["mae"] == 0.0
    assert report["identity_switches"] == 0
    assert report["nees"]["position"] == pytest.approx(0.25)
    assert report["scans"]["scored"] == 10
    assert report["report_version"] == 1
    assert json.loads((folder / "out" / "report.json").read_text()) == report
    columns = per_scan(folder / "out")
    assert columns["time_s"] == list(range(10))
    assert columns["ospa"] == pytest.approx([0.5] * 10)
    assert sorted(os.listdir(folder / "out")) == ["per_scan.parquet", "report.json"]


def test_each_time_is_scored_after_its_last_event(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(2)])
    rows = [(0.0, "a", 0, 1, 4.0), (0.0, "b", 0, 1, 1.0), (1.0, "a", 1, 1, 3.0), (1.0, "b", 1, 1, 2.0)]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows)
    assert evaluate(tracks, truth)["ospa"]["mean"] == pytest.approx(1.5)
    events = evaluate(tracks, truth, at="events")
    assert events["scans"]["scored"] == 4
    assert events["ospa"]["mean"] == pytest.approx(2.5)


def test_events_that_reported_nothing_are_known_from_the_scans(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(4)])
    # After the event of b at time 1 nothing is reported any more: time 1 is a miss, though a reported.
    tracks = write_tracks(tmp_path / "tracks.parquet", [(0.0, "b", 0, 1, 0.0), (1.0, "a", 1, 1, 0.0)])
    write_scans(tmp_path / "scans.parquet", [(0, "a", 0), (0, "b", 0), (1, "a", 1), (1, "b", 1), (2.5, "a", 2)])
    report = evaluate(tracks, truth, tmp_path / "out", plots=False)
    columns = per_scan(tmp_path / "out")
    assert columns["n_estimates"] == [1, 0, 0]
    assert columns["rmse_position"] == columns["nees_position"] == [0.0, None, None]
    assert report["ospa"]["mean"] == pytest.approx(40 / 3)
    assert report["pairs"] == {"matched": 1, "missed": 2, "false": 0}
    assert evaluate(tracks, truth, at="events")["scans"]["scored"] == 5


def test_without_scans_the_times_of_the_truth_stand_in(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(4)])
    tracks = write_tracks(tmp_path / "tracks.parquet", [(1.0, "a", 1, 1, 0.0), (3.0, "a", 3, 1, 0.0)])
    assert evaluate(tracks, truth)["cardinality"]["bias"] == pytest.approx(-0.5)
    between = write_tracks(tmp_path / "tracks.parquet", [(1.5, "a", 1, 1, 0.0)])
    assert evaluate(between, truth)["scans"]["scored"] == 1


def test_tracks_without_rows(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(4)])
    report = evaluate(write_tracks(tmp_path / "tracks.parquet", []), truth)
    assert report["ospa"]["mean"] == 20.0
    assert report["rmse"] == {"position": None, "velocity": None}
    assert report["nees"]["position"] is None
    assert report["identity_switches"] == 0


def test_truth_on_another_grid_gaps_and_ends(tmp_path):
    times = [0, 1, 2, 6, 7]
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 2 * t) for t in times])
    scored = [0.5, 1.75, 6.5]
    rows = [(t, "a", i, 1, 2 * t) for i, t in enumerate([0.5, 1.75, 3.0, 5.0, 6.5, 7.5])]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows)
    report = evaluate(tracks, truth, tmp_path / "out", plots=False)
    columns = per_scan(tmp_path / "out")
    assert columns["time_s"] == scored
    assert columns["rmse_position"] == pytest.approx([0.0] * 3, abs=1e-12)
    assert columns["rmse_velocity"] == pytest.approx([1.0] * 3)
    assert report["scans"] == {
        "scored": 3,
        "not_scored": 3,
        "outside_truth": 1,
        "truth_gap": 2,
        "unseen": 0,
    }
    assert report["ospa"]["mean"] == pytest.approx(0.0, abs=1e-12)
    assert report["rmse"]["velocity"] == pytest.approx(1.0)  # the truth moves at 2/s
    assert evaluate(tracks, truth, max_gap_s=4.0)["scans"]["scored"] == 5


def test_window(run):
    tracks, truth, _ = run
    assert evaluate(tracks, truth, from_s=5)["scans"]["scored"] == 5
    assert evaluate(tracks, truth, from_s=5, to_s=6.5)["scans"] == {
        "scored": 2,
        "not_scored": 0,
        "outside_truth": 0,
        "truth_gap": 0,
        "unseen": 0,
    }
    with pytest.raises(InputError, match="nothing to score"):
        evaluate(tracks, truth, from_s=20)


def test_mahalanobis_base(run):
    _, truth, folder = run
    rows = [(float(t), "a", t, 8, t + 0.5) for t in range(10)]
    sharp = write_tracks(folder / "sharp" / "tracks.parquet", rows, std=0.1)
    report = evaluate(sharp, truth, base="mahalanobis")
    assert report["ospa"]["mean"] == pytest.approx(5.0)
    assert report["nees"]["position"] == pytest.approx(25.0)
    flat = write_tracks(folder / "flat" / "tracks.parquet", rows, std=0.0)
    with pytest.raises(InputError, match="row 0: column covariance"):
        evaluate(flat, truth, base="mahalanobis")
    assert evaluate(flat, truth)["nees"]["n"] == 0


def test_identity_switches(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, k, 100 * k) for t in range(4) for k in (0, 1)])
    tracks = [[5, 6], [5, 6], [6, 5], [6, 7]]
    rows = [(float(t), "a", t, tracks[t][k], 100.0 * k) for t in range(4) for k in (0, 1)]
    report = evaluate(write_tracks(tmp_path / "tracks.parquet", rows), truth, tmp_path / "out", plots=False)
    assert report["identity_switches"] == 3
    assert per_scan(tmp_path / "out")["identity_switches"] == [0, 0, 2, 1]
    assert report["tracks"] == 3
    # Track 5 follows object 0 twice, then object 1; 6 object 1 twice, then object 0 twice; 7 object 1.
    assert report["purity"]["mean"] == pytest.approx((2 / 3 + 1 / 2 + 1) / 3)
    assert report["purity"]["table"][0] == {
        "track_id": 5,
        "object_id": 0,
        "estimates": 3,
        "matched": 3,
        "matched_dominant": 2,
        "purity": pytest.approx(2 / 3),
    }
    assert report["completeness"]["table"][1] == {
        "object_id": 1,
        "track_id": 6,
        "scans": 4,
        "matched": 4,
        "matched_dominant": 2,
        "completeness": 1.0,
        "completeness_dominant": 0.5,
        "fragmentation": 3,
        "identity_switches": 2,
    }
    means = {key: value for key, value in report["completeness"].items() if key != "table"}
    assert means == {"mean": 1.0, "mean_dominant": 0.5, "fragmentation": 2.5}
    # Scan 2: each track is right at 2 of 3 scans, base c/3.
    assert per_scan(tmp_path / "out")["ospa2"][:3] == pytest.approx([0.0, 0.0, 20 / 3])


def test_matches_of_tracks_that_follow_other_objects_are_named(tmp_path, caplog):
    """Two objects 10 apart; the first scan has one track, 3 beside the wrong object."""
    truth = write_truth(tmp_path / "truth.parquet", [(t, k, 10 * k) for t in range(20) for k in (0, 1)])
    rows = [(0.0, "a", 0, 8, 3.0), *((float(t), "a", t, 7 + k, 10.0 * k) for t in range(1, 20) for k in (0, 1))]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows)
    wide = evaluate(tracks, truth)
    assert wide["match_distance"] == 20.0
    assert wide["rmse"]["position"] > 9.0
    assert "in 38 of 39 matches the track follows another object" in caplog.text
    caplog.clear()
    narrow = evaluate(tracks, truth, match_distance=5.0)
    assert narrow["match_distance"] == 5.0
    assert narrow["rmse"]["position"] == pytest.approx(3.0 / 39**0.5)
    assert narrow["identity_switches"] == 1
    assert narrow["idf1"] == pytest.approx(2 * 38 / (39 + 40))
    assert narrow["ospa"] == wide["ospa"]
    assert narrow["hota"] == wide["hota"]
    assert not caplog.text


def with_status(path: Path, status: list[str]) -> Path:
    pq.write_table(pq.read_table(path).append_column("status", pa.array(status)), path)
    return path


def test_tentative_estimates_count_only_when_asked_for(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, k, 100 * k) for t in range(6) for k in (0, 1)])
    # Track 5 is confirmed after 2 s; object 1 is followed at once; track 9 is a false one.
    rows = [(float(t), "a", t, track, x) for t in range(6) for track, x in ((5, 1.0), (6, 100.0))]
    rows.insert(1, (0.0, "a", 0, 9, 50.0))
    tentative = {(0.0, 5), (1.0, 5), (0.0, 9)}
    status = ["tentative" if (row[0], row[3]) in tentative else "confirmed" for row in rows]
    tracks = with_status(write_tracks(tmp_path / "tracks.parquet", rows), status)
    report = evaluate(tracks, truth)
    assert report["pairs"] == {"matched": 10, "missed": 2, "false": 0}
    assert report["tracks"] == 2
    assert report["tentative"] is False
    waits = {"mean_s": 1.0, "median_s": 1.0, "max_s": 2.0, "first_report_mean_s": 0.0, "objects": 2, "never": 0}
    assert report["confirmation"] == waits
    both = evaluate(tracks, truth, tentative=True)
    assert both["pairs"] == {"matched": 12, "missed": 0, "false": 1}
    assert both["tracks"] == 3
    assert both["tentative"] is True
    assert both["confirmation"] == waits
    # After 3 s both are confirmed from the first scored scan on.
    assert evaluate(tracks, truth, from_s=3)["confirmation"]["max_s"] == 0.0


def test_confirmation_of_objects_that_no_track_follows(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, k, 100 * k) for t in range(4) for k in (0, 1)])
    rows = [(float(t), "a", t, -1, 0.0) for t in range(1, 4)]
    report = evaluate(write_tracks(tmp_path / "tracks.parquet", rows), truth)
    assert report["confirmation"]["mean_s"] == report["confirmation"]["first_report_mean_s"] == 1.0
    assert (report["confirmation"]["objects"], report["confirmation"]["never"]) == (1, 1)
    nothing = evaluate(write_tracks(tmp_path / "none" / "tracks.parquet", []), truth)["confirmation"]
    assert (nothing["mean_s"], nothing["objects"], nothing["never"]) == (None, 0, 2)


def test_an_unknown_status_is_an_error(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(0, 0, 0), (1, 0, 0)])
    tracks = write_tracks(tmp_path / "tracks.parquet", [(0.0, "a", 0, 1, 0.0), (1.0, "a", 1, 1, 0.0)])
    with_status(tracks, ["confirmed", "sure"])
    with pytest.raises(InputError, match="row 1: column status: expected confirmed or tentative, found sure"):
        evaluate(tracks, truth)


def test_without_identities_there_are_no_figures_of_tracks(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 4, 0) for t in range(4)])
    tracks = write_tracks(tmp_path / "tracks.parquet", [(float(t), "a", t, -1, 0.0) for t in range(3)])
    write_scans(tmp_path / "scans.parquet", [(t, "a", t) for t in range(4)])
    report = evaluate(tracks, truth, tmp_path / "out", plots=False)
    assert report["identity_switches"] is report["ospa2"]["mean"] is None
    assert per_scan(tmp_path / "out")["ospa2"] == [None] * 4
    assert report["purity"] == {"mean": None, "table": []}
    assert report["completeness"] == {
        "mean": 0.75,
        "mean_dominant": None,
        "fragmentation": None,
        "table": [
            {
                "object_id": 4,
                "track_id": None,
                "scans": 4,
                "matched": 3,
                "matched_dominant": None,
                "completeness": 0.75,
                "completeness_dominant": None,
                "fragmentation": None,
                "identity_switches": None,
            }
        ],
    }


def test_ospa2_over_windows_of_scored_scans(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(6)])
    rows = [(float(t), "a", t, 1 if t < 3 else 2, 0.0) for t in range(6)]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows)
    options = {"cutoff": 6.0, "order": 1.0, "plots": False}
    report = evaluate(tracks, truth, tmp_path / "out", ospa2_window=2, **options)
    # Only the window of times 2 and 3 holds both tracks: (c / 2 + c) / 2.
    assert per_scan(tmp_path / "out")["ospa2"] == pytest.approx([0, 0, 0, 4.5, 0, 0])
    assert report["ospa"]["mean"] == 0.0
    assert report["ospa2"] == {
        "mean": pytest.approx(4.5 / 6),
        "localisation": pytest.approx(1.5 / 6),
        "cardinality": pytest.approx(3 / 6),
        "window_scans": 2,
    }
    assert report["provenance"]["config"]["ospa2_window"] == 2
    assert evaluate(tracks, truth, ospa2_window=1, **options)["ospa2"]["mean"] == 0.0
    assert evaluate(tracks, truth, **options)["ospa2"]["window_scans"] == 10
    with pytest.raises(GateError, match=r"ospa2\.mean is 0\.75"):
        evaluate(
            tracks, truth, ospa2_window=2, fail_above={"ospa2.mean": 0.7, "completeness.fragmentation": 2}, **options
        )


def documented_keys(section: str) -> set[str]:
    """Return what the first column of the tables of a section of docs/reference/formats.md names, without braces."""
    text = (Path(__file__).parents[2] / "docs" / "reference" / "formats.md").read_text(encoding="utf-8")
    body = text.split(f"### {section}\n")[1].split("\n#")[0]
    keys: set[str] = set()
    for cell in re.findall(r"^\| (`.*?`) \|", body, re.MULTILINE):
        for name in re.findall(r"`([^`]+)`", cell):
            head, brace, tail = name.partition("{")
            keys |= {head + one for one in tail.rstrip("}").split(",")} if brace else {head}
    return keys


def keys_of(report: dict) -> set[str]:
    keys: set[str] = set()
    for key, value in report.items():
        if isinstance(value, dict) and key != "provenance":
            for inner, part in value.items():
                rows = part if inner == "table" else []
                keys |= {f"{key}.table.{name}" for row in rows for name in row} or {f"{key}.{inner}"}
        else:
            keys.add(key)
    return keys


def test_all_keys_and_columns_are_documented(run):
    tracks, truth, folder = run
    log = write(folder / "log.parquet", log_columns([(t, "a", 3) for t in range(10)], False))
    report = evaluate(
        tracks, truth, folder / "out", plots=False, log_path=log, seen_by=1, within_s=0.5, switch_cost=1.0
    )
    assert documented_keys("`report.json` of `evaluate`") == keys_of(report)
    assert documented_keys("`per_scan.parquet`") == set(per_scan(folder / "out"))


def log_columns(rows: list[tuple], object_id: bool) -> dict:
    time, camera, label = map(list, zip(*rows, strict=True))
    columns = {"time_s": [float(t) for t in time], "camera": camera, "frame": list(range(len(rows)))}
    pixels = [None if one is None else 1.0 for one in label]
    columns |= {"u_px": pa.array(pixels, pa.float64()), "v_px": pa.array(pixels, pa.float64())}
    return columns | ({"object_id": pa.array(label, pa.int64())} if object_id else {})


@pytest.mark.parametrize(("object_id", "scored"), [(True, [0, 3]), (False, [0, 1, 3])])
def test_only_objects_seen_by_enough_cameras(tmp_path, object_id, scored):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(5)])
    rows = [(float(t), "a", t, 1, t + 1.0) for t in range(5)]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows)
    # Time 0 and 3: both cameras. 1: b has clutter only. 2: b an empty frame. 4: b too long ago.
    seen = [(-0.2, "a", 3), (0, "b", 3), (1, "a", 3), (1, "b", -1), (2, "a", 3), (2, "b", None)]
    seen += [(2.8, "b", 3), (3, "a", 3), (3.7, "b", 3), (4, "a", 3)]
    log = write(tmp_path / "log.parquet", log_columns(seen, object_id))
    options = {"log_path": log, "seen_by": 2, "within_s": 0.2, "plots": False}
    report = evaluate(tracks, truth, tmp_path / "out", **options)
    assert per_scan(tmp_path / "out")["time_s"] == scored
    assert report["scans"]["unseen"] == 5 - len(scored)
    assert report["ospa"]["mean"] == pytest.approx(np.mean(scored) + 1)
    assert report["seen_by"] == {"cameras": 2, "within_s": 0.2}


def test_clocks_of_the_cameras_apply_to_the_log(tmp_path):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(5)])
    tracks = write_tracks(tmp_path / "tracks.parquet", [(float(t), "a", t, 1, 1.0) for t in range(5)])
    log = write(tmp_path / "log.parquet", log_columns([(102.0, "a", 3), (2.0, "b", 3)], False))
    cameras = tmp_path / "cameras.yaml"
    clock = "    clock: {offset_s: -100.0, rate: 1.0}\n"
    cameras.write_text(f"units: {{length: m}}\ncameras:\n  a:\n{CAMERA}{clock}  b:\n{CAMERA}")
    options = {"log_path": log, "seen_by": 2, "within_s": 0.5}
    tracks = write_tracks(tracks, [(float(t), "a", t, 1, 1.0) for t in range(5)], metadata=None)
    options["cutoff"] = 20.0
    report = evaluate(tracks, truth, cameras_path=cameras, **options)
    assert (report["scans"]["scored"], report["length_unit"]) == (1, "m")
    with pytest.raises(InputError, match="nothing to score"):
        evaluate(tracks, truth, **options)
    cameras.write_text(f"units: {{length: m}}\ncameras:\n  a:\n{CAMERA}")
    with pytest.raises(InputError, match="found b"):
        evaluate(tracks, truth, cameras_path=cameras, **options)


def test_limits_of_figures(run):
    tracks, truth, folder = run
    assert evaluate(tracks, truth, fail_above={"ospa.mean": 0.51, "identity_switches": 0})
    with pytest.raises(GateError, match=r"tracks\.parquet: ospa\.mean is 0\.5, above the limit 0\.4"):
        evaluate(tracks, truth, folder / "out", fail_above={"ospa.mean": 0.4}, plots=False)
    assert json.loads((folder / "out" / "report.json").read_text())["ospa"]["mean"] == pytest.approx(0.5)
    with pytest.raises(InputError, match=r"ospa\.meen.*did you mean ospa\.mean"):
        evaluate(tracks, truth, folder / "new", fail_above={"ospa.meen": 0.4})
    assert not (folder / "new").exists()
    with pytest.raises(GateError, match=r"rmse\.position has no value, so the limit 9 cannot hold"):
        evaluate(write_tracks(folder / "no" / "tracks.parquet", []), truth, fail_above={"rmse.position": 9})


def test_gates_are_in_the_report(run):
    tracks, truth, folder = run
    passed = evaluate(tracks, truth, fail_above={"ospa.mean": 0.5}, fail_below={"completeness.mean": 0.9})
    assert passed["gates"] == [
        {"name": "ospa.mean", "value": 0.5, "limit": 0.5, "fails": "above", "passed": True},
        {"name": "completeness.mean", "value": 1.0, "limit": 0.9, "fails": "below", "passed": True},
    ]
    with pytest.raises(GateError, match=r"tracks\.parquet: tracks is 1, below the limit 2") as failure:
        evaluate(tracks, truth, folder / "out", fail_below={"tracks": 2, "ospa.mean": 0.1}, plots=False)
    written = json.loads((folder / "out" / "report.json").read_text())
    assert [gate["passed"] for gate in written["gates"]] == [False, True]
    assert failure.value.report == written
    with pytest.raises(InputError, match="`fail_below`: ospa"):
        evaluate(tracks, truth, fail_below={"ospa": 1.0})
    with pytest.raises(InputError, match=r"`fail_above`: tgospa\.mean: no such figure.*`switch_cost` adds it"):
        evaluate(tracks, truth, fail_above={"tgospa.mean": 1.0})
    assert evaluate(tracks, truth, fail_above={"tgospa.mean": 9.0}, switch_cost=1.0)["gates"][0]["passed"]


def test_a_cutoff_is_required_where_nothing_gives_the_scale(tmp_path):
    rows = [(float(t), "a", t, 1, 0.25) for t in range(3)]
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(3)])
    for metadata in (None, {"length_unit": "m"}):
        tracks = write_tracks(tmp_path / "tracks.parquet", rows, metadata=metadata)
        with pytest.raises(InputError, match=r"tracks\.parquet: expected `cutoff`, or evaluation\.cutoff"):
            evaluate(tracks, truth)
        assert evaluate(tracks, truth, cutoff=1.0)["ospa"]["cutoff"] == 1.0
        assert evaluate(tracks, truth, base="mahalanobis")["ospa"]["cutoff"] == 20.0
    record = json.dumps({"config": {"evaluation": {"cutoff": 0.5}}})
    tracks = write_tracks(tmp_path / "tracks.parquet", rows, metadata={"length_unit": "m", "stereophd": record})
    assert evaluate(tracks, truth)["ospa"]["cutoff"] == 0.5


def test_tracks_of_another_scene_are_named(tmp_path, caplog):
    rows = [(float(t), "a", t, 1, 0.0) for t in range(10)]
    origin = json.dumps({"command": "simulate", "seed": 4})
    digest = hashlib.sha256(origin.encode()).hexdigest()
    record = json.dumps({"origins": {"detections": {"command": "simulate", "sha256": digest}}})
    tracks = write_tracks(tmp_path / "tracks.parquet", rows, metadata={**CENTIMETRES, "stereophd": record})
    for content, warns in (
        (origin, False),
        *((json.dumps({"command": name}), name == "simulate") for name in ("simulate", "import")),
    ):
        truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(10)], metadata={"stereophd": content})
        caplog.clear()
        evaluate(tracks, truth)
        assert ("another scene" in caplog.text) == warns
    later = write_truth(tmp_path / "later.parquet", [(t + 8, 3, 0) for t in range(10)])
    caplog.clear()
    evaluate(tracks, later)
    assert "8 of 10 scans lie outside the times" in caplog.text


def test_an_earlier_evaluation_is_kept_unless_forced(run):
    tracks, truth, folder = run
    evaluate(tracks, truth, folder / "out", plots=False)
    with pytest.raises(InputError, match="`force=True`"):
        evaluate(tracks, truth, folder / "out", plots=False)
    evaluate(tracks, truth, folder / "out", plots=False, force=True, cutoff=3.0)
    assert json.loads((folder / "out" / "report.json").read_text())["ospa"]["cutoff"] == 3.0


def test_the_same_inputs_give_the_same_bytes(run):
    tracks, truth, folder = run
    pytest.importorskip("matplotlib")
    for name in ("one", "two"):
        evaluate(tracks, truth, folder / name)
    files = sorted(os.listdir(folder / "one"))
    assert len(files) == 10
    for file in files:
        assert (folder / "one" / file).read_bytes() == (folder / "two" / file).read_bytes(), file


def test_plots_without_matplotlib(run, monkeypatch):
    tracks, truth, folder = run
    monkeypatch.setattr("stereophd.report.installed.find_spec", lambda name: None)
    with pytest.raises(InputError, match="plots need matplotlib, which is not installed: pip install matplotlib"):
        evaluate(tracks, truth, folder / "out", plots=True)
    assert not (folder / "out").exists()
    evaluate(tracks, truth, folder / "out")
    assert not list((folder / "out").glob("*.png"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": 0.5}, "order"),
        ({"cutoff": 0.0}, "cutoff"),
        ({"cutoff": float("nan")}, "cutoff"),
        ({"match_distance": 0.0}, "match_distance"),
        ({"match_distance": float("inf")}, "match_distance"),
        ({"base": "manhattan"}, "base"),
        ({"at": "frames"}, "at"),
        ({"from_s": 3.0, "to_s": 2.0}, "not after `to_s`"),
        ({"max_gap_s": -1.0}, "max_gap_s"),
        ({"ospa2_window": 0}, "ospa2_window"),
        ({"seen_by": 2}, "together"),
        ({"seen_by": 2, "within_s": 0.2}, "together"),
        ({"fail_above": {"ospa.mean": float("nan")}}, "expected a number"),
    ],
)
def test_options_out_of_range(run, options, message):
    tracks, truth, _ = run
    with pytest.raises(InputError, match=message):
        evaluate(tracks, truth, **options)


def test_a_truth_that_no_track_is_near_is_doubted(tmp_path, caplog):
    """A table in metres beside tracks in millimetres passed for objects that were all missed."""
    tracks = write_tracks(tmp_path / "tracks.parquet", [(float(t), "a", t, 1, 900.0) for t in range(3)])
    for x, doubted in ((0.9, True), (899.0, False)):
        caplog.clear()
        evaluate(tracks, write_truth(tmp_path / f"{x}.parquet", [(t, 3, x) for t in range(3)]), cutoff=10.0)
        assert ("has the truth another unit" in caplog.text) == doubted


def test_units_must_agree(tmp_path):
    rows = [(float(t), "a", t, 1, 0.0) for t in range(3)]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows, metadata={"length_unit": "cm"})
    truth_rows = [(t, 3, 0) for t in range(3)]
    silent = write_truth(tmp_path / "silent.parquet", truth_rows)
    assert evaluate(tracks, silent)["length_unit"] == "cm"
    metres = write_truth(tmp_path / "metres.parquet", truth_rows, metadata={"length_unit": "m"})
    with pytest.raises(InputError, match="lengths in cm"):
        evaluate(tracks, metres)


def test_a_similarity_brings_tracks_of_any_unit_into_that_of_the_truth(tmp_path):
    """Tracks of `calibrate` from nothing are in the unit `baseline`: no command scored them."""
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, t) for t in range(9)], metadata={"length_unit": "m"})
    record = json.dumps({"config": {"evaluation": {"cutoff": 0.2}}})
    stated = {"length_unit": "baseline", "stereophd": record}
    rows = [(float(t), "a", t, 1, 0.8 * t) for t in range(9)]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows, metadata=stated)
    report = evaluate(tracks, truth, align="similarity", cutoff=1.0)
    assert report["length_unit"] == "m"
    assert report["position_error"]["p90"] < 1e-3
    nameless = write_truth(tmp_path / "nameless.parquet", [(t, 3, t) for t in range(9)])
    assert evaluate(tracks, nameless, align="similarity", cutoff=1.0)["length_unit"] is None
    with pytest.raises(InputError, match="of the tracks and in this unit"):
        evaluate(tracks, truth, align="similarity")
    with pytest.raises(InputError, match="expected lengths in baseline"):
        evaluate(tracks, truth, align="rigid", cutoff=1.0)


@pytest.mark.parametrize(("align", "drawn"), [("none", ["a"]), ("rigid", []), ("similarity", [])])
def test_cameras_in_the_frame_of_tracks_that_are_aligned_are_not_drawn(tmp_path, monkeypatch, align, drawn):
    """Cameras of a run from nothing stood in the picture of a truth in metres, a `baseline` apart."""
    pictures = []
    monkeypatch.setattr("stereophd.report.plots.scene_plots.write_plots", lambda data, _: pictures.append(data))
    record = json.dumps({"config": {"cameras": yaml.safe_load(f"a:\n{CAMERA}")}})
    rows = [(float(t), "a", t, 1, float(t)) for t in range(9)]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows, metadata={"stereophd": record})
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, t) for t in range(9)])
    evaluate(tracks, truth, tmp_path / "out", align=align, cutoff=1.0, plots=True)
    assert [camera.name for camera in pictures[0].cameras] == drawn


def test_an_alignment_that_runs_away_is_named(tmp_path, monkeypatch):
    """Tracks in the frame of a camera: "Eigenvalues did not converge" was all that the message said."""

    def astray(*_: object) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr("stereophd.core.alignment.to_truth.register", astray)
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, t) for t in range(9)])
    tracks = write_tracks(tmp_path / "tracks.parquet", [(float(t), "a", t, 1, float(t)) for t in range(9)])
    with pytest.raises(InputError, match="`align`: expected tracks with the motion of the truth"):
        evaluate(tracks, truth, align="similarity", cutoff=1.0)


GOOD = [(0.0, "a", 0, 1, 0.0), (0.0, "a", 0, 2, 9.0), (1.0, "a", 1, 1, 0.0)]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([*GOOD, (0.5, "a", 2, 1, 0.0)], "row 3: expected times in order"),
        ([*GOOD, (2.0, "a", 2, 1, float("nan"))], "row 3: column x: expected a finite number"),
        (
            [*GOOD, (1.0, "b", 1, 1, 0.0), (1.0, "a", 1, 1, 0.0)],
            "row 4: expected all rows of an event together",
        ),
    ],
)
def test_bad_tracks(tmp_path, rows, message):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(3)])
    with pytest.raises(InputError, match=message):
        evaluate(write_tracks(tmp_path / "tracks.parquet", rows), truth)


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ([(0, "a", 0), (1, "b", 1)], "row 2: its event"),
        ([(0, "a", 0), (1, "a", 1), (1, "a", 1)], "row 2: this event"),
        ([(1, "a", 1), (0, "a", 0)], "expected times in order"),
    ],
)
def test_scans_of_another_run(tmp_path, events, message):
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, 0) for t in range(3)])
    tracks = write_tracks(tmp_path / "tracks.parquet", GOOD)
    write_scans(tmp_path / "scans.parquet", events)
    with pytest.raises(InputError, match=message):
        evaluate(tracks, truth)


def test_bad_truth(tmp_path):
    tracks = write_tracks(tmp_path / "tracks.parquet", GOOD)
    twice = write_truth(tmp_path / "twice.parquet", [(0, 3, 0), (1, 3, 0), (0, 3, 0)])
    with pytest.raises(InputError, match=r"row 2: object 3 at 0 s is there already in row 0"):
        evaluate(tracks, twice)
    with pytest.raises(InputError, match="row 1: column x"):
        evaluate(tracks, write_truth(tmp_path / "nan.parquet", [(0, 3, 0), (1, 3, np.nan)]))
    zeros = [0.0]
    columns = {"time_s": zeros, "object_id": [1], "x": zeros, "y": zeros, "z": zeros}
    with pytest.raises(InputError, match="all or none of the columns vx"):
        evaluate(tracks, write(tmp_path / "half.parquet", {**columns, "vx": zeros}))
    del columns["z"]
    with pytest.raises(InputError, match="missing column z"):
        evaluate(tracks, write(tmp_path / "flat.parquet", columns))
    text = tmp_path / "text.parquet"
    text.write_text("time_s,object_id\n")
    with pytest.raises(InputError, match="not Parquet"):
        evaluate(tracks, text)
    with pytest.raises(InputError, match="no such file"):
        evaluate(tracks, tmp_path / "nowhere.parquet")


def test_truth_velocity_and_order_of_rows(tmp_path):
    rows = [(t, k, 50 * k + t) for t in range(5) for k in (1, 0)]
    shuffled = [rows[i] for i in np.random.default_rng(1).permutation(len(rows))]
    truth = write_truth(tmp_path / "truth.parquet", shuffled, velocity=True)
    tracks = write_tracks(tmp_path / "tracks.parquet", [(float(t), "a", t, k, 50.0 * k + t) for t, k, _ in rows])
    report = evaluate(tracks, truth)
    assert report["ospa"]["mean"] == report["rmse"]["velocity"] == 0.0


def test_a_truth_as_text_is_the_same(run, tmp_path):
    tracks, truth, _ = run
    table = pq.read_table(truth)
    text = tmp_path / "truth.csv"
    names = table.column_names
    rows = [names, *(map(repr, row.values()) for row in table.to_pylist())]
    text.write_text("".join(f"{','.join(row)}\n" for row in rows))
    expected, found = evaluate(tracks, truth), evaluate(tracks, text)
    assert found["ospa"] == expected["ospa"]
    text.write_text("time_s,x,y,z\n0,1,2,3\n")
    with pytest.raises(InputError, match=r"truth\.csv: missing column object_id"):
        evaluate(tracks, text)


def shared_data() -> Path:
    folder = Path(os.environ.get("STEREOPHD_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no shared data: set STEREOPHD_DATA to their folder")
    return folder


def test_real_truth_and_log(tmp_path):
    """RTK truth at 5 Hz and four unsynchronised cameras: tracks on the truth come out on the truth."""
    drone = shared_data() / "drone" / "1"
    truth = pq.read_table(drone / "truth.parquet").to_pydict()
    log = pq.read_table(drone / "detections.parquet").to_pydict()
    rows, times = [], np.array(truth["time_s"])
    seen_at: dict[str, float] = {}
    expected = 0
    for frame, (time, camera, u) in enumerate(zip(log["time_s"], log["camera"], log["u_px"], strict=True)):
        rows.append((time, camera, frame, 1, float(np.interp(time, times, truth["x"])) + 0.01))
        if u is not None:  # else an empty frame
            seen_at[camera] = time
        expected += sum(time - last <= 0.2 for last in seen_at.values()) >= 2
    flat = write(
        tmp_path / "truth.parquet",
        {**{name: truth[name] for name in ("time_s", "object_id", "x")}, "y": 0 * times, "z": 0 * times},
    )
    report = evaluate(
        write_tracks(tmp_path / "tracks.parquet", rows),
        flat,
        log_path=drone / "detections.parquet",
        seen_by=2,
        within_s=0.2,
        at="events",
    )
    assert report["position_error"]["median"] == pytest.approx(0.01, abs=1e-9)
    assert report["position_error"]["n"] == report["scans"]["scored"] == expected


def test_tracks_are_aligned_when_asked_for(tmp_path, caplog):
    # The truth runs along x at 1/s; the tracks lag by 0.5 and their clock is 0.25 s late at the middle, and slow.
    truth = write_truth(tmp_path / "truth.parquet", [(t, 3, t**2 / 20) for t in range(20)])
    times = np.linspace(3.0, 16.0, 40)
    real = 9.5 + 0.25 + 1.001 * (times - 9.5)
    rows = [
        (float(t), "a", k, 8, 0.5 + float(np.interp(r, np.arange(20), np.arange(20) ** 2 / 20)))
        for k, (t, r) in enumerate(zip(times, real, strict=True))
    ]
    tracks = write_tracks(tmp_path / "tracks.parquet", rows)
    plain = evaluate(tracks, truth)
    assert plain["alignment"] == {"frame": "none", "clock": False, "found": None}
    aligned = evaluate(tracks, truth, align="rigid", align_clock=True)
    found = aligned["alignment"]["found"]
    assert found["clock"]["shift_s"] == pytest.approx(0.25, abs=1e-3)
    assert found["clock"]["rate"] == pytest.approx(1.001, abs=1e-4)
    assert found["translation"][0] == pytest.approx(-0.5, abs=1e-3)
    assert aligned["position_error"]["p90"] < 1e-3 < 0.5 < plain["position_error"]["p90"]
    assert evaluate(tracks, truth, align="rigid")["position_error"]["p90"] > 0.05
    assert not caplog.text
    # the clock of tracks that state 1 mm is 5 % fast, which no clock is
    fast = [(t, *rest, np.interp(9.5 + 1.05 * (t - 9.5), range(20), np.arange(20) ** 2 / 20)) for t, *rest, _ in rows]
    evaluate(write_tracks(tmp_path / "tracks.parquet", fast, std=1e-3), truth, align="rigid", align_clock=True)
    assert "after alignment the tracks are off by" in caplog.text or "off in rate" in caplog.text
    with pytest.raises(InputError, match="`align`: expected one of none, rigid, similarity, found affine"):
        evaluate(tracks, truth, align="affine")
    with pytest.raises(InputError, match="`align`: expected 6 or more estimates"):
        evaluate(tracks, truth, align="rigid", from_s=15.5)
