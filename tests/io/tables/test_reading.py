"""Damaged Parquet files are an input error, wherever the damage is."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.errors import InputError
from stereophd.io.outputs.provenance import origin
from stereophd.io.tables.reading import open_parquet

NAME = b"marked"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.parquet"
    pq.write_table(pa.table({NAME.decode(): [1.0, 2.0]}), path)
    return path


def test_the_name_of_a_column_that_is_no_text(table: Path) -> None:
    content = table.read_bytes()
    table.write_bytes(content.replace(NAME, b"\x80" + NAME[1:]))
    with pytest.raises(
        InputError, match=r"table\.parquet: expected a table \(Parquet file\), found one that is .* dam"
    ):
        open_parquet(table)
    assert origin(table) is None
