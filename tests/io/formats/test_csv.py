"""Tables of detections, as other programs write them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.errors import InputError
from stereophd.io.interchange.pixels import point_rows

from .conftest import log_rows

Import = Callable[..., tuple[dict[str, Any], Path]]


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_columns_rates_offsets_and_empty_frames(tmp_path: Path, imported: Import) -> None:
    source = write(
        tmp_path / "points.csv",
        "view,image,x,y,conf\nb,10,5.5,6.5,0.9\na,2,3,4,0.8\na,0,1,2,0.7\na,2,30,40,0.6\nb,12,7,8,0.5\nb,12,7,8,0.5\n",
    )
    report, out = imported("csv", source, rates={"a": 10.0, "b": 20.0}, offsets={"b": -0.45}, frames={"a": (0, 3)})
    rows = log_rows(out / "detections.parquet")
    b = 10 / 20 - 0.45
    assert rows == [
        (0.0, "a", 0, 1.0, 2.0),
        (pytest.approx(b), "b", 10, 5.5, 6.5),
        (0.1, "a", 1, None, None),
        (pytest.approx(b + 0.05), "b", 11, None, None),
        (pytest.approx(b + 0.1), "b", 12, 7.0, 8.0),
        (0.2, "a", 2, 3.0, 4.0),
        (0.2, "a", 2, 30.0, 40.0),
        (pytest.approx(0.3), "a", 3, None, None),
    ]
    scores = pq.read_table(out / "detections.parquet").column("score").to_pylist()
    assert scores == [0.7, 0.9, None, None, 0.5, 0.8, 0.6, None]
    assert report["cameras"]["a"]["filled_frames"] == 2
    assert report["cameras"]["b"]["duplicate_rows"] == 1
    assert any("u_px from x" in sentence for sentence in report["assumed"])


def test_frame_numbers_that_count_by_two_are_not_filled_to_one(tmp_path: Path, imported: Import) -> None:
    numbers = [0, 2, 8, *range(10, 30, 2)]
    source = write(tmp_path / "cam7.csv", "frame,u,v\n" + "".join(f"{n},1,1\n" for n in numbers))
    _, out = imported("csv", source, rates=1.0)
    assert [(r[1], r[2]) for r in log_rows(out / "detections.parquet")] == [("cam7", f) for f in range(0, 30, 2)]


def test_times_without_frames(tmp_path: Path, imported: Import) -> None:
    source = write(tmp_path / "c.txt", "timestamp;pos_a;pos_b\n1500;1;2\n1500;3;4\n1700;;\n2000;5;6\n")
    _, out = imported("csv", source, columns={"u_px": "pos_a", "v_px": "pos_b"}, time_unit="ms")
    assert log_rows(out / "detections.parquet") == [
        (1.5, "c", 0, 1.0, 2.0),
        (1.5, "c", 0, 3.0, 4.0),
        (pytest.approx(1.7), "c", 1, None, None),
        (2.0, "c", 2, 5.0, 6.0),
    ]


def test_even_times_without_frame_numbers_tell_frames_without_detections(tmp_path: Path, imported: Import) -> None:
    """Else a detector that misses half of the frames of one object would seem to miss nothing."""
    rng = np.random.default_rng(1)
    seen = np.flatnonzero(rng.random(400) < 0.5)
    times = 0.02 * seen + rng.normal(0.0, 2e-4, len(seen))
    source = write(tmp_path / "c.csv", "time_s,u_px,v_px\n" + "".join(f"{time:.5f},1,1\n" for time in times))
    report, out = imported("csv", source)
    rows = log_rows(out / "detections.parquet")
    assert [row[2] for row in rows if row[3] is not None] == (seen - seen[0]).tolist()
    assert [row[2] for row in rows] == list(range(seen[-1] - seen[0] + 1))
    assert report["cameras"]["c"]["filled_frames"] == len(rows) - len(seen)
    assert "every 0.02 s" in str(report["assumed"])
    _, out = imported("csv", source, fill=False)
    assert len(log_rows(out / "detections.parquet")) == len(seen)


def test_pauses_between_clips_are_no_frames_without_detections(tmp_path: Path, imported: Import) -> None:
    """Three clips an hour apart are not 180,200 frames in which the camera looked and saw nothing."""
    clip = np.delete(np.arange(200), [50, 51, 120]) / 25.0
    times = np.concatenate([clip + start for start in (0.0, 3600.01, 7200.0)])
    source = write(tmp_path / "c.csv", "time_s,u_px,v_px\n" + "".join(f"{time:.4f},1,1\n" for time in times))
    report, out = imported("csv", source)
    row = report["cameras"]["c"]
    assert (row["frames"], row["filled_frames"], row["pauses"]) == (600, 9, 2)
    assert row["rate_hz"] == pytest.approx(25.0)
    assert "c: 2 pauses, 7184 s in all, would have more frames" in str(report["assumed"])
    assert [r[2] for r in log_rows(out / "detections.parquet")] == list(range(600))


def test_uneven_times_without_frame_numbers_are_told(tmp_path: Path, imported: Import) -> None:
    times = np.cumsum(np.random.default_rng(2).exponential(0.02, 200))
    source = write(tmp_path / "c.csv", "time_s,u_px,v_px\n" + "".join(f"{time:.5f},1,1\n" for time in times))
    report, _ = imported("csv", source)
    assert report["cameras"]["c"]["filled_frames"] == 0
    assert "estimated too high" in str(report["assumed"])


def test_times_without_their_unit_get_a_plain_word(tmp_path: Path, imported: Import) -> None:
    """Nanoseconds of the epoch are no time; milliseconds agree with the frame rate that follows from them."""
    for name, start, factor in (("ns", 1_732_545_000_000, 1_000_000), ("ms", 0, 1)):
        rows = "".join(f"{(start + 33 * k) * factor},{k},{10 + k},20\n" for k in range(30))
        (tmp_path / f"{name}.csv").write_text("time_s,frame,u_px,v_px\n" + rows)
    with pytest.raises(InputError, match=r"expected times in s, found 1732545000000000000; `time_unit` ns"):
        imported("csv", tmp_path / "ns.csv")
    cameras = tmp_path / "cameras.yaml"
    cameras.write_text(
        "units: {length: m}\ncameras:\n  ms: {image_size_px: [640, 480], pose: {center: [0, 0, 0]},"
        " intrinsics: {fx: 500, fy: 500, cx: 320, cy: 240}}\n"
    )
    report, _ = imported("csv", tmp_path / "ms.csv", cameras=cameras)
    assert [one["cause"] for one in report["checks"] if one["status"] == "warning"] == ["milliseconds"]


@pytest.mark.parametrize(
    ("text", "camera"),
    [
        ("time_s, camera, frame, u_px, v_px\n0.0, left, 0, 1.0, 2.0\n0.1, left, 1, 1.5, 2.5\n", "left"),
        ('"time_s","camera","frame","u, px","v_px"\n0.0,"le,ft",0,1.0,2.0\n0.1,"le,ft",1,1.5,2.5\n', "le,ft"),
        ("time_s;camera;frame;u_px;v_px\n0.0;le,ft;0;1.0;2.0\n0.1;le,ft;1;1.5;2.5\n", "le,ft"),
    ],
)
def test_spaces_and_quotes(tmp_path: Path, imported: Import, text: str, camera: str) -> None:
    stated = {"columns": {"u_px": "u, px"}} if "u, px" in text else {}
    _, out = imported("csv", write(tmp_path / "c.csv", text), **stated)
    assert log_rows(out / "detections.parquet") == [(0.0, camera, 0, 1.0, 2.0), (0.1, camera, 1, 1.5, 2.5)]


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ({"pixel_origin": "corner"}, (9.5, 19.5)),
        ({"pixel_origin": "one"}, (9.0, 19.0)),
        ({"rows_from": "bottom", "image_sizes": (64, 48)}, (10.0, 27.0)),
        ({"pixel_origin": "one", "rows_from": "bottom", "image_sizes": (64, 48)}, (9.0, 28.0)),
    ],
)
def test_conventions_of_pixels(tmp_path: Path, imported: Import, stated: Any, expected: tuple[float, float]) -> None:
    source = write(tmp_path / "c.csv", "t,u,v\n0,10,20\n")
    _, out = imported("csv", source, **stated)
    assert log_rows(out / "detections.parquet")[0][3:] == expected


def test_a_large_unsorted_table_is_merged_in_order(
    tmp_path: Path, imported: Import, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stereophd.io.interchange.assembly.PIECE_ROWS", 37)
    random = np.random.default_rng(1)
    rows = [(c, f, u) for c in "xyz" for f in range(150) for u in range(random.integers(0, 4))]
    for order in (np.arange(len(rows)), random.permutation(len(rows))):
        lines = [f"{rows[i][0]},{rows[i][1]},{rows[i][2]},1" for i in order]
        source = write(tmp_path / "many.csv", "camera,frame,u,v\n" + "\n".join(lines) + "\n")
        report, out = imported("csv", source, rates={"x": 10.0, "y": 9.7, "z": 30.0})
        found = log_rows(out / "detections.parquet")
        assert sorted((c, f, u) for _, c, f, u, _ in found if u is not None) == rows
        assert [r[0] for r in found] == sorted(r[0] for r in found)
        for camera in "xyz":
            frames = sorted({f for _, c, f, _, _ in found if c == camera})
            assert frames == list(range(frames[0], frames[-1] + 1))
            assert report["cameras"][camera]["frames"] == len(frames)


def test_rows_with_one_coordinate_are_bad_rows_of_the_log(tmp_path: Path, imported: Import) -> None:
    """One of them refused the whole import, and nothing let a user go on."""
    text = "time,u,v\n0,1,2\n1,4,\n2,,\n3,,5\n3,,\n3,,5\n4,1,2\n"
    report, out = imported("csv", write(tmp_path / "half.csv", text))
    (warning,) = [text for text in report["warnings"] if "one of u and v" in text]
    assert "half.csv: camera half: 3 rows with one of u and v, the first at time 1: " in warning
    assert [row[3:] for row in log_rows(out / "detections.parquet")] == [
        (1.0, 2.0), (4.0, None), (None, None), (None, 5.0), (None, 5.0), (1.0, 2.0)
    ]  # fmt: skip
    # a gap beside detections of its frame is left out, and no detection that is repeated
    assert [report["cameras"]["half"][key] for key in ("detections", "empty_frames", "duplicate_rows")] == [2, 1, 0]
    assert not [text for text in report["assumed"] if "repeated" in text]


@pytest.mark.parametrize(
    ("text", "stated", "message"),
    [
        ("a,b\n1,2\n", {}, "expected columns for u_px, v_px, time_s or frame, found a, b"),
        ("u,v\n1,2\n", {}, "expected columns for time_s or frame"),
        ("frame,u,v\n1,2,3\n", {}, "bad.csv: camera bad: expected times or `rates`"),
        ("frame,t,u,v\n1,0.1,2,3\n7,nan,2,3\n", {}, "found frame 7 without a time"),
        ("frame,u,v\n1.5,2,3\n", {"rates": 1.0}, "expected whole frame numbers, found 1.5"),
        ("frame,u,v\n1,2,x\n", {"rates": 1.0}, "invalid value 'x'"),
        ("frame,u,v\n0,1,1\n1,1,1\n1000000000000,1,1\n", {"rates": 1.0}, "expected frame numbers that count frames"),
        ("frame,time,u,v\n0,1,1,1\n1,0.5,1,1\n", {}, "expected times that increase with the frame number"),
        # frame numbers that begin anew put the detections of several times into one frame
        (
            "frame,time,u,v\n0,0,1,1\n1,1,1,1\n0,2,1,1\n1,3,1,1\n",
            {},
            "1 s at frame 1, not after 2 s of the frame before",
        ),
        (
            "t,u,v\n0,1,1\n1,2",
            {},
            "Expected 3 columns, got 2: 1,2; the last line is too short: the file seems to be cut",
        ),
        (f"t,u,v,{'n' * 99}\n0,1,1,\n0,1,{'1' * 99}\n", {}, "the last line is too short: the file seems to be cut off"),
        ("t,u,v\n0,1\n1,2,3\n", {}, "Expected 3 columns, got 2: 0,1$"),
        ("t,u,v\n0,1,2\n1,2,3,4\n", {}, "Expected 3 columns, got 4: 1,2,3,4$"),
        ("t,u,v\n0,1,1\n", {"columns": {"u_px": "q"}}, "expected a column q"),
        ("t,u,v\n0,1,1\n", {"rows_from": "bottom"}, "expected the size of the images"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, imported: Import, text: str, stated: Any, message: str) -> None:
    source = write(tmp_path / "bad.csv", text)
    with pytest.raises(InputError, match=message.replace("(", r"\(")):
        imported("csv", source, **stated)
    assert not (tmp_path / "imported").exists()


def test_a_rate_that_takes_the_place_of_times_is_noted(tmp_path: Path, imported: Import) -> None:
    source = write(tmp_path / "c.csv", "frame,t,u,v\n0,0.03,1,1\n1,0.04,1,1\n")
    report, _ = imported("csv", source, rates=50.0)
    assert report["cameras"]["c"]["last_s"] == 0.02
    noted = "c: times are by `rates`: those of the source are not used"
    assert noted in report["assumed"]
    assert noted not in imported("csv", source)[0]["assumed"]


def test_times_that_scatter_by_more_than_a_frame_are_taken_from_frame_numbers(tmp_path: Path, imported: Import) -> None:
    """A frame has one time: where stamps overlap nobody knows it, but for the rate. Numbers that repeat have none."""
    rows = [(frame, 0.1 * frame + 0.13 * (row - 1), row) for frame in range(20) for row in range(3)]
    text = "frame,time,u,v\n" + "".join(f"{frame},{time:.3f},{row},1\n" for frame, time, row in rows)
    source = write(tmp_path / "c.csv", text)
    with pytest.raises(InputError, match=r"of the frame before: .* or state `rates` where numbers count frames"):
        imported("csv", source)
    report, _ = imported("csv", source, rates=10.0)
    assert (report["cameras"]["c"]["frames"], report["cameras"]["c"]["last_s"]) == (20, 1.9)
    twice = write(
        tmp_path / "d.csv", text + "".join(f"{frame},{time + 2.0:.3f},{row},1\n" for frame, time, row in rows)
    )
    with pytest.raises(InputError, match=r"numbers that do not begin anew, found frame 0 from -0\.13 to 2\.13 s"):
        imported("csv", twice, rates=10.0)


def test_warnings_name_pixels_and_times_that_cannot_be(tmp_path: Path, imported: Import) -> None:
    """Without cameras too, where no check looks at the log."""
    sources = [
        write(tmp_path / f"{name}.csv", f"t,u,v\n{first + 0.5},0.1,0.2\n{first + 1},0.5,{v}\n")
        for name, first, v in (("c", 0, 0.5), ("d", 1e4, 2.0))
    ]
    report, _ = imported("csv", *sources)
    pixels, times = report["warnings"]
    assert pixels.startswith("camera c: all pixels lie between 0 and 1: they seem to be divided by the image size")
    assert times.startswith("the cameras have no time in common (c 0.5 to 1 s, d 10000.5 to 10001 s)")
    assert imported("csv", sources[1])[0]["warnings"] == []


@pytest.mark.parametrize("fill", [True, False])
@pytest.mark.parametrize(("missing", "factor", "is_warned"), [(0, 1, True), (7, 1, True), (7, 0.5, False)])
def test_whole_numbers_may_be_frames_where_one_is_missing_too(
    tmp_path: Path, imported: Import, fill: bool, missing: int, factor: float, is_warned: bool
) -> None:
    times = [factor * number for number in range(40) if number != missing]
    source = write(tmp_path / "c.csv", "t,u,v\n" + "".join(f"{time},9,9\n" for time in times))
    report, _ = imported("csv", source, fill=fill)
    assert ["`time_unit` ms" in sentence for sentence in report["warnings"]] == [True] * is_warned


def test_cameras_of_other_names_only_are_refused(tmp_path: Path, imported: Import) -> None:
    (tmp_path / "hive.csv").write_text("frame,x,y\n0,1,2\n1,2,3\n")
    text = "{image_width: 100, image_height: 80, K: [[90, 0, 50], [0, 90, 40], [0, 0, 1]], D: [0, 0, 0, 0], "
    text += "rvec: [0, 0, 0], tvec: [0, 0, 0]}"
    (tmp_path / "hive_calibration.yml").write_text(f"left: {text}\n")
    with pytest.raises(InputError, match="detections of the cameras left, found those of hive; use `rename` hive=NAME"):
        imported("csv", tmp_path / "hive.csv", cameras=tmp_path / "hive_calibration.yml", rates=10.0)


TRUTH_ROWS = [{"time_s": 0.0, "object_id": 4, "x": 1.0, "y": 2.0, "z": 3.0}]


@pytest.mark.parametrize("header", ["time_s,object_id,x,y,z", "x,y,z,stamp,ID", "t,track_id,x_m,y_m,z_m"])
def test_points_in_space_have_the_columns_of_the_detections(tmp_path: Path, imported: Import, header: str) -> None:
    source, truth = tmp_path / "a.csv", tmp_path / "truth.csv"
    stamped = "stamp" in header
    source.write_text(f"{'stamp' if stamped else 'time_s'},u,v\n0,5,5\n40,6,6\n")
    truth.write_text(f"{header}\n{'1,2,3,0,4' if stamped else '0,4,1,2,3'}\n")
    stated = {"columns": {"time_s": "stamp"}} if stamped else {}
    report, out = imported("csv", source, truth=truth, time_unit="ms", **stated)
    assert pq.read_table(out / "truth.parquet").to_pylist() == TRUTH_ROWS
    assert report["truth"] == {"rows": 1}


def test_native_points_in_space_go_with_every_format(tmp_path: Path, imported: Import) -> None:
    source, truth = tmp_path / "cam.txt", tmp_path / "truth.csv"
    source.write_text("1,-1,10,10,4,4,1,-1,-1,-1\n2,-1,11,10,4,4,1,-1,-1,-1\n")
    truth.write_text("time_s,object_id,x,y,z\n0,4,1,2,3\n")
    _, out = imported("mot", source, truth=truth, rates=25.0)
    assert pq.read_table(out / "truth.parquet").to_pylist() == TRUTH_ROWS
    truth.write_text("time_s,name,x,y,z\n0,4,1,2,3\n")
    with pytest.raises(InputError, match="`truth`: expected an option that has an effect on a source of format mot"):
        imported("mot", source, truth=truth, rates=25.0)


def test_native_cameras_state_their_own_detector(tmp_path: Path, imported: Import) -> None:
    source, cameras = tmp_path / "a.csv", tmp_path / "cameras.yaml"
    source.write_text("frame,x,y\n0,5,5\n1,6,6\n")
    cameras.write_text(
        "units: {length: m}\ncameras:\n  a: {image_size_px: [100, 100], intrinsics: {focal: unknown}, pose: unknown}\n"
    )
    detector = {"sigma_px": [1.0, 1.0], "p_detect": 0.9, "clutter_per_frame": 1.0}
    with pytest.raises(InputError, match=r"`detector`: .* with .*cameras\.yaml \(native cameras state size"):
        imported("csv", source, rates=25.0, detector=detector, cameras=cameras)


def test_a_truth_that_is_native_already_needs_no_import(tmp_path: Path, imported: Import) -> None:
    source, truth = tmp_path / "a.csv", tmp_path / "truth.parquet"
    source.write_text("time_s,u,v\n0,5,5\n")
    pq.write_table(pa.Table.from_pylist(TRUTH_ROWS), truth)
    with pytest.raises(InputError, match=r"truth\.parquet: expected .* a Parquet file; .* needs no import"):
        imported("csv", source, truth=truth)


@pytest.mark.parametrize(("time", "unit"), [("1732545000021000000", "ns"), ("1732545000021", "ms")])
@pytest.mark.parametrize("of_truth", [False, True])
def test_times_that_cannot_be_seconds(tmp_path: Path, imported: Import, time: str, unit: str, of_truth: bool) -> None:
    source, truth = tmp_path / "a.csv", tmp_path / "truth.csv"
    source.write_text(f"stamp,u,v\n{'0' if of_truth else time},5,5\n")
    truth.write_text(f"stamp,x,y,z\n{time},1,2,3\n")
    name = "truth" if of_truth else "a"
    with pytest.raises(InputError) as refused:
        imported("csv", source, columns={"time_s": "stamp"}, truth=truth if of_truth else None)
    assert re.search(rf"{name}\.csv: column stamp: expected times in s, found {time[:10]}", str(refused.value))
    assert str(refused.value).endswith(f"`time_unit` {unit} says that it is 1732545000.021 s")
    _, out = imported("csv", source, columns={"time_s": "stamp"}, time_unit=unit)
    assert log_rows(out / "detections.parquet")[0][0] == pytest.approx(0.0 if of_truth else 1732545000.021)


def test_a_table_without_times_names_its_columns(tmp_path: Path, imported: Import) -> None:
    source = write(tmp_path / "a.csv", "frame,sec,nanosec,u,v\n0,1732545000,21000000,5,5\n")
    with pytest.raises(InputError, match=r"found frame numbers only in the columns frame, sec, .*`columns` time_s=COL"):
        imported("csv", source)


def test_scores_that_are_not_used_are_noted(tmp_path: Path, imported: Import) -> None:
    source = write(tmp_path / "a.csv", "time_s,u,v,likelihood\n0,5,5,0.02\n1,6,6,0.9\n")
    report, _ = imported("csv", source)
    assert any("`least_score`" in sentence for sentence in report["assumed"])
    report, _ = imported("csv", source, least_score=0.5)
    assert not any("are not used" in sentence for sentence in report["assumed"])


@pytest.mark.parametrize(("distance", "stated", "warns"), [(1500, "", True), (3, "", False), (1500, "mm", False)])
def test_cameras_far_from_each_other_make_metres_doubtful(
    tmp_path: Path, imported: Import, distance: float, stated: str, warns: bool, caplog: pytest.LogCaptureFixture
) -> None:
    camera = {"K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "rvec": [0, 0, 0], "image_size": [640, 480]}
    rig = {name: {**camera, "tvec": [x, 0, 0]} for name, x in (("a", 0), ("b", -distance))}
    cameras = write(tmp_path / "rig.json", json.dumps(rig))
    source = write(tmp_path / "points.csv", "camera,time_s,u,v\na,0,5,5\nb,0,6,6\n")
    imported("csv", source, cameras=cameras, **({"length_unit": stated} if stated else {}))
    text = f"cameras are {distance} m apart, the nearest {distance} m"
    assert any(text in message for message in caplog.messages) is warns


def test_a_parquet_file_of_own_columns_is_a_table_like_any_other(tmp_path: Path, imported: Import) -> None:
    rows = {"Camera": ["left", "right", "left"], "t_ms": [0, 10, 500], "cx": [1.0, 2.0, None], "cy": [5, 6, None]}
    table = pa.table(rows)
    pq.write_table(table.set_column(0, "Camera", table["Camera"].dictionary_encode()), tmp_path / "blobs.parquet")
    named = {"u_px": "cx", "v_px": "cy", "time_s": "t_ms"}
    _, out = imported("csv", tmp_path / "blobs.parquet", columns=named, time_unit="ms")
    expected = [(0.0, "left", 0, 1.0, 5.0), (0.01, "right", 0, 2.0, 6.0), (0.5, "left", 1, None, None)]
    assert log_rows(out / "detections.parquet") == expected
    with pytest.raises(InputError, match="found a Parquet file; `stereophd import csv` reads tables of any columns"):
        imported("mot", tmp_path / "blobs.parquet")
    dated = pa.table({"u": [1.0], "v": [1.0], "t": pa.array([0], pa.timestamp("ns"))})
    pq.write_table(dated, tmp_path / "dated.parquet")
    with pytest.raises(InputError, match="expected rows of a table of numbers, found: Unsupported cast"):
        imported("csv", tmp_path / "dated.parquet")


def test_a_truth_as_parquet_of_own_columns_is_read(tmp_path: Path, imported: Import) -> None:
    (tmp_path / "a.csv").write_text("time_s,u,v\n0,5,5\n")
    points = {"time_s": [0.0], "track": [3], "x_m": [1.0], "y_m": [2.0], "z_m": [3.0]}
    pq.write_table(pa.table(points), tmp_path / "points.parquet")
    _, out = imported("csv", tmp_path / "a.csv", truth=tmp_path / "points.parquet")
    found = pq.read_table(out / "truth.parquet").to_pylist()
    assert found == [{"time_s": 0.0, "object_id": 3, "x": 1.0, "y": 2.0, "z": 3.0}]


def test_a_point_with_one_coordinate_is_a_bad_row_in_every_format() -> None:
    """Formats of points took it for one that is not seen, in silence."""
    points = np.array([[[1.0, 2.0], [3.0, np.nan]], [[np.nan, np.nan], [np.nan, np.nan]]])
    piece = point_rows(Path("points.csv"), "left", np.array([4.0, 5.0]), points, None)
    np.testing.assert_array_equal(piece.pixels, [[1.0, 2.0], [3.0, np.nan], [np.nan, np.nan]])
    np.testing.assert_array_equal(piece.frame, [4.0, 4.0, 5.0])
