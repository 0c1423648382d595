"""No damaged file ends a command with an internal error: logs, camera files, configurations with bytes changed."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from .test_configuration import BUDGET, base, log, outcome  # noqa: F401

NUMBERS = st.sampled_from([0.0, -0.0, 1e-300, 1e200, 1.7e308, -1.7e308, float("inf"), float("nan"), 1e15, -5.0, 3.5])
COLUMNS = ["time_s", "u_px", "v_px", "frame", "sigma_u_px", "sigma_v_px"]

# Position (as a share of the length), and what becomes of the byte there.
DAMAGE = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=8)


@pytest.fixture(scope="module")
def files(log: Path) -> Path:  # noqa: F811
    """The folder of a configuration and a log that work."""
    return log.parent.parent


@BUDGET
@given(damage=DAMAGE, keep=st.one_of(st.just(1.0), st.floats(0, 1)), kind=st.sampled_from(["log", "config", "cameras"]))
def test_damaged_bytes(
    files: Path, capfd: pytest.CaptureFixture[str], damage: list[tuple[float, int]], keep: float, kind: str
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = shutil.copytree(files, Path(name, "x"))
        paths = {"config": folder / "config.yaml", "log": folder / "out" / "detections.parquet"}
        paths["cameras"] = folder / "out" / "cameras.yaml"
        content = bytearray(paths[kind].read_bytes())
        for share, value in damage:
            content[min(int(share * len(content)), len(content) - 1)] = value
        paths[kind].write_bytes(content[: int(keep * len(content))])
        words = ["track", str(paths["config"]), str(paths["log"]), "--cameras", str(paths["cameras"]), "-q"]
        code, said = outcome([*words, "--out", os.path.join(name, "out")], capfd)
        assert code in (0, 2), said


@BUDGET
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
