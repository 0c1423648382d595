"""Tables whose rows were kept have the bytes of those written in one go."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.errors import InputError
from stereophd.io.outputs.saved import PART, KeptParts
from stereophd.io.tables import writing
from stereophd.io.tables.kept_tables import KeptTable
from stereophd.io.tables.schemas import ASSOCIATIONS, DETECTIONS, SCANS, TRACKS
from stereophd.io.tables.writing import TableWriter

METADATA = {b"stereophd": b"{}" * 500}
USUAL_ROWS = writing.ROW_GROUP_ROWS


@pytest.fixture(scope="module", autouse=True)
def small_row_groups() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "ROW_GROUP_ROWS", 10)
        yield


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
@given(steps=st.lists(st.tuples(st.integers(1, 25), st.sampled_from(["on", "keep", "kill", "kill later"])), max_size=8))
@settings(max_examples=15, deadline=None)
def test_bytes_are_those_of_one_writer(
    tmp_path_factory: pytest.TempPathFactory, schema: pa.Schema, steps: list[tuple[int, str]]
) -> None:
    folder = tmp_path_factory.mktemp("table")
    whole = TableWriter(folder / "whole.parquet", schema, METADATA)

    def continued(count: int) -> KeptTable:
        return KeptTable(folder / "part.parquet", schema, METADATA, KeptParts(folder / "rows", "me", count))

    table = continued(0)
    for seed, (count, then) in enumerate(steps):
        whole.append(rows_of(schema, count, seed))
        table.append(rows_of(schema, count, seed))
        if then == "on":
            continue
        count_kept = table.keep()
        if then == "keep":
            continue
        if then == "kill later":
            table.append(rows_of(schema, 30, 99))
        table.abandon()
        table = continued(count_kept)
    whole.close()
    table.close()
    assert table.rows == whole.rows
    assert table.path.read_bytes() == whole.path.read_bytes()


def kept_rows(folder: Path) -> KeptParts:
    """Return parts with the rows of a table."""
    with KeptTable(folder / "t.parquet", SCANS, None, KeptParts(folder / "rows", "me")) as table:
        table.append(rows_of(SCANS, 1_000, 1))
        return KeptParts(folder / "rows", "me", table.keep())


@pytest.mark.parametrize("damage", ["cut off", "changed"])
def test_damaged_rows_are_refused(tmp_path: Path, damage: str) -> None:
    parts = kept_rows(tmp_path)
    (path,) = tmp_path.glob(f"*{PART}")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(path.read_bytes()[:-1] if damage == "cut off" else content)
    with pytest.raises(InputError, match="found it damaged"):
        KeptTable(tmp_path / "u.parquet", SCANS, None, parts)


def test_rows_of_another_table_are_refused(tmp_path: Path) -> None:
    forged = [KeptParts(tmp_path / f"forged {content!r}", "me") for content in (b"x", b"")]
    for parts, content in zip(forged, (b"x", b""), strict=True):
        parts.append(content)
        parts.flush()
    for parts in (kept_rows(tmp_path), *forged):
        with pytest.raises(InputError, match=r"expected rows of u\.parquet"):
            KeptTable(tmp_path / "u.parquet", TRACKS, None, parts)


def test_nulls_are_kept(tmp_path: Path) -> None:
    rows = {"time_s": [1.0, 2.0], "camera": "left", "frame": 1, "u_px": [None, 1.0], "v_px": [None, 2.0]}
    table = KeptTable(tmp_path / "t.parquet", DETECTIONS, None, KeptParts(tmp_path / "rows", "me"))
    table.append(rows)
    kept = KeptParts(tmp_path / "rows", "me", table.keep())
    table.abandon()
    with (
        KeptTable(tmp_path / "t.parquet", DETECTIONS, None, kept),
        TableWriter(tmp_path / "whole.parquet", DETECTIONS) as whole,
    ):
        whole.append(rows)
    assert (tmp_path / "t.parquet").read_bytes() == (tmp_path / "whole.parquet").read_bytes()


def test_row_groups_of_the_usual_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replayed with pages of several kinds."""
    monkeypatch.setattr(writing, "ROW_GROUP_ROWS", USUAL_ROWS)
    with TableWriter(tmp_path / "whole.parquet", TRACKS, METADATA) as whole:
        table = KeptTable(tmp_path / "part.parquet", TRACKS, METADATA, KeptParts(tmp_path / "rows", "me"))
        for seed in range(5):
            whole.append(rows_of(TRACKS, 10_000, seed))
            table.append(rows_of(TRACKS, 10_000, seed))
        kept = KeptParts(tmp_path / "rows", "me", table.keep())
        table.abandon()
    KeptTable(tmp_path / "part.parquet", TRACKS, METADATA, kept).close()
    assert (tmp_path / "whole.parquet").read_bytes() == (tmp_path / "part.parquet").read_bytes()
    assert pq.read_metadata(tmp_path / "part.parquet").num_row_groups == 4
