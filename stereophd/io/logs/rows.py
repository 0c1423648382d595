"""Rows of a detection log as arrays, decoded from pieces of the file, and written frame by frame.

The columns are read from Arrow's buffers by NumPy: Arrow's own conversion imports pandas if it is installed, which
takes 0.2 s.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.numerics.rows import ArrayRows
from stereophd.io.tables.reading import cast_column, check_texts
from stereophd.io.tables.schemas import DETECTIONS, FLOAT, INTEGER, kinds_of
from stereophd.io.tables.writing import TableWriter

REQUIRED = kinds_of(DETECTIONS)
OPTIONAL = {**dict.fromkeys(("sigma_u_px", "sigma_v_px", "width_px", "height_px"), FLOAT), "object_id": INTEGER}
# Names of cameras as they are read: Arrow finds the words of a column of text with functions that are costly to load.
WORDS = pa.dictionary(pa.int32(), REQUIRED["camera"])


@dataclass(frozen=True)
class Rows(ArrayRows):
    """Rows of a log as arrays of length n; `empty` marks the rows of frames without detections."""

    row: Integers
    time_s: Array
    camera: Integers
    frame: Integers
    pixels: Array
    empty: Booleans
    sigma: Array | None
    object_id: Integers | None
    sizes: Array | None = None  # (n, 2): Width and height of the boxes, px

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True)
class Decoded:
    """A piece of a log: its rows, and what only the checks need to know of them."""

    rows: Rows  # The rows; `camera` is -1 where it is not one of the configuration's
    # `nulls`, `half`: Masks of the rows with a null in a required column, and of those with one of u_px, v_px null.
    nulls: Booleans
    half: Booleans
    names: pa.Array  # The camera column as read, for messages


def decode(batch: pa.RecordBatch, start: int, cameras: Mapping[str, int], path: Path | str = "log") -> Decoded:
    """Turn a piece of a log into arrays.

    The rows, `start` being the index of the first in the file, have the columns `REQUIRED`, and those of `OPTIONAL`
    that the log has; `cameras` gives the index of each name. Raises InputError when the name of a camera is not text,
    or a value does not fit the type of its column.
    """
    kinds = {**REQUIRED, **OPTIONAL, "camera": WORDS}
    column = {name: cast_column(batch.column(name), name, kinds[name], path, start) for name in batch.schema.names}
    check_texts(column["camera"], "camera", path, start)
    null = {name: _is_null(array) for name, array in column.items()}
    rows = Rows(
        row=np.arange(start, start + len(batch)),
        time_s=values_of(column["time_s"], np.float64, np.nan),
        camera=_camera_index(column["camera"], cameras),
        frame=values_of(column["frame"], np.int64, 0),
        pixels=_two_columns(column, "u_px", "v_px"),
        empty=null["u_px"] & null["v_px"],
        sigma=_two_columns(column, "sigma_u_px", "sigma_v_px") if "sigma_u_px" in column else None,
        object_id=values_of(column["object_id"], np.int64, -1) if "object_id" in column else None,
        sizes=_two_columns(column, "width_px", "height_px") if "width_px" in column else None,
    )
    nulls = null["time_s"] | null["camera"] | null["frame"]
    return Decoded(rows, nulls, null["u_px"] ^ null["v_px"], column["camera"])


def _two_columns(columns: Mapping[str, pa.Array], first: str, second: str) -> Array:
    """Return two columns side by side (n, 2), NaN for nulls."""
    return np.stack([values_of(columns[name], np.float64, np.nan) for name in (first, second)], axis=1)


def _camera_index(column: pa.DictionaryArray, cameras: Mapping[str, int]) -> Integers:
    """Return each row's index of the camera, -1 if null or unknown."""
    index = np.array([cameras.get(name, -1) for name in column.dictionary.to_pylist()] + [-1])
    codes = values_of(column.indices, np.int32, len(index) - 1)
    cameras_of_rows: Integers = index[codes]
    return cameras_of_rows


def values_of(column: pa.Array, dtype: type[np.generic], null: float) -> NDArray[Any]:
    """Return the values of an array of this type, with `null` in place of nulls."""
    buffer = column.buffers()[1]
    if buffer is None:
        return np.full(len(column), null, dtype=dtype)
    values = np.frombuffer(buffer, dtype, count=column.offset + len(column))[column.offset :]
    return np.where(_is_null(column), dtype(null), values)


def _is_null(column: pa.Array) -> Booleans:
    validity = column.buffers()[0]
    if validity is None:
        return np.zeros(len(column), dtype=bool)
    valid = np.unpackbits(np.frombuffer(validity, np.uint8), bitorder="little").astype(bool)
    return ~valid[column.offset : column.offset + len(column)]


def log_schema(optional: Iterable[str]) -> pa.Schema:
    """Return the columns of a log: those of every log, and optional ones by name, which are null without detection."""
    kinds = {name: INTEGER if name == "object_id" else FLOAT for name in optional}
    return pa.schema([*DETECTIONS, *(pa.field(name, kind, nullable=True) for name, kind in kinds.items())])


class LogWriter(TableWriter):
    """Write a detection log, with some `optional` columns, frame by frame, in the order of its times.

    The file is usually a temporary one of `stereophd.io.outputs.atomic.OutputFolder`; the metadata are those of
    `stereophd.io.outputs.provenance.to_metadata`.
    """

    def __init__(
        self, path: Path | str, metadata: Mapping[Any, Any] | None = None, optional: Sequence[str] = ()
    ) -> None:
        super().__init__(path, log_schema(optional), metadata)
        self._optional = tuple(optional)

    def write(
        self, time_s: float, camera: str, frame: int, pixels: Array, optional: Mapping[str, Any] | None = None
    ) -> None:
        """Write one frame, at the time of the camera's own clock, s.

        Detections (m, 2) are in distorted px; with m = 0 the frame becomes one row of nulls. An optional column without
        values (m,) is null.
        """
        columns: dict[str, Any] = {"time_s": time_s, "camera": camera, "frame": frame}
        columns |= {"u_px": pixels[:, 0], "v_px": pixels[:, 1]} if len(pixels) else {"u_px": [None], "v_px": [None]}
        for name in self._optional:
            values = (optional or {}).get(name) if len(pixels) else None
            columns[name] = [None] * max(len(pixels), 1) if values is None else values
        self.append(columns)
