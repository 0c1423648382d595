"""``stereophd import`` as it is typed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from .conftest import Outcome

Call = Callable[..., Outcome]


def write_table(path: Path) -> Path:
    path.write_text("cam,n,x,y\nleft,0,10,20\nright,0,11,20\nleft,2,12,20\nright,1,13,20\n")
    return path


def write_calibration(path: Path) -> Path:
    camera = {
        "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
        "dist": [0.1],
        "rvec": [0, 0, 0],
        "image_size": [640, 480],
    }
    path.write_text(json.dumps({name: {**camera, "tvec": [x, 0, 0]} for name, x in (("left", 0), ("right", -1))}))
    return path


def test_a_table_and_a_calibration_become_a_log_and_cameras(call: Call, tmp_path: Path) -> None:
    table, calibration = write_table(tmp_path / "points.csv"), write_calibration(tmp_path / "calibration.json")
    words = ("--column", "frame=n", "--fps", "25", "--offset", "right=0.004", "--length-unit", "cm")
    done = call("import", "csv", table, "--cameras", calibration, "--out", tmp_path / "in", *words)
    assert done.code == 0, done.err
    assert "left: 2 detections in 3 frames (1 empty, 1 of them filled in), 0 to 0.08 s, 25 Hz, 640 x 480 px" in done.out
    assert sorted(path.name for path in (tmp_path / "in").iterdir()) == [
        "cameras.yaml",
        "detections.parquet",
        "report.json",
    ]
    again = call("import", "csv", table, "--cameras", calibration, "--out", tmp_path / "in", *words)
    assert again.code == 2
    assert "--force" in again.err
    forced = call(
        "import", "csv", table, "--cameras", calibration, "--out", tmp_path / "in", *words, "--force", "--json"
    )
    assert json.loads(forced.out)["cameras"]["right"]["detections"] == 2
    assert json.loads(forced.out)["length_unit"] == "cm"
    assert isinstance(json.loads(forced.out)["checks"], list)


def test_one_offset_is_that_of_all_cameras(call: Call, tmp_path: Path) -> None:
    table = write_table(tmp_path / "points.csv")
    words = ("--column", "frame=n", "--fps", "25", "--offset", "0.5", "--offset", "right=2", "--json")
    done = call("import", "csv", table, "--out", tmp_path / "in", *words)
    assert done.code == 0, done.err
    assert {name: row["first_s"] for name, row in json.loads(done.out)["cameras"].items()} == {"left": 0.5, "right": 2}


def test_only_a_rate_that_somebody_states_is_written(call: Call, tmp_path: Path) -> None:
    """A rate that follows from the times agrees with any times, so that no check would find them wrong."""
    table, calibration = write_table(tmp_path / "points.csv"), write_calibration(tmp_path / "calibration.json")
    for column, *words in (("time_s",), ("frame", "--fps", "1")):
        out, is_stated = tmp_path / column, bool(words)
        words += ["--column", f"{column}=n", "--out", out]
        done = call("import", "csv", table, "--cameras", calibration, *words)
        assert done.code == 0, done.err
        assert ("frame_rate_hz: 1.0" in (out / "cameras.yaml").read_text()) == is_stated
        # camera left has frames 0 and 2
        for name in ("left", "right"):
            assert (f"camera {name}: times are whole numbers of seconds" in done.err) != is_stated


@pytest.mark.parametrize(
    ("u", "v", "late", "cause"),
    [
        (300, 200, 0, None), (0.3, 0.2, 0, "pixels_normalised"), (300, 600, 0, "bad_rows"),
        (300, 200, 99, "clock_offset"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_named_once(call: Call, tmp_path: Path, u: float, v: float, late: int, cause: str) -> None:
    rows = [
        f"{c},{n},{u + n / 99},{v}" for c, first in (("left", 0), ("right", late)) for n in range(first, first + 30)
    ]
    (tmp_path / "points.csv").write_text("\n".join(["cam,frame,x,y", *rows]))
    calibration = write_calibration(tmp_path / "calibration.json")
    words = ("--cameras", calibration, "--fps", "25", "--out", tmp_path / "in", "--json")
    report = json.loads(call("import", "csv", tmp_path / "points.csv", *words).out)
    warned = [check for check in report["checks"] if check["status"] == "warning"]
    assert {check["cause"] for check in warned} == ({cause} if cause else set())
    assert len({check["camera"] for check in warned}) == len(warned)
    assert not report["warnings"]


def test_wrong_words_are_named(call: Call, tmp_path: Path) -> None:
    table = write_table(tmp_path / "points.csv")
    for words, part in (
        (("import", "cvs", table), "did you mean csv?"),
        (("import", "csv", tmp_path / "none.csv"), "there is no such file"),
        (("import", "csv", table, "--fps", "left=fast"), "--fps: expected [CAM=]VALUE, found left=fast"),
        (("import", "csv", table, "--column", "u_px=x", "--column", "u_px=y"), "each name once, found u_px=y"),
        (("import", "csv", table, "--image-size", "640"), "--image-size: expected [CAM=]VALUE"),
        (("import", "csv", table, "--time-unit", "h"), "--time-unit"),
    ):
        done = call(*words, "--out", tmp_path / "in")
        assert (done.code, done.out) == (2, "")
        assert part in done.sentence
    assert not (tmp_path / "in").exists()
