"""A control track of one object fixes scale, frame and clock of a calibration, with honest deviations."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from stereophd import Camera, InputError, Pose, make_config, read_cameras, write_log
from stereophd.commands.calibrate import _findings_of, calibrate
from stereophd.core.calibration.annealing.method import Remark
from stereophd.core.geometry.pose import rotation_from_vector, rotation_to_vector
from stereophd.io.cameras.writing import camera_config, plain_cameras
from stereophd.report.summaries import summary_text
from tests.scenes import build_camera

TURN, MOVE, SHIFT, RATE = rotation_from_vector([0.3, -1.2, 2.0]), np.array([100.0, -50.0, 20.0]), 47.3, 1.0005
SPAN, NOISE_PX, NOISE = 30.0, 0.5, 0.02


def wander(seed: int, times: np.ndarray) -> np.ndarray:
    """Return a curve of four random sines on each axis, 20 m before the cameras."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.02, 0.08, (4, 3)), rng.uniform(0.0, 6.28, (4, 3))
    size = rng.normal(0, 1.5, (4, 3))
    path = (size * np.sin(2.0 * np.pi * frequency * times[:, None, None] + phase)).sum(axis=1)
    return np.asarray(path + [0.0, 0.0, 20.0])


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    same = {"size": (1000, 800), "noise": NOISE_PX, "p_detect": 0.95, "clutter": 0.1, "frame_rate_hz": 3.0}
    left = build_camera("left", [-7, 0, 0], [0, -0.35, 0], **same)
    return [left, build_camera("right", [7, 0, 0], [0, 0.35, 0], **same, readout_s=0.013)]


