"""Tables that are continued have the bytes of those written in one go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stereophd.io.outputs.checkpoints import read_checkpoint, write_checkpoint
from stereophd.io.tables.continued_tables import ContinuedTable, WrittenTable
from stereophd.io.tables.parquet_footers import moved_footer

from stereophd.errors import InputError
from stereophd.io.tables.schemas import ASSOCIATIONS, DETECTIONS, SCANS, TRACKS
from stereophd.io.tables.writing import TableWriter

METADATA = {b"stereophd": b"{}" * 500}


def rows_of(schema: pa.Schema, count: int, seed: int) -> dict[str, Any]:
    """Return random columns; texts of few and of many words."""
    numbers = np.random.default_rng([seed, count])
    columns: dict[str, Any] = {}
    for field in schema:
        if pa.types.is_fixed_size_list(field.type):
            columns[field.name] = numbers.normal(size=(count, 6, 6))
        elif pa.types.is_string(field.type):
            columns[field.name] = f"camera {seed % 3}" if field.name == "camera" else ["é"] * count
        elif pa.types.is_integer(field.type):
            columns[field.name] = numbers.integers(-9, 9, count)
        else:
            columns[field.name] = numbers.normal(size=count)
    return columns


@pytest.mark.parametrize("schema", [TRACKS, SCANS, ASSOCIATIONS], ids=["tracks", "scans", "associations"])
@given(
    steps=st.lists(st.tuples(st.integers(1, 25), st.sampled_from(["on", "kill", "kill with more", "move"])), max_size=8)
)
@settings(max_examples=15, deadline=None)
def test_bytes_are_those_of_one_arrow_writer(
    tmp_path_factory: pytest.TempPathFactory, schema: pa.Schema, steps: list[tuple[int, str]]
) -> None:
    folder = tmp_path_factory.mktemp("table")
    whole = TableWriter(folder / "whole.parquet", schema, METADATA, row_group_rows=10)
    table = ContinuedTable(folder / "part.parquet", schema, METADATA, row_group_rows=10)
    for seed, (count, then) in enumerate(steps):
        whole.append(rows_of(schema, count, seed))
        table.append(rows_of(schema, count, seed))
        if then == "move":
            table.move(folder / f"part {seed}.parquet")
        elif then != "on":
            write_checkpoint(folder / "state", "", {"table": table.written()})
            if then == "kill with more":
                table.append(rows_of(schema, 30, 99))
            table.abandon()
            written = read_checkpoint(folder / "state", "", [WrittenTable])["table"]
            table = ContinuedTable(table.path, schema, METADATA, row_group_rows=10, written=written)
    whole.close()
    table.close()
    assert table.rows == whole.rows
    assert table.path.read_bytes() == whole.path.read_bytes()


@pytest.mark.parametrize("damage", ["cut off", "changed"])
def test_a_damaged_table_is_refused(tmp_path: Path, damage: str) -> None:
    table = ContinuedTable(tmp_path / "t.parquet", SCANS)
    table.append(rows_of(SCANS, 20_000, 1))
    written = table.written()
    table.abandon()
    with open(table.path, "r+b") as stream:
        if damage == "cut off":
            stream.truncate(written.length - 1)
        else:
            stream.seek(written.length // 2)
            byte = stream.read(1)[0]
            stream.seek(written.length // 2)
            stream.write(bytes([byte ^ 1]))
    with pytest.raises(InputError, match="damaged"):
        ContinuedTable(table.path, SCANS, written=written)


def test_nulls_are_a_fault_of_the_program(tmp_path: Path) -> None:
    table = ContinuedTable(tmp_path / "t.parquet", DETECTIONS)
    table.append({"time_s": [1.0], "camera": "left", "frame": 1, "u_px": [None], "v_px": [None]})
    with pytest.raises(TypeError, match="nulls"):
        table.written()
    table.abandon()


def test_a_long_table_has_the_bytes_of_one_arrow_writer(tmp_path: Path) -> None:
    """Row groups of the usual size, with pages of several kinds; places beyond 2 to the 21st take more bytes."""
    paths = tmp_path / "whole.parquet", tmp_path / "part.parquet"
    for kind, path in zip((TableWriter, ContinuedTable), paths, strict=True):
        with kind(path, TRACKS, METADATA) as table:
            for seed in range(5):
                table.append(rows_of(TRACKS, 10_000, seed))
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert pq.read_metadata(paths[1]).num_row_groups == 4


def test_an_unknown_type_in_a_footer_is_an_error() -> None:
    with pytest.raises(ValueError, match="type 11"):
        moved_footer(bytes([0x1B, 0]), 1, 0)
