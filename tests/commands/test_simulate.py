"""`simulate` writes logs, truths and cameras in the native layout, the same for the same seed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from stereophd.commands.simulate import CAMERAS_FILE, DETECTIONS_FILE, TRUTH_FILE, simulate
from stereophd.config.loading import LoadedConfig, load_cameras, load_config
from stereophd.errors import InputError
from stereophd.io.logs.reading import LogReader
from stereophd.io.outputs.provenance import from_metadata

SCENARIO = """
units: {length: cm}
seed: 11
cameras:
  left:
    image_size_px: [640, 480]
    intrinsics: {fx: 500.0, fy: 510.0, cx: 319.5, cy: 239.5}
    pose: {center: [-10.0, 0.0, 0.0], rotation_vector_deg: [0.0, -3.0, 0.5]}
    detector: {sigma_px: [1.0, 1.5], p_detect: 0.9, clutter_per_frame: 1.5}
    distortion: {model: radial, k1: -0.05}
    frame_rate_hz: 12.5
  right:
    image_size_px: [800, 600]
    intrinsics: {fx: 600.0, fy: 600.0, cx: 400.0, cy: 300.0}
    pose: {center: [10.0, 0.0, 0.0], velocity: [0.1, 0.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.5, clutter_per_frame: 0.2}
    phase_s: 0.03
    clock: {offset_s: 7.25, rate: 1.0001}
simulate:
  duration_s: 6.0
  start_s: 100.0
  frame_rate_hz: 8.0
  object_id: true
  acceleration_std: [0.5, 0.0, 0.2]
  given:
  - {position: [0.0, 1.0, 100.0], velocity: [1.0, 0.0, 0.0]}
  - {position: [5.0, -2.0, 90.0], birth_s: 102.0, death_s: 104.0}
  objects:
    count: 2
    box: {x: [-20, 20], y: [-20, 20], z: [80, 120]}
    velocity_std: 1.0
    births_per_s: 0.5
    mean_lifetime_s: 3.0
"""


@pytest.fixture
def scenario(tmp_path: Path) -> LoadedConfig:
    path = tmp_path / "scenario.yaml"
    path.write_text(SCENARIO)
    return load_config(path)


FILES = (CAMERAS_FILE, DETECTIONS_FILE, TRUTH_FILE)


def variant(scenario: LoadedConfig, *overrides: str, seed: int | None = None) -> LoadedConfig:
    return load_config(scenario.path, overrides, seed)


def digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def columns(path: Path) -> dict[str, np.ndarray]:
    table = pq.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def test_the_log_can_be_read_with_its_cameras(scenario: LoadedConfig, tmp_path: Path) -> None:
    summary = simulate(scenario, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(FILES)
    loaded = load_config(scenario.path, cameras_path=tmp_path / "out" / "cameras.yaml")
    cameras = loaded.build_cameras()
    reader = LogReader(tmp_path / "out" / "detections.parquet", cameras)  # a bad row would be an error
    frames = list(reader)
    assert len(frames) == summary["frames"] == 75 + 48
    detections = sum(len(frame.pixels) for frame in frames)
    clutter = sum(int((frame.object_id == -1).sum()) for frame in frames if frame.object_id is not None)
    assert (detections, clutter) == (summary["detections"], summary["clutter"])
    assert any(len(frame.pixels) == 0 for frame in frames)
    times = np.array([frame.time_s for frame in frames])
    assert (np.diff(times) >= 0).all()
    right = np.array([frame.time_s for frame in frames if frame.camera == 1])
    np.testing.assert_allclose(right, 100.03 + np.arange(48) / 8, atol=1e-7)  # the clock taken out again


def test_cameras_come_back_to_the_last_bit(scenario: LoadedConfig, tmp_path: Path) -> None:
    simulate(scenario, tmp_path / "out")
    written = load_cameras(tmp_path / "out" / "cameras.yaml")
    assert written.units.length == "cm"
    assert list(written.cameras) == ["left", "right"]
    assert written.cameras["left"] == scenario.cameras["left"]
    assert written.cameras["right"].frame_rate_hz == 8.0  # the scenario's, for a camera that states none
    assert written.cameras["right"] == scenario.cameras["right"].model_copy(update={"frame_rate_hz": 8.0})


def test_truth_has_position_and_velocity_of_living_objects(scenario: LoadedConfig, tmp_path: Path) -> None:
    summary = simulate(scenario, tmp_path / "out")
    truth = columns(tmp_path / "out" / "truth.parquet")
    assert list(truth) == ["time_s", "object_id", "x", "y", "z", "vx", "vy", "vz"]
    assert len(np.unique(truth["object_id"])) <= summary["objects"]
    keys = list(zip(truth["time_s"], truth["object_id"], strict=True))
    assert keys == sorted(set(keys))
    second = truth["object_id"] == 1
    assert truth["time_s"][second].min() >= 102.0
    assert truth["time_s"][second].max() <= 104.0
    first = truth["object_id"] == 0
    assert truth["time_s"][first].size == 123 - np.intersect1d(np.arange(75) / 12.5, 0.03 + np.arange(48) / 8).size
    assert not np.ptp(truth["vy"][first])  # no acceleration along y
    assert np.ptp(truth["vx"][first]) > 0.1


def test_truth_rate(scenario: LoadedConfig, tmp_path: Path) -> None:
    simulate(variant(scenario, "simulate.truth_rate_hz=2.0"), tmp_path / "out")
    times = np.unique(columns(tmp_path / "out" / "truth.parquet")["time_s"])
    np.testing.assert_allclose(times, 100.0 + np.arange(12) / 2)


def test_object_id_only_on_request(scenario: LoadedConfig, tmp_path: Path) -> None:
    simulate(scenario, tmp_path / "with")
    simulate(variant(scenario, "simulate.object_id=false"), tmp_path / "without")
    with_labels = columns(tmp_path / "with" / "detections.parquet")
    labels = with_labels.pop("object_id")
    without = columns(tmp_path / "without" / "detections.parquet")
    assert list(without) == list(with_labels)
    for name, values in without.items():
        np.testing.assert_array_equal(values, with_labels[name])
    assert (np.isnan(labels.astype(float)) == np.isnan(without["u_px"])).all()


def test_same_seed_same_bytes_other_seed_other_scene(scenario: LoadedConfig, tmp_path: Path) -> None:
    simulate(scenario, tmp_path / "a")
    simulate(scenario, tmp_path / "b")
    simulate(variant(scenario, seed=12), tmp_path / "c")
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    here, there = (columns(tmp_path / name / "detections.parquet") for name in ("a", "c"))
    assert np.intersect1d(here["u_px"], there["u_px"]).size == 0


def test_runs_depend_neither_on_their_number_nor_on_the_workers(scenario: LoadedConfig, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    summary = simulate(scenario, tmp_path / "two", runs=2, progress=lambda done, total: calls.append((done, total)))
    simulate(scenario, tmp_path / "three", runs=3, jobs=2)
    simulate(scenario, tmp_path / "plain")
    two, three, plain = (digests(tmp_path / name) for name in ("two", "three", "plain"))
    assert sorted(two) == sorted(f"run-{run:04d}/{name}" for run in (0, 1) for name in FILES)
    assert {name: three[name] for name in two} == two
    assert {name: two[f"run-0000/{name}"] for name in FILES} == plain
    assert two["run-0000/detections.parquet"] != two["run-0001/detections.parquet"]
    assert summary["runs"] == 2
    assert calls == [(1, 2), (2, 2)]


def test_provenance_names_config_seed_and_unit(scenario: LoadedConfig, tmp_path: Path) -> None:
    simulate(variant(scenario, seed=5), tmp_path / "out")
    for name in ("detections.parquet", "truth.parquet"):
        metadata = pq.read_schema(tmp_path / "out" / name).metadata
        record = from_metadata(metadata)
        assert record is not None
        assert (record["command"], record["seed"], record["run"]) == ("simulate", 5, 0)
        assert metadata[b"length_unit"] == b"cm"
        assert str(tmp_path) not in json.dumps(record)
    assert "seed 5" in (tmp_path / "out" / "cameras.yaml").read_text()


def test_progress_counts_frames(scenario: LoadedConfig, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    summary = simulate(scenario, tmp_path / "out", progress=lambda done, total: calls.append((done, total)))
    assert calls[-1] == (summary["frames"], summary["frames"])


def test_nothing_is_left_when_no_object_fits(scenario: LoadedConfig, tmp_path: Path) -> None:
    behind = variant(scenario, "simulate.objects.box.z=[-9, -5]")
    with pytest.raises(InputError, match=r"simulate\.objects: expected a box"):
        simulate(behind, tmp_path / "out")
    with pytest.raises(InputError, match=r"simulate\.objects: expected a box"):
        simulate(behind, tmp_path / "runs", runs=2, jobs=1)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("overrides", "options", "message"),
    [
        (["simulate=null"], {}, "expected a section `simulate`, found none"),
        (["cameras=null"], {}, "expected cameras"),
        (
            ["simulate.given=[{position: [0, 0, 9], birth_s: 3, death_s: 2}]"],
            {},
            "expected birth_s <= death_s",
        ),
        ([], {"runs": 0}, "expected at least 1, found 0"),
        ([], {"runs": 2, "jobs": 0}, "found 0"),
    ],
)
def test_bad_scenarios(
    scenario: LoadedConfig, tmp_path: Path, overrides: list[str], options: dict[str, int], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        simulate(variant(scenario, *overrides), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_an_output_folder_is_replaced_only_with_force(scenario: LoadedConfig, tmp_path: Path) -> None:
    simulate(scenario, tmp_path / "out", runs=3)
    with pytest.raises(InputError, match="`force=True`"):
        simulate(scenario, tmp_path / "out", runs=2)
    simulate(scenario, tmp_path / "out", runs=2, force=True)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["run-0000", "run-0001"]
    with pytest.raises(InputError, match="which this command does not write"):
        simulate(scenario, tmp_path / "out", force=True)


def test_the_sample_data_are_what_their_config_makes(tmp_path: Path) -> None:
    folder = Path(__file__).resolve().parents[2] / "sample_data"
    simulate(load_config(folder / "hall.yaml"), tmp_path / "hall")
    assert load_cameras(tmp_path / "hall" / "cameras.yaml") == load_cameras(folder / "hall" / "cameras.yaml")
    for name in ("detections.parquet", "truth.parquet"):
        made, kept = columns(tmp_path / "hall" / name), columns(folder / "hall" / name)
        assert list(made) == list(kept)
        for column, values in made.items():
            if values.dtype.kind == "f":
                # Other versions of NumPy may round differently; the scene is the same.
                np.testing.assert_allclose(kept[column], values, rtol=1e-9, atol=1e-9)
            else:
                np.testing.assert_array_equal(kept[column], values)
