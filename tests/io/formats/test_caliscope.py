"""caliscope and aniposelib: files written by hand, and a real session."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.config.loading import load_cameras
from stereophd.core.geometry.pose import rotation_to_vector
from stereophd.errors import InputError
from stereophd.io.interchange.cameras import take_apart
from tests.shared_data import shared_data

from .conftest import assert_same_cameras, cameras_of, log_rows, rig

Import = Callable[..., tuple[dict[str, Any], Path]]


def write_session(folder: Path, version: int) -> None:
    """Write a session of two cameras; version 0 has ports and rotation vectors."""
    lines = []
    for index, (name, config) in enumerate(rig().items()):
        parts = take_apart(name, config)
        rotation = parts.rotation if version else rotation_to_vector(parts.rotation)
        lines += [f"[cameras.{index}]" if version else f"[cam_{index}]", f"{'cam_id' if version else 'port'} = {index}"]
        lines += [f"size = {list(parts.size)}", f"matrix = {parts.matrix.tolist()}", "ignore = false"]
        lines += [f"distortions = {parts.coefficients[:5].tolist()}", f"rotation = {rotation.tolist()}"]
        lines += [f"translation = {parts.translation.tolist()}", ""]
    (folder / ("camera_array.toml" if version else "config.toml")).write_text("\n".join(lines))
    camera, point = ("cam_id", "keypoint_id") if version else ("port", "point_id")
    (folder / "xy.csv").write_text(
        f"sync_index,{camera},frame_index,frame_time,{point},img_loc_x,img_loc_y\n"
        "5,0,4,100.25,7,10.5,20.5\n5,0,4,100.25,8,11.5,20.5\n7,0,6,100.75,7,12.5,20.5\n6,1,5,100.5,7,1,2\n"
    )
    (folder / "timestamps.csv").write_text(
        f"sync_index,{camera},frame_time\n5,1,100.3125\n5,0,100.25\n6,0,100.5\n6,1,100.5\n7,0,100.75\n7,1,100.8125\n"
    )


def test_both_versions_of_a_session(tmp_path: Path, imported: Import) -> None:
    for version in (0, 1):
        folder = tmp_path / f"session{version}"
        folder.mkdir()
        write_session(folder, version)
        report, out = imported("caliscope", folder)
        expected = dict(zip(("cam0", "cam1"), rig().values(), strict=True))
        assert_same_cameras(cameras_of(out), expected)
        assert log_rows(out / "detections.parquet") == [
            (100.25, "cam0", 5, 10.5, 20.5),
            (100.25, "cam0", 5, 11.5, 20.5),
            (100.3125, "cam1", 5, None, None),
            (100.5, "cam0", 6, None, None),
            (100.5, "cam1", 6, 1.0, 2.0),
            (100.75, "cam0", 7, 12.5, 20.5),
            (100.8125, "cam1", 7, None, None),
        ]
        assert report["length_unit"] == "m"


@pytest.mark.parametrize("place", ["calibration/extrinsic/xy.csv", "calibration/extrinsic/CHARUCO/xy_CHARUCO.csv"])
def test_a_session_finds_its_points(tmp_path: Path, imported: Import, place: str) -> None:
    write_session(tmp_path, 1)
    _, flat = imported("caliscope", tmp_path)
    expected = log_rows(flat / "detections.parquet")
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / "xy.csv").rename(tmp_path / place)
    (tmp_path / "timestamps.csv").rename(tmp_path / "calibration/extrinsic/timestamps.csv")
    later = tmp_path / "recordings/walk/POSE"
    later.mkdir(parents=True)
    (later / "xy_POSE.csv").write_bytes((tmp_path / place).read_bytes())
    (later / "xyz_POSE.csv").write_text("sync_index,point_id,x_coord,y_coord,z_coord,frame_time\n5,7,1,2,3,100.3\n")
    report, out = imported("caliscope", tmp_path, truth=later / "xyz_POSE.csv")
    assert log_rows(out / "detections.parquet") == expected
    assert any("not of recordings/walk/POSE/xy_POSE.csv" in sentence for sentence in report["assumed"])
    assert pq.read_table(out / "truth.parquet").to_pylist() == [
        {"time_s": 100.3, "object_id": 7, "x": 1.0, "y": 2.0, "z": 3.0}
    ]


def test_a_frame_that_the_times_lack_was_not_recorded(tmp_path: Path, imported: Import) -> None:
    """A camera that dropped a frame did not miss the object; the points are beside the times, as older versions do."""
    write_session(tmp_path, 0)
    (tmp_path / "recording_1").mkdir()
    (tmp_path / "xy.csv").rename(tmp_path / "recording_1/xy.csv")
    times = (tmp_path / "timestamps.csv").read_text().replace("6,0,100.5\n", "")
    (tmp_path / "recording_1/frame_time_history.csv").write_text(times)
    _, out = imported("caliscope", tmp_path)
    assert [row[2] for row in log_rows(out / "detections.parquet") if row[1] == "cam0"] == [5, 5, 7]


def test_a_session_without_points_says_so(tmp_path: Path, imported: Import) -> None:
    write_session(tmp_path, 1)
    (tmp_path / "xy.csv").unlink()
    report, out = imported("caliscope", tmp_path)
    assert any("cameras only" in sentence for sentence in report["assumed"])
    assert not (out / "detections.parquet").exists()


def test_points_whose_columns_have_other_names_are_not_left_out(tmp_path: Path, imported: Import) -> None:
    """The import wrote the cameras alone, and its note said that there was no file of points."""
    write_session(tmp_path, 1)
    points = tmp_path / "xy.csv"
    points.write_text(points.read_text().replace("img_loc_x", "u"))
    with pytest.raises(InputError, match=r"xy\.csv: expected a column img_loc_x, found sync_index, .*, u, img_loc_y"):
        imported("caliscope", tmp_path)


def test_points_in_space_with_a_column_for_each_keypoint_are_left_out(tmp_path: Path, imported: Import) -> None:
    """Caliscope writes these too; a session with them and cameras alone was refused for their columns."""
    write_session(tmp_path, 1)
    (tmp_path / "xy.csv").unlink()
    (tmp_path / "xyz_POSE_labelled.csv").write_text("sync_index,nose_x,nose_y,nose_z\n5,1,2,3\n")
    report, _ = imported("caliscope", tmp_path)
    assert any("cameras only" in note for note in report["assumed"])


def test_a_word_among_the_numbers_is_refused_by_its_column(tmp_path: Path, imported: Import) -> None:
    write_session(tmp_path, 1)
    points = tmp_path / "xy.csv"
    points.write_text(points.read_text().replace("100.75", "late"))
    with pytest.raises(InputError, match=r"xy\.csv: .* in column frame_time: .*'late'"):
        imported("caliscope", tmp_path)


def test_times_in_milliseconds(tmp_path: Path, imported: Import) -> None:
    """The remedy of the check names this option, which the format refused."""
    write_session(tmp_path, 1)
    for name, column in (("xy.csv", 3), ("timestamps.csv", 2)):
        head, *rows = [line.split(",") for line in (tmp_path / name).read_text().splitlines()]
        rows = [[*row[:column], f"{1000.0 * float(row[column])}", *row[column + 1 :]] for row in rows]
        (tmp_path / name).write_text("".join(",".join(row) + "\n" for row in [head, *rows]))
    _, out = imported("caliscope", tmp_path, time_unit="ms")
    assert [row[0] for row in log_rows(out / "detections.parquet")] == [
        100.25, 100.25, 100.3125, 100.5, 100.5, 100.75, 100.8125
    ]  # fmt: skip


def test_times_without_a_common_index_count_the_frames(tmp_path: Path, imported: Import) -> None:
    write_session(tmp_path, 1)
    times = [f"0,{time}" for time in (100.75, 100.05, 100.5, 100.15, 100.2, 100.25, 100.1)]
    times += [f"1,{100 + k / 10}" for k in range(6)]
    (tmp_path / "timestamps.csv").write_text("cam_id,frame_time\n" + "\n".join(times) + "\n")
    _, out = imported("caliscope", tmp_path)
    rows = [row[2:] for row in log_rows(out / "detections.parquet") if row[1] == "cam0"]
    assert rows == [(0, None, None), (1, None, None), (2, None, None), (3, None, None)] + [
        (4, 10.5, 20.5),
        (4, 11.5, 20.5),
        (5, None, None),
        (6, 12.5, 20.5),
    ]


def test_a_real_session_agrees_with_its_conversion(imported: Import) -> None:
    """Detections, empty frames and cameras are those of a conversion that was made by hand."""
    board = shared_data("board", "1")
    report, out = imported("caliscope", board / "caliscope", offsets=-48033.00157345)
    expected, found = (
        sorted((c, f - first, u, v, t) for t, c, f, u, v in log_rows(path / "detections.parquet") if u is not None)
        for path, first in ((board, 0), (out, 416))
    )
    assert len(found) == 1725
    assert [row[:4] for row in found] == [row[:4] for row in expected]
    # the conversion rounded times
    assert np.abs(np.array([a[4] - b[4] for a, b in zip(found, expected, strict=True)])).max() < 1e-4
    assert sum(row["frames"] for row in report["cameras"].values()) == 192
    assert_same_cameras(cameras_of(out), dict(load_cameras(board / "cameras.yaml").cameras), atol=1e-6)
    assert set(pq.read_table(out / "detections.parquet").column("object_id").drop_null().to_pylist()) == set(range(12))
    assert np.isclose(report["cameras"]["cam1"]["rate_hz"], 6.0, rtol=0.01)
