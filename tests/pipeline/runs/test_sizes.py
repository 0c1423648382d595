"""The size of a run is estimated before it begins: it is refused, or must be confirmed, if it is too large."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

import stereophd.pipeline.runs.sizes as sizes
from stereophd.commands.experiment import experiment
from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.errors import InputError, SizeError
from stereophd.pipeline.calibration.problem import size_of_calibration
from stereophd.pipeline.runs.sizes import Size, check_size, size_of_simulation

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "paper" / "multi_object.yaml"
EXPERIMENT = CONFIG.parent / "figure4.yaml"


def test_a_usual_scene_is_small() -> None:
    size = size_of_simulation(load_config(CONFIG))
    assert size.memory_bytes < 1e8
    # 100 frames of two cameras: 16 detections each, and six objects
    assert 2e4 < size.disk_bytes < 2e5


@pytest.mark.parametrize(
    ("setting", "runs", "message"),
    [
        ("cameras.left.detector.clutter_per_frame=1e6 simulate.duration_s=1000", None, "fits into the memory"),
        ("simulate.objects.count=1000000000", None, "fits into the memory"),
        ("simulate.objects.births_per_s=1e9", None, "fits into the memory"),
        ("simulate.duration_s=1e13", None, "fits on the disk"),
        ("simulate.frame_rate_hz=1e8", None, "fits into the memory|fits on the disk"),
        ("seed=1", 10**9, "fits into the memory|fits on the disk"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, setting: str, runs: int | None, message: str) -> None:
    with pytest.raises(InputError, match=f"simulate: expected a run that ({message})"):
        simulate(load_config(CONFIG, setting.split()), tmp_path / "out", runs=runs, force_size=True)
    assert not (tmp_path / "out").exists()


def test_an_experiment_of_too_many_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="experiment: "):
        experiment(load_config(EXPERIMENT, ["experiment.runs=1000000000"]), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("runs", "words"),
    [
        (None, "1 run of 5e+12 frames, 6 objects and 5e+13 f"),
        (3, "3 runs, each of 5e+12 frames, 6 objects and 5e+13 f"),
    ],
)
def test_the_message_counts_what_makes_a_run_large(tmp_path: Path, runs: int | None, words: str) -> None:
    config = load_config(CONFIG, ["simulate.duration_s=2.5e12"])
    with pytest.raises(InputError, match=re.escape(f"({words}alse detections)")):
        simulate(config, tmp_path / "out", runs=runs)


@pytest.mark.parametrize(("total", "free", "found"), [(100, 7, 7.0), (100, 0, 0.0), (0, 0, float("inf"))])
def test_a_file_system_without_a_size_is_not_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, total: int, free: int, found: float
) -> None:
    usage = SimpleNamespace(total=total, used=total - free, free=free)
    monkeypatch.setattr("shutil.disk_usage", lambda place: usage)
    assert sizes.free_disk(tmp_path / "new" / "folder") == found


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a file system that cannot be written")
def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot write /proc/none"):
        simulate(load_config(CONFIG), Path("/proc/none"))


def test_what_fills_much_of_a_disk_must_be_confirmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "available_memory", lambda: 1e9)
    monkeypatch.setattr(sizes, "free_disk", lambda folder: 1e12)
    large = Size(1e8, 6e10, "so many")
    with pytest.raises(SizeError, match=r"x: this takes about 60 GB on the disk \(so many\); use `force_size=True`"):
        check_size(large, "x", tmp_path, confirmed=False)
    check_size(large, "x", tmp_path, confirmed=True)
    check_size(Size(1e8, 1e9, ""), "x", tmp_path, confirmed=False)
    with pytest.raises(InputError, match=r"the memory \(1 GB available\), found one of about 2 GB"):
        check_size(Size(2e9, 0.0, ""), "x", tmp_path, confirmed=True)


@pytest.mark.parametrize("settings", [["calibration.method=sequential"], ["calibration.posterior=smc"]])
def test_the_memory_of_a_calibration_grows_with_its_hypotheses(settings: list[str]) -> None:
    method = "sequential" if settings[0].endswith("sequential") else "smc"
    bytes_needed = []
    for particles in (1000, 2000):
        changes = [*settings, f"calibration.{method}.particles={particles}", "calibration.sequential.moves=none"]
        section = load_config(CONFIG.parent / "calibration.yaml", changes).config.calibration
        assert section is not None
        bytes_needed.append(size_of_calibration(section, 200.0, 3200.0).memory_bytes)
    # 8 kB for each hypothesis and detection of a frame
    assert bytes_needed[1] - bytes_needed[0] == pytest.approx(1000 * 17.0 * 8e3)