@pytest.fixture(scope="module")
def log(cameras: list[Camera], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of two objects, and beside it a control track of the second."""
    rng, rows = np.random.default_rng(1), []
    for camera in cameras:
        for frame, time_s in enumerate(np.arange(camera.phase_s, SPAN, 1.0 / 3.0)):
            for seed in (101, 102):
                x, y, z = camera.pose.to_camera(wander(seed, np.array([time_s])))[0]
                pixel = 700.0 * np.array([x, y]) / z + [499.5, 399.5] + rng.normal(0.0, NOISE_PX, 2)
                rows.append((time_s, camera.name, frame, *pixel))
    folder = tmp_path_factory.mktemp("control")
    columns = ("time_s", "camera", "frame", "u_px", "v_px")
    write_log(folder / "log.parquet", dict(zip(columns, map(list, zip(*rows, strict=True)), strict=True)))
    at = np.arange(2.0, SPAN - 2.0, 0.2)
    places = wander(102, at) @ TURN.T + MOVE + rng.normal(0.0, NOISE, (len(at), 3))
    table = pa.table({"time_s": RATE * at + SHIFT, **dict(zip("xyz", places.T, strict=True))})
    pq.write_table(table, folder / "gps.parquet")
    return folder / "log.parquet"


def config(cameras: list[Camera], **calibration: object) -> dict:
    """Return a configuration whose second camera is a guess, 3 % too far away."""
    left, right = cameras
    pose = Pose(rotation_from_vector([0.02, -0.01, 0.01]) @ right.pose.rotation, right.pose.center + [0.4, 0.1, -0.2])
    guess = replace(right, pose=pose)
    return {
        "units": {"length": "m"},
        "cameras": plain_cameras({camera.name: camera_config(camera) for camera in (left, guess)}),
        "motion": {"acceleration_std": 0.5, "max_speed": 6},
        "moments": {"samples": 64},
        "filter": {"kind": "pmb", "birth": {"per_s": 0.05, "depth_range": [8, 40], "velocity_std": 1.0}},
        "calibration": {
            "reference": "left", "priors": {"right": {"center_std": 0.4, "rotation_std_deg": 2.0}},
            "annealed": {"starts": 1, "agreeing_starts": 1}, **calibration,
        },
    }  # fmt: skip


def read_camera_unit(path: Path) -> str:
    return str(yaml.safe_load(path.read_text())["units"]["length"])


def test_scale_frame_and_clock_are_those_of_the_control(cameras: list[Camera], log: Path, tmp_path: Path) -> None:
    control = str(log.with_name("gps.parquet"))
    report = calibrate(make_config(config(cameras, control=control)), log, tmp_path / "out", plots=False, jobs=1)
    found = report["control"]
    assert report["scale"]["determined_by"] == "data"
    assert 0.5 * NOISE < found["std"] < 2.0 * NOISE
    turn = rotation_from_vector(np.deg2rad(found["rotation_deg"]))
    assert np.linalg.norm(rotation_to_vector(turn @ TURN.T)) < 4.0 * np.deg2rad(np.max(found["rotation_std_deg"]))
    clock = found["clock"]
    late = clock["at_s"] + clock["shift_s"] - (RATE * clock["at_s"] + SHIFT)
    assert abs(late) < 4.0 * clock["shift_std_s"] < 0.02
    ends = [camera.pose.center for camera in read_cameras(tmp_path / "out" / "cameras.yaml")]
    distance, std = float(np.linalg.norm(ends[1] - ends[0])), report["cameras"]["right"]["scale_std"]
    assert abs(distance / 14.0 - 1.0) < 4.0 * std < 0.02
    tracks = pq.read_table(tmp_path / "out" / "tracks.parquet").to_pydict()
    places = np.column_stack([tracks[name] for name in "xyz"])
    truth = np.stack([wander(seed, (np.array(tracks["time_s"]) - SHIFT) / RATE) @ TURN.T + MOVE for seed in (101, 102)])
    assert np.median(np.linalg.norm(places - truth, axis=2).min(axis=0)) < 0.1


def test_cameras_without_a_length_have_the_unit_of_the_control(
    cameras: list[Camera], log: Path, tmp_path: Path
) -> None:
    """Tracks in metres were called ``baseline``, and their scale "from the first guess and the data"."""
    values = config(cameras, control=str(log.with_name("gps.parquet"))) | {"units": {"length": "baseline"}}
    report = calibrate(make_config(values), log, tmp_path / "out", plots=False, jobs=1)
    assert report["length_unit"] == report["control"]["length_unit"] == "m"
    assert read_camera_unit(tmp_path / "out" / "cameras.yaml") == "m"
    metadata = pq.read_schema(tmp_path / "out" / "tracks.parquet").metadata
    assert metadata[b"length_unit"] == b"m"
    # their configuration is that with which they were made, so that its lengths have this unit too
    made_with, stated = json.loads(metadata[b"stereophd"])["config"], report["provenance"]["config"]
    assert (made_with["units"]["length"], stated["units"]["length"]) == ("m", "baseline")
    assert made_with["motion"]["acceleration_std"] != stated["motion"]["acceleration_std"]
    assert "scale from the control" in summary_text(report)
    assert re.search(r"left .* \+47\.\d{4} s, \+\d+ ppm\n", summary_text(report))  # its clock is that of the control
    assert {one["unit"] for one in report["parameters"] if "center" in one["name"]} == {"baseline"}


def test_accelerations_are_stated_in_the_unit_of_the_calibration() -> None:
    """That of a control, which is another length, was named beside a number of baselines."""
    report = {"status": "determined", "length_unit": "m", "provenance": {"units": {"length": "baseline"}}}
    (found,) = _findings_of(report, (Remark("motion", "the objects accelerate by 0.3 length/s^2"),))
    assert found["message"] == "the objects accelerate by 0.3 baseline/s^2"


def test_points_fix_scale_and_frame(cameras: list[Camera], log: Path, tmp_path: Path) -> None:
    rng, rows = np.random.default_rng(3), []
    places = np.column_stack([rng.uniform(-6, 6, 8), rng.uniform(2, 4, 8), rng.uniform(12, 24, 8)])
    for camera in cameras:
        for place, pixel in zip(places, camera.project(places) + rng.normal(0, 0.3, (8, 2)), strict=True):
            rows.append((camera.name, *pixel, *(TURN @ place + MOVE), 0.3))
    names = ("camera", "u_px", "v_px", "x", "y", "z", "sigma_px")
    pq.write_table(
        pa.table(dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))), tmp_path / "court.parquet"
    )
    given = config(cameras, control={"points": str(tmp_path / "court.parquet")})
    report = calibrate(make_config(given), log, tmp_path / "out", plots=False, jobs=1)
    assert report["control"]["residual_px"]["median"] < 1.0
    for camera, again in zip(cameras, read_cameras(tmp_path / "out" / "cameras.yaml"), strict=True):
        turn = again.pose.rotation @ (camera.pose.rotation @ TURN.T).T
        assert np.linalg.norm(rotation_to_vector(turn)) < 5e-3
        assert np.linalg.norm(again.pose.center - (TURN @ camera.pose.center + MOVE)) < 0.1


@pytest.mark.parametrize(
    ("control", "changes", "message"),
    [
        ("none.parquet", {}, "none.parquet: there is no such file"),
        ("log.parquet", {}, "missing columns? x, y, z"),
        ("gps.parquet", {"posterior": "smc"}, "expected method annealed and posterior laplace"),
    ],
)
def test_unusable_controls_are_refused(
    cameras: list[Camera], log: Path, tmp_path: Path, control: str, changes: dict, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        calibrate(make_config(config(cameras, control={"track": str(log.with_name(control))}, **changes)), log,
                  tmp_path / "out")  # fmt: skip


def test_a_control_that_fits_nothing_is_not_used_and_said(cameras: list[Camera], log: Path, tmp_path: Path) -> None:
    times = np.arange(0.0, SPAN, 0.2)
    path = tmp_path / "other.parquet"
    pq.write_table(
        pa.table({"time_s": times, **dict(zip("xyz", np.outer(times, [1.0, 0.0, 0.0]).T, strict=True))}), path
    )
    report = calibrate(make_config(config(cameras, control=str(path))), log, tmp_path / "out", plots=False, jobs=1)
    assert report["status"] == "partly determined"
    assert "the control was not used" in report["reason"]
    assert "control" not in report
