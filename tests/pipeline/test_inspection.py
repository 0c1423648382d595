"""What readers of output folders make of files that are cut off."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from stereophd.errors import InputError
from stereophd.io.interchange.assembly import Spool, _append
from stereophd.io.interchange.base import Piece
from stereophd.io.tables.schemas import history_schema
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.inspection.runs import read_run


@pytest.mark.parametrize("left", [3, 30, 300])
def test_a_history_that_is_cut_off_is_an_input_error(tmp_path: Path, left: int) -> None:
    path = tmp_path / "history.parquet"
    with TableWriter(path, history_schema(["x"])) as table:
        table.append({"time_s": np.arange(3.0), "x": np.arange(3.0), "covariance": np.ones((3, 1, 1))})
    content = path.read_bytes()
    path.write_bytes(content[:-left])
    with pytest.raises(InputError, match=r"history\.parquet: .*truncated"):
        read_run(tmp_path, "calibrate", {"provenance": {"inputs": {}}})


def test_a_full_disk_has_a_number_where_rows_are_spooled(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("the system has no full device")
    with open("/dev/full", "wb", buffering=0) as stream:
        rows = Piece(tmp_path, "left", np.zeros((5000, 2)), frame=np.arange(5000))
        with pytest.raises(OSError, match="No space") as raised:
            _append(Spool(tmp_path / "rows", stream), rows, "rows")  # type: ignore[arg-type]
    assert raised.value.errno == errno.ENOSPC
