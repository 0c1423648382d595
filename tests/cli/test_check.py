"""``stereophd check`` on the command line."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.io.logs.rows import LogWriter
from tests.cli.conftest import Outcome


def _normalised_log(path: Path) -> Path:
    random = np.random.default_rng(1)
    with LogWriter(path) as writer:
        for frame in range(20):
            for camera in ("left", "right"):
                writer.write(float(frame), camera, frame, random.uniform(0, 1, (4, 2)))
    return path


def test_findings_are_printed_with_their_remedy(call: Callable[..., Outcome], config: Path, tmp_path: Path) -> None:
    log = _normalised_log(tmp_path / "log.parquet")
    found = call("check", config, log)
    assert found.code == 0
    assert "WARNING" in found.out
    assert "remedy: multiply u by the width" in found.out


@pytest.mark.parametrize("words", [["check"], ["check", "-q"], ["check", "--json"], ["track", "-q", "--out", "out"]])
def test_strict_says_what_warns(
    call: Callable[..., Outcome], config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    found = call(words[0], config, _normalised_log(tmp_path / "log.parquet"), "--strict", *words[1:])
    assert found.code == 1
    *_, line = found.err.splitlines()
    assert re.fullmatch(r"error: \d+ checks warn: log\.\w+: .*\(--strict\)", line)
    assert "--json" not in words or json.loads(found.out)["warnings"] == 2


def test_the_command_is_printed_with_what_mends_it(call: Callable[..., Outcome], config: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.parquet"
    with LogWriter(log) as writer:
        for frame in range(100):
            for camera, x, late_s in (("left", -5.0, 0.0), ("right", 5.0, 0.7)):
                phase = np.array([0.0, 1.0, 2.5, 4.0]) + 0.05 * frame * np.array([1.0, 1.3, 0.7, 1.6])
                point = np.stack([20.0 * np.sin(phase), 15.0 * np.cos(1.7 * phase), 110.0 + 20.0 * np.cos(phase)])
                pixels = np.array([[320.0], [240.0]]) + 500.0 * (point[:2] - [[x], [0.0]]) / point[2]
                writer.write(frame / 25.0 + late_s, camera, frame, pixels.T)
    found = call("check", config, log, "--seed", "3")
    *_, title, command = found.out.splitlines()
    assert title == "The same with these remedies:"
    words = shlex.split(command)
    assert words[:6] == ["stereophd", "check", str(config), str(log), "--seed", "3"]
    assert words[6] == "--set"
    assert "clock.offset_s=" in command
    assert call(*words[1:]).code == 0
    # 3 ms beyond the right offset: of the same camera the distances of rays show what is left
    again = call(*words[1:6], "--set", "cameras.left.clock.offset_s=0.703")
    assert again.code == 0
    *_, command = again.out.splitlines()
    (offset,) = re.findall(r"left.clock.offset_s=(\S+)", command)  # in place of the first one
    assert float(offset) == pytest.approx(0.7, abs=5e-4)
    last = call("check", config, log, "--set", f"cameras.left.clock.offset_s={offset}")
    assert "its clock seems to be off" not in last.out


def test_json(call: Callable[..., Outcome], config: Path, tmp_path: Path) -> None:
    found = call("check", config, _normalised_log(tmp_path / "log.parquet"), "--json")
    report = json.loads(found.out)
    assert report["warnings"] == 2
    causes = {one["camera"]: one["cause"] for one in report["checks"] if one["status"] == "warning"}
    assert causes == {"left": "pixels_normalised", "right": "pixels_normalised"}
    assert set(report["checks"][0]) >= {"name", "status", "value", "expected", "camera", "message", "remedy"}


def test_a_log_that_is_missing(call: Callable[..., Outcome], config: Path, tmp_path: Path) -> None:
    found = call("check", config, tmp_path / "nothing.parquet")
    assert found.code == 2
    assert "nothing.parquet" in found.sentence


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [
        ("time_backwards", "sort the rows by time_s"),
        ("outside_image", "check image_size_px and the order of u and v"),
    ],
)
def test_check_counts_what_track_refuses(
    kind: str, remedy: str, call: Callable[..., Outcome], config: Path, tmp_path: Path
) -> None:
    """Rows in random order, and detections far outside the image."""
    random, log = np.random.default_rng(1), tmp_path / "log.parquet"
    order = random.permutation(40) if kind == "time_backwards" else np.arange(40)
    away = 5000.0 if kind == "outside_image" else 0.0
    times = np.repeat(order / 10.0, 3)
    columns = {"time_s": times, "camera": ["left"] * 120, "frame": np.repeat(order, 3)}
    columns |= {"u_px": random.uniform(0, 100, 120) + away, "v_px": random.uniform(0, 100, 120)}
    pq.write_table(pa.table(columns), log)
    found = json.loads(call("check", config, log, "--json").out)["checks"][0]
    assert (found["name"], kind in found["message"]) == ("input.rows", True)
    assert found["remedy"] == f"{remedy}, or drop them (input.on_bad_row: drop)"
    refused = call("track", config, log, "--out", tmp_path / "out")
    assert refused.code == 2
    assert f"({remedy}, or input.on_bad_row: drop" in refused.sentence


def test_detections_outside_the_image_are_counted_among_those_looked_at(
    call: Callable[..., Outcome], config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are read in groups, beyond the frames that are looked at."""
    monkeypatch.setattr("stereophd.pipeline.checks.log.sample.MOST_FRAMES", 10)
    log = tmp_path / "log.parquet"
    with LogWriter(log) as writer:
        for frame in range(40):
            writer.write(float(frame), "left", frame, np.array([[5000.0, 10.0], [10.0, 10.0]]))
    found = json.loads(call("check", config, log, "--json").out)["checks"][0]
    assert found["message"].startswith(f"{found['value']} of the {2 * found['value']} rows looked at are bad")
    assert 0 < found["value"] < 40


def test_rows_that_a_run_refuses_are_a_warning(call: Callable[..., Outcome], config: Path, tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    log = tmp_path / "log.parquet"
    with LogWriter(log) as writer:
        for frame in range(20):
            for camera in ("left", "middle", "right"):
                writer.write(float(frame), camera, frame, random.uniform(0, 100, (4, 2)))
    found = json.loads(call("check", config, log, "--json").out)["checks"][0]
    assert (found["name"], found["status"], found["value"], found["cause"]) == ("input.rows", "warning", 80, "bad_rows")
    assert found["message"].startswith("80 of the 240 rows looked at are bad (unknown_camera 80)")
    assert found["remedy"] == "add the camera to the cameras, or drop them (input.on_bad_row: drop)"
    refused = call("track", config, log, "--out", tmp_path / "out")
    assert refused.code == 2
    assert "found middle (add the camera to the cameras, or input.on_bad_row: drop" in refused.sentence
