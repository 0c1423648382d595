"""Logs whose numbers no recording has: `track` ends soon, with its files or with one clear sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from .conftest import CONFIG, Outcome, write_config

Call = Callable[..., Outcome]

TIMES = np.arange(6) * 0.1


def write(path: Path, times: Sequence[float], cameras: Sequence[str] = ("left", "right"), sigma: float = 1.0) -> Path:
    """Write a log of two detections a frame, one row of which has this sigma."""
    keys = [(time_s, camera, frame) for frame, time_s in enumerate(times) for camera in cameras for _ in range(2)]
    pixels = np.random.default_rng(1).uniform(0, 479, (len(keys), 2))
    sigmas = np.where(np.arange(len(keys)) == len(keys) // 2, sigma, 1.0)
    columns: dict[str, Any] = {
        "time_s": [key[0] for key in keys],
        "camera": [key[1] for key in keys],
        "frame": [key[2] for key in keys],
        "u_px": pixels[:, 0],
        "v_px": pixels[:, 1],
        "sigma_u_px": sigmas,
        "sigma_v_px": sigmas,
    }
    pq.write_table(pa.table(columns), path)
    return path


@pytest.mark.parametrize(
    ("times", "sigma", "expected"),
    [
        pytest.param(TIMES, 1e200, "sigma_u_px, sigma_v_px: expected numbers from 1e-06 to 1e+06", id="sigma-huge"),
        pytest.param(TIMES, 1e-300, "sigma_u_px, sigma_v_px: expected numbers from 1e-06 to 1e+06", id="sigma-tiny"),
        pytest.param(TIMES, 0.0, "row 12: sigma_u_px, sigma_v_px: expected numbers", id="sigma-zero"),
        pytest.param([-1.7e308, 0.0, 1.7e308], 1.0, "row 0: time_s: expected a number between", id="times-huge"),
        pytest.param([1e308, np.nextafter(1e308, np.inf)], 1.0, "time_out_of_range 8", id="times-close"),
        pytest.param(np.concatenate([TIMES, 1e9 + TIMES]), 1.0, "", id="gap"),
        pytest.param(np.concatenate([[-1e13], TIMES, [1e13]]), 1.0, "", id="largest-gap"),
        pytest.param(np.arange(60) * 1e-4, 1.0, "", id="10-kHz"),
        pytest.param(np.arange(60) * 1e-9, 1.0, "", id="1-GHz"),
    ],
)
def test_odd_numbers(
    call: Call, config: Path, tmp_path: Path, times: Sequence[float], sigma: float, expected: str
) -> None:
    log = write(tmp_path / "log.parquet", times, sigma=sigma)
    outcome = call("track", config, log, "--out", tmp_path / "out", "-q")
    assert "Traceback" not in outcome.err
    if expected:
        assert outcome.code == 2
        assert expected in outcome.sentence
        assert not (tmp_path / "out").exists()
    else:
        assert outcome.code == 0, outcome.err
        tracks = pq.read_table(tmp_path / "out" / "tracks.parquet")
        assert all(np.isfinite(tracks[name]).all() for name in ("x", "vx", "existence"))


@pytest.mark.usefixtures("without_checks")
def test_fifty_cameras(call: Call, tmp_path: Path) -> None:
    cameras = {f"c{k}": {**CONFIG["cameras"]["left"], "pose": {"center": [k - 25.0, 0.0, 0.0]}} for k in range(50)}
    config = write_config(tmp_path / "config.yaml", cameras=cameras)
    log = write(tmp_path / "log.parquet", TIMES[:2], tuple(cameras))
    assert call("track", config, log, "--out", tmp_path / "out", "-q").code == 0
    assert pq.read_table(tmp_path / "out" / "scans.parquet").num_rows == 100


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        pytest.param(
            ["--set", "filter.survival_per_s=0.5", "--set", "report.times=grid 0.1"], "no object is left at", id="grid"
        ),
        pytest.param(
            ["--set", "report.times=grid 0.1", "--set", "filter.survival_per_s=1.0"],
            "report.times: grid 0.1 s: expected at most 1000000 times between two events, found 1e+10 from 2 s",
            id="grid-and-no-death",
        ),
        pytest.param(["--pieces", "2", "--overlap", "1"], "", id="pieces"),
    ],
)
def test_a_pause_of_years(call: Call, config: Path, tmp_path: Path, words: Sequence[str], expected: str) -> None:
    """Its empty times of a grid are left out with a warning; what takes a row at each is an error."""
    assert call("simulate", config, "--out", tmp_path / "scene", "--set", "simulate.duration_s=3", "-q").code == 0
    table = pq.read_table(tmp_path / "scene" / "detections.parquet")
    later = table.set_column(0, "time_s", pa.array(table["time_s"].to_numpy() + 1e9))
    log = tmp_path / "log.parquet"
    frames = later["frame"].to_numpy() + int(np.max(table["frame"].to_numpy())) + 1
    later = later.set_column(later.column_names.index("frame"), "frame", pa.array(frames, pa.int64()))
    pq.write_table(pa.concat_tables([table, later.cast(table.schema)]), log)
    outcome = call("track", config, log, "--out", tmp_path / "out", *words)
    assert "Traceback" not in outcome.err
    assert expected in " ".join(outcome.err.split())
    if words[0] == "--pieces":
        assert outcome.code == 0  # pieces follow the frames: there is none in the pause
        times = pq.read_table(tmp_path / "out" / "tracks.parquet")["time_s"].to_numpy()
        assert set(np.floor(times / 1e9)) == {0.0, 1.0}
    elif words[-1] == "report.times=grid 0.1":
        assert outcome.code == 0
        assert pq.read_table(tmp_path / "out" / "scans.parquet").num_rows < 50_000
    else:
        assert outcome.code == 2
        assert not (tmp_path / "out").exists()
