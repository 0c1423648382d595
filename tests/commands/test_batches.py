"""`track` of several logs: a folder for each, faults that stop no other log, the same bytes from any workers."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from stereophd.commands import batches
from stereophd.commands.batches import evaluate_runs, track_logs
from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig, load_config
from stereophd.errors import InputError
from stereophd.pipeline.batch.names import expand, folder_names

SCENE = """
units: {length: cm}
seed: 5
cameras:
  left: &camera
    image_size_px: [640, 480]
    intrinsics: {fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0}
    pose: {center: [-5.0, 0.0, 0.0]}
    detector: {sigma_px: [1.0, 1.0], p_detect: 0.95, clutter_per_frame: 1.0}
  right:
    <<: *camera
    pose: {center: [5.0, 0.0, 0.0]}
motion: {acceleration_std: 0.1, max_speed: 5.0}
moments: {samples: 64}
filter: {kind: pmb, birth: {per_s: 0.1, depth_range: [50, 200], velocity_std: 1.0}}
simulate:
  duration_s: 4
  frame_rate_hz: 2
  given: [{position: [0, 0, 100]}]
"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> LoadedConfig:
    path = tmp_path_factory.mktemp("scene") / "scene.yaml"
    path.write_text(SCENE)
    return load_config(path)


@pytest.fixture(scope="module")
def scenes(loaded: LoadedConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs, the second of which is no log."""
    out = tmp_path_factory.mktemp("scenes") / "out"
    simulate(loaded, out, runs=3)
    for folder in out.glob("run-*"):
        (folder / "cameras.yaml").unlink(missing_ok=True)
    (sorted(out.glob("run-*"))[1] / "detections.parquet").write_bytes(b"nothing")
    return out


Batch = tuple[dict[str, Any], Path]


@pytest.fixture(scope="module")
def batch(loaded: LoadedConfig, scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Batch:
    """What `track` of all three returns, and its folder, which no test changes."""
    out = tmp_path_factory.mktemp("batch") / "all"
    return track_logs(loaded, [scenes / "run-*" / "detections.parquet"], out), out


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def summary(folder: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(folder / "summary.parquet").to_pylist()
    return rows


def test_a_faulty_log_is_a_row_and_the_others_are_those_of_single_runs(
    loaded: LoadedConfig, scenes: Path, batch: Batch, tmp_path: Path
) -> None:
    found, out = batch
    names = [folder.name for folder in sorted(scenes.glob("run-*"))]
    assert [row["folder"] for row in found["logs"]] == names
    assert [row["status"] for row in found["logs"]] == ["done", "failed", "done"]
    assert (found["done"], found["failed"], found["exit_code"]) == (2, 1, 2)
    assert summary(out) == found["logs"]
    assert "expected" in found["logs"][1]["message"]
    assert not (out / names[1]).exists()
    report = track(loaded, scenes / names[2] / "detections.parquet", tmp_path / "one")
    assert files(tmp_path / "one") == files(out / names[2])
    row = found["logs"][2]
    assert (row["frames"], row["tracks"]) == (report["input"]["frames"], len(report["tracks"]))
    assert row["duration_s"] == pytest.approx(3.5, abs=0.6)


def test_two_processes_give_the_bytes_of_one(
    loaded: LoadedConfig, scenes: Path, batch: Batch, tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    logs = sorted(scenes.glob("run-*/detections.parquet"))
    track_logs(loaded, logs, tmp_path / "two", jobs=2)
    assert files(tmp_path / "two") == files(batch[1])
    assert [text for text in caplog.messages if logs[1].parent.name in text]


def test_resume_does_what_is_missing_and_keeps_the_rest(
    loaded: LoadedConfig, scenes: Path, batch: Batch, tmp_path: Path
) -> None:
    logs, out = sorted(scenes.glob("run-*/detections.parquet")), tmp_path / "out"
    shutil.copytree(batch[1], out)
    whole = files(out)
    with pytest.raises(InputError, match="`resume=True`"):
        track_logs(loaded, logs, out)
    shutil.rmtree(out / logs[0].parent.name)
    (out / "summary.parquet").unlink()
    kept = out / logs[2].parent.name / "tracks.parquet"
    written = kept.stat().st_mtime_ns
    track_logs(loaded, logs, out, resume=True)
    assert files(out) == whole
    assert kept.stat().st_mtime_ns == written


@pytest.mark.usefixtures("without_checks")
def test_resume_refuses_the_results_of_another_seed(loaded: LoadedConfig, scenes: Path, tmp_path: Path) -> None:
    log = sorted(scenes.glob("run-*/detections.parquet"))[0]
    track(loaded, log, tmp_path / "out")
    other = load_config(loaded.path, [], 6, None)
    with pytest.raises(InputError, match="another configuration"):
        track(other, log, tmp_path / "out", resume=True)
    (tmp_path / "out" / "report.json").write_text("damaged")
    with pytest.raises(InputError, match="cannot be read"):
        track(other, log, tmp_path / "out", resume=True)
    assert track(other, log, tmp_path / "out", resume=True, force=True)["provenance"]["seed"] == 6


def test_a_foreign_file_in_the_output_folder_is_refused(loaded: LoadedConfig, scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        track_logs(loaded, [scenes / "run-*" / "detections.parquet"], tmp_path, force=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["a/x.parquet", "a/y.parquet"], ["x", "y"]),
        (["a/detections.parquet", "b/detections.parquet"], ["a", "b"]),
        (["a/x.parquet", "b/x.parquet", "c.parquet"], ["a-x", "b-x", "c"]),
        (["1/a/detections.parquet", "2/a/detections.parquet"], ["1-a", "2-a"]),
        (["x/a.parquet", "A.parquet"], ["x-a", "top-A"]),
    ],
)
def test_folder_names(paths: list[str], names: list[str]) -> None:
    assert folder_names([Path("/top") / path for path in paths]) == names


def test_a_log_given_twice_is_refused() -> None:
    with pytest.raises(InputError, match="found it 2 times"):
        folder_names([Path("a.parquet"), Path("./a.parquet")])


def test_a_pattern_without_files_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        expand([tmp_path / "*.parquet"])


@pytest.mark.usefixtures("without_checks")
def test_the_command_line_ends_with_2_and_prints_a_table(
    scenes: Path, loaded: LoadedConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str], run_cli: Callable[..., int]
) -> None:
    words = ["track", loaded.path, *sorted(scenes.glob("run-*/detections.parquet")), "--out", tmp_path / "out"]
    assert run_cli(*words) == 2
    printed = capsys.readouterr().out
    assert "2 done, 1 failed" in printed
    assert "log_likelihood" in printed


def test_evaluate_scores_runs_by_name(scenes: Path, batch: Batch, tmp_path: Path) -> None:
    names = [folder.name for folder in sorted(scenes.glob("run-*"))]
    found = evaluate_runs(batch[1], scenes, tmp_path / "scores", plots=False)
    assert [(row["folder"], row["status"]) for row in found["logs"]] == [(names[0], "done"), (names[2], "done")]
    one = evaluate(batch[1] / names[0] / "tracks.parquet", scenes / names[0] / "truth.parquet")
    assert found["logs"][0]["ospa"] == one["ospa"]["mean"]
    assert summary(tmp_path / "scores") == found["logs"]


def test_evaluate_of_runs_tells_a_gate_from_a_fault(scenes: Path, batch: Batch, tmp_path: Path) -> None:
    logs = [path for path in sorted(scenes.glob("run-*/detections.parquet")) if path.stat().st_size > 10]
    limit = {"ospa.mean": 1e-9}
    for log in logs:
        shutil.copytree(log.parent, tmp_path / "both" / log.parent.name)
    both = tmp_path / "both"
    found = evaluate_runs(batch[1], both, tmp_path / "scores", plots=False, fail_above=limit)
    assert [row["status"] for row in found["logs"]] == ["gate failed", "gate failed"]
    assert found["exit_code"] == 1
    assert found["logs"][0]["ospa"] > 0.0
    assert [gate["passed"] for row in found["logs"] for gate in row["gates"]] == [False, False]
    (tmp_path / "truths").mkdir()
    shutil.copy(scenes / logs[0].parent.name / "truth.parquet", tmp_path / "truths" / f"{logs[0].parent.name}.parquet")
    found = evaluate_runs(batch[1], tmp_path / "truths", tmp_path / "scores", plots=False, force=True)
    assert [row["status"] for row in found["logs"]] == ["done", "failed"]
    assert found["exit_code"] == 2
    name = logs[1].parent.name
    assert f"{name}/truth.parquet: there is no such file, and no {name}.parquet" in found["logs"][1]["message"]


@pytest.mark.parametrize("words", [[], ["-q"], ["--json"]])
def test_gates_of_runs_are_errors_on_stderr(
    scenes: Path, batch: Batch, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    run_cli: Callable[..., int], words: list[str],
) -> None:  # fmt: skip
    logs = [path for path in sorted(scenes.glob("run-*/detections.parquet")) if path.stat().st_size > 10]
    shutil.copytree(batch[1], tmp_path / "tracks")
    (scenes / "notes.parquet").write_bytes((tmp_path / "tracks" / "summary.parquet").read_bytes())  # no truth
    out = tmp_path / "scores"
    evaluation = ["evaluate", tmp_path / "tracks", scenes, "--out", out, "--no-plots", *words]
    shutil.copytree(tmp_path / "tracks" / logs[1].parent.name, tmp_path / "tracks" / "run-0001")
    assert run_cli(*evaluation, "--fail-above", "ospa.mean=1e-9") == 1
    printed = capsys.readouterr()
    lines = [line for line in printed.err.splitlines() if not line.startswith("WARNING: ")]
    assert [line.split(": ")[:2] for line in lines] == [["error", f"run-000{number}"] for number in range(3)]
    assert all("above the limit 1e-09" in line for line in lines)
    if words == ["--json"]:
        rows = json.loads(printed.out)["logs"]
        assert [row["gates"][0]["passed"] for row in rows] == [False, False, False]
    else:
        assert printed.out.endswith("" if words else "3 done, 0 failed, 3 gates failed\n")
        assert "above" not in printed.out


def test_a_truth_without_tracks_is_named_and_fails_under_a_gate(
    scenes: Path, batch: Batch, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    run_cli: Callable[..., int],
) -> None:  # fmt: skip
    capsys.readouterr()
    evaluation = ["evaluate", batch[1], scenes, "--out", tmp_path / "scores", "--no-plots"]
    assert run_cli(*evaluation) == 0
    assert capsys.readouterr().err == f"WARNING: {scenes}: 1 truth without tracks: run-0001\n"
    assert run_cli(*evaluation, "--force", "--fail-above", "ospa.mean=9") == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("error: run-0001: ")
    assert "tracks.parquet: there is no such file" in printed.err
    assert "2 done, 1 failed\n" in printed.out


def test_calibrate_of_logs_has_a_folder_and_a_row_for_each(
    loaded: LoadedConfig, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def calibrate(loaded: LoadedConfig, log: Path, out: Path, **words: Any) -> dict[str, Any]:
        if log.stat().st_size < 10:
            raise InputError(f"{log}: no log")
        out.mkdir(parents=True)
        cameras = {"a": {"rotation_std_deg": 0.5, "center_std": 2.0}}
        checks = [{"status": "warning"}, {"status": "ok"}]
        report = {"status": "determined", "length_unit": "m", "cameras": cameras, "checks": checks}
        report["input"] = {"frames": 8}
        (out / "report.json").write_text("{}")
        return report

    monkeypatch.setattr(batches, "calibrate", calibrate)
    found = batches.calibrate_logs(loaded, [scenes / "run-*" / "detections.parquet"], tmp_path / "out", jobs=1)
    assert [row["calibration"] for row in summary(tmp_path / "out")] == ["determined", "", "determined"]
    assert [row["warnings"] for row in summary(tmp_path / "out")] == [1, None, 1]
    assert (found["logs"][0]["rotation_std_deg"], found["logs"][0]["length_unit"]) == (0.5, "m")
    assert found["exit_code"] == 2


@pytest.fixture
def run_cli() -> Callable[..., int]:
    from stereophd.cli.app import run

    return lambda *words: run([str(word) for word in words])


@pytest.mark.usefixtures("without_checks")
@pytest.mark.parametrize("folder", ["run-0000", "run-0001"])
def test_a_batch_continues_over_a_folder_that_a_killed_run_only_made(
    loaded: LoadedConfig, scenes: Path, tmp_path: Path, folder: str
) -> None:
    logs = [scenes / name / "detections.parquet" for name in ("run-0000", "run-0002")]
    track_logs(loaded, logs, tmp_path / "whole")
    (tmp_path / "out" / folder).mkdir(parents=True)
    track_logs(loaded, logs, tmp_path / "out", resume=True)
    for name in ("run-0000/tracks.parquet", "run-0002/report.json", "summary.parquet"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.usefixtures("without_checks")
def test_an_empty_folder_of_the_user_is_no_run(
    loaded: LoadedConfig, scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    photos = tmp_path / "out" / "photos"
    photos.mkdir(parents=True)
    logs = [scenes / name / "detections.parquet" for name in ("run-0000", "run-0002")]
    track_logs(loaded, logs, tmp_path / "out")
    assert photos.is_dir()
    assert "photos" not in caplog.text
