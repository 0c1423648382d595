"""No damaged file ends a command with an internal error: logs, camera files, configurations with bytes changed."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as csv
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereophd.commands.track import track
from stereophd.config.loading import load_config

from .commands import budget, outcome

NUMBERS = st.sampled_from([0.0, -0.0, 1e-300, 1e200, 1.7e308, -1.7e308, float("inf"), float("nan"), 1e15, -5.0, 3.5])
COLUMNS = ["time_s", "u_px", "v_px", "frame", "sigma_u_px", "sigma_v_px"]

# Position (as a share of the length), and what becomes of the byte there.
DAMAGE = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8)


@pytest.fixture(scope="module")
def files(log: Path) -> Path:
    """The folder of a configuration and a log that work."""
    return log.parent.parent


# What further commands do with the files of a run; the words after them are those of the damaged copy.
READING = {
    "info": ["info", "{file}"],
    "info of a folder": ["info", "{folder}"],
    "check": ["check", "config.yaml", "out/detections.parquet", "--cameras", "out/cameras.yaml"],
    "evaluate": [
        "evaluate", "tracked/tracks.parquet", "out/truth.parquet", "--cutoff", "1", "--cameras", "out/cameras.yaml",
        "--log", "out/detections.parquet", "--seen-by", "1", "--seen-within", "1", "--out", "scores", "--no-plots",
    ],
    "evaluate cameras": ["evaluate-cameras", "out/cameras.yaml", "out/cameras.yaml"],
    "export tracks": ["export", "csv", "tracked/tracks.parquet", "--out", "tracks.csv"],
    "export tracks at a rate": ["export", "trc", "tracked/tracks.parquet", "--rate", "20", "--out", "tracks.trc"],
    "export cameras": ["export", "opencv", "out/cameras.yaml", "--out", "exported"],
    "init": ["init", "new", "--log", "out/detections.parquet", "--cameras", "out/cameras.yaml"],
    "config show": ["config", "show", "config.yaml", "--cameras", "out/cameras.yaml"],
    "import": ["import", "csv", "points.csv", "--cameras", "out/cameras.yaml", "--fps", "20", "--out", "imported"],
}  # fmt: skip
DAMAGED = [
    "config.yaml", "out/detections.parquet", "out/cameras.yaml", "out/truth.parquet", "tracked/tracks.parquet",
    "tracked/scans.parquet", "tracked/associations.parquet", "tracked/report.json", "points.csv",
]  # fmt: skip


@pytest.fixture(scope="module")
def whole_run(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a configuration, its log, the tracks of it, and the log as text."""
    folder = shutil.copytree(files, tmp_path_factory.mktemp("run") / "whole")
    detections = folder / "out" / "detections.parquet"
    track(load_config(folder / "config.yaml", ["report.associations=true"]), detections, folder / "tracked")
    table = pq.read_table(detections, columns=["camera", "frame", "u_px", "v_px"])
    csv.write_csv(table, folder / "points.csv")
    return folder


@budget()
@given(
    damage=DAMAGE,
    keep=st.one_of(st.just(1.0), st.floats(0, 1)),
    file=st.sampled_from(DAMAGED),
    command=st.sampled_from(sorted(READING)),
)
def test_damaged_bytes_of_any_file_of_a_run(
    whole_run: Path,
    capfd: pytest.CaptureFixture[str],
    damage: list[tuple[float, int]],
    keep: float,
    file: str,
    command: str,
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = shutil.copytree(whole_run, Path(name, "x"))
        damage_file(folder / file, damage, keep)
        words = [word.format(file=file, folder=Path(file).parent) for word in READING[command]]
        with contextlib.chdir(folder):
            code, said = outcome([*words, "-q"], capfd)
        assert code in (0, 2), said
        assert "Warning" not in said


def damage_file(path: Path, damage: list[tuple[float, int]], keep: float) -> None:
    """Change some bytes of a file, and keep a share of it."""
    content = bytearray(path.read_bytes())
    for share, value in damage:
        content[min(int(share * len(content)), len(content) - 1)] = value
    path.write_bytes(content[: int(keep * len(content))])


@budget()
@given(damage=DAMAGE, keep=st.one_of(st.just(1.0), st.floats(0, 1)), kind=st.sampled_from(["log", "config", "cameras"]))
def test_damaged_bytes(
    files: Path, capfd: pytest.CaptureFixture[str], damage: list[tuple[float, int]], keep: float, kind: str
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = shutil.copytree(files, Path(name, "x"))
        paths = {"config": folder / "config.yaml", "log": folder / "out" / "detections.parquet"}
        paths["cameras"] = folder / "out" / "cameras.yaml"
        damage_file(paths[kind], damage, keep)
        words = ["track", str(paths["config"]), str(paths["log"]), "--cameras", str(paths["cameras"]), "-q"]
        code, said = outcome([*words, "--out", os.path.join(name, "out")], capfd)
        assert code in (0, 2), said


@budget()
@given(changes=st.lists(st.tuples(st.sampled_from(COLUMNS), st.floats(0, 1), NUMBERS), min_size=1, max_size=4))
def test_odd_numbers_in_a_log(
    files: Path, capfd: pytest.CaptureFixture[str], changes: list[tuple[str, float, float]]
) -> None:
    table = pq.read_table(files / "out" / "detections.parquet")
    for column in ("sigma_u_px", "sigma_v_px"):
        table = table.append_column(column, pa.array([1.0] * len(table)))
    for column, share, value in changes:
        values = table.column(column).to_pylist()
        row = min(int(share * len(values)), len(values) - 1)
        fits = column != "frame" or abs(value) < 1e15
        values[row] = (int(value) if column == "frame" else value) if fits else 0
        index = table.schema.get_field_index(column)
        table = table.set_column(index, column, pa.array(values, table.schema.field(column).type))
    with tempfile.TemporaryDirectory() as name:
        pq.write_table(table, Path(name, "log.parquet"))
        for bad_rows in ("error", "drop"):
            words = ["track", str(files / "config.yaml"), os.path.join(name, "log.parquet"), "-q", "--force"]
            words += ["--out", os.path.join(name, "out"), "--set", f"input.on_bad_row={bad_rows}"]
            code, said = outcome(words, capfd)
            assert code in (0, 2), said
