"""Whether the rows of a detection log are in order of time, or only the rows of each camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from stereophd.core.arrays import Array
from stereophd.io.file_kinds import LOG
from stereophd.io.logs.rows import values_of
from stereophd.io.tables.reading import cast_column, check_texts, damaged_is_input_error, open_parquet
from stereophd.io.tables.schemas import FLOAT, STRING

# Two narrow columns: larger pieces than a reader of all columns takes.
PIECE_ROWS = 131_072


def is_by_camera(path: Path) -> bool:
    """Whether the rows are not in order of time, but each camera's are: in blocks, as in tables put together.

    Rows without a finite time or a camera are ignored here.

    Raises
    ------
    InputError
        The file is damaged, or a value does not fit the type of its column.
    """
    return not _is_ordered(path) and _is_ordered_within_cameras(path)


def _is_ordered(path: Path) -> bool:
    latest, start = -np.inf, 0
    for batch in _pieces(path, ["time_s"]):
        times = _times(batch, path, start)
        start += len(batch)
        times = times[np.isfinite(times)]
        if not len(times):
            continue
        if times[0] < latest or (np.diff(times) < 0).any():
            return False
        latest = float(times[-1])
    return True


def _is_ordered_within_cameras(path: Path) -> bool:
    latest: dict[str, float] = {}
    start = 0
    for batch in _pieces(path, ["time_s", "camera"]):
        times = _times(batch, path, start)
        names = cast_column(batch.column("camera"), "camera", STRING, path, start)
        check_texts(names, "camera", path, start)
        start += len(batch)
        cameras = names.dictionary_encode()
        codes = values_of(cameras.indices, np.int32, -1)
        for code, name in enumerate(cameras.dictionary.to_pylist()):
            mine = times[(codes == code) & np.isfinite(times)]
            if not len(mine):
                continue
            if mine[0] < latest.get(name, -np.inf) or (np.diff(mine) < 0).any():
                return False
            latest[name] = float(mine[-1])
    return True


def _times(batch: pa.RecordBatch, path: Path, start: int) -> Array:
    return values_of(cast_column(batch.column("time_s"), "time_s", FLOAT, path, start), np.float64, np.nan)


def _pieces(path: Path, columns: list[str]) -> Iterator[pa.RecordBatch]:
    with open_parquet(path, LOG) as parquet, damaged_is_input_error(path):
        yield from parquet.iter_batches(batch_size=PIECE_ROWS, columns=columns, use_threads=False)
