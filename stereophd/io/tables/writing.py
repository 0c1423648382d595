"""Parquet tables, written as a stream.

The bytes of a table depend on its rows and metadata only, never on how the rows were handed over, nor on the time of
day.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from stereophd.io.outputs.disk import write_error

# Rows of a group: about 3 MB of detections, so that a reader needs little memory at a time.
ROW_GROUP_ROWS = 16384

# Columns of some rows, and their number; and what completes the pieces that are about to be written.
Piece = tuple[dict[str, Any], int]
Complete = Callable[[list[Piece]], list[Piece]]


def _array(chunks: list[tuple[Any, int]], field: pa.Field) -> pa.Array:
    """Join the buffered chunks (value, rows) of one column; a scalar fills all its rows.

    Arrays are made from buffers: `pyarrow.array` would import pandas where that is installed (0.2 s).
    """
    kind = field.type
    if pa.types.is_fixed_size_list(kind):
        flat = np.concatenate([np.asarray(value, dtype=np.float64).reshape(-1) for value, _ in chunks])
        return pa.FixedSizeListArray.from_arrays(_buffered(flat, kind.value_type), type=kind)
    if pa.types.is_string(kind):
        texts: list[bytes] = []
        for value, rows in chunks:
            texts.extend([value.encode()] * rows if isinstance(value, str) else [text.encode() for text in value])
        offsets = np.zeros(len(texts) + 1, dtype=np.int32)
        np.cumsum([len(text) for text in texts], out=offsets[1:])
        buffers = [None, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))]
        return pa.Array.from_buffers(kind, len(texts), buffers)
    # (older versions of pyarrow ask pandas for the type)
    dtype = np.dtype(np.float64 if pa.types.is_floating(kind) else np.int64)
    nulls = None
    # Thousands of small chunks make a row group: the usual kinds are joined without a look at each.
    if all(type(value) in (int, float) for value, _ in chunks):
        values = np.repeat(np.array([value for value, _ in chunks]), [rows for _, rows in chunks])
    elif all(type(value) is np.ndarray and value.ndim for value, _ in chunks):
        values = np.concatenate([value for value, _ in chunks])
    else:
        parts = [_with_nulls(value, rows) for value, rows in chunks]
        values = np.concatenate([part for part, _ in parts])
        nulls = np.concatenate([mask for _, mask in parts])
    if nulls is not None and nulls.any() and not field.nullable:
        raise ValueError(f"column {field.name}: expected values, found null")
    if dtype.kind == "i" and values.dtype.kind not in "iu":
        raise ValueError(f"column {field.name}: expected integers, found {values.dtype}")
    return _buffered(values.astype(dtype), kind, nulls)


def _with_nulls(value: Any, rows: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the values of a chunk (0 for nulls) and the mask of its nulls."""
    nulls = np.zeros(rows, dtype=bool)
    if value is None or isinstance(value, list):
        items = [None] * rows if value is None else value
        nulls = np.array([item is None for item in items], dtype=bool)
        value = np.array([0 if item is None else item for item in items])
    elif hasattr(value, "mask"):  # a masked array: `numpy.ma` is costly to import
        nulls, value = np.broadcast_to(value.mask, rows), value.data
    return np.broadcast_to(np.asarray(value), rows), nulls


def _buffered(values: NDArray[Any], kind: pa.DataType, nulls: NDArray[np.bool_] | None = None) -> pa.Array:
    """Return an Arrow array over the memory of a NumPy one."""
    validity = None
    if nulls is not None and nulls.any():
        validity = pa.py_buffer(np.packbits(~nulls, bitorder="little"))
    return pa.Array.from_buffers(kind, len(values), [validity, pa.py_buffer(np.ascontiguousarray(values))])


def _has_rows(value: Any) -> bool:
    """Whether a value is an array or list, rather than one value for all rows."""
    # the commonest single values by their types: np.ndim would make arrays of them
    if type(value) is np.ndarray:
        return value.ndim > 0
    return not isinstance(value, (str, float, int)) and np.ndim(value) > 0


class TableWriter:
    """Write a Parquet table piece by piece, in row groups of a fixed number of rows (held in memory until written).

    The file is usually a temporary one of `stereophd.io.outputs.atomic.OutputFolder`; for columns see `DETECTIONS`,
    `TRUTH`, `TRACKS`, `SCANS`; the metadata are key-value pairs of `stereophd.io.outputs.provenance.to_metadata`.
    `complete` fills columns that are appended as None, for all rows that are written together, once for each row.
    Raises InputError when the file cannot be made; while writing, `OSError` with the file's name.
    """

    def __init__(
        self,
        path: Path | str,
        schema: pa.Schema,
        metadata: Mapping[Any, Any] | None = None,
        complete: Complete | None = None,
    ) -> None:
        self.path = Path(path)
        self.schema = schema.with_metadata(dict(metadata)) if metadata else schema
        self.rows = 0
        self._names = frozenset(schema.names)
        self._row_group_rows = ROW_GROUP_ROWS
        self._complete = complete
        self._buffer: list[Piece] = []
        self._buffered = 0
        try:
            self._stream: BinaryIO | None = open(self.path, "wb")  # noqa: SIM115 (closed by close)
        except OSError as error:
            raise write_error(error, self.path) from error
        texts = [field.name for field in schema if pa.types.is_string(field.type)]
        self._writer = pq.ParquetWriter(
            self._stream, self.schema, compression="zstd", use_dictionary=texts or False, version="2.6"
        )

    def append(self, columns: Mapping[str, Any]) -> None:
        """Add rows: of every column of the schema an array or list of n values, or one value for all n rows.

        A null is None in a list, a masked element of a NumPy masked array, or None for all rows. A covariance is (n, 6,
        6) or (n, 36). At least one column must be an array. Raises ValueError for missing or unknown columns, or arrays
        of different lengths.
        """
        if columns.keys() != self._names:
            raise ValueError(f"expected the columns {self.schema.names}, found {sorted(columns)}")
        lengths = {len(value) for value in columns.values() if _has_rows(value)}
        if len(lengths) != 1:
            raise ValueError(f"expected columns of one length, found {sorted(lengths)}")
        rows = lengths.pop()
        start = 0
        while start < rows:
            take = min(rows - start, self._row_group_rows - self._buffered)
            if take == rows:
                piece = dict(columns)
            else:
                piece = {
                    name: value[start : start + take] if _has_rows(value) else value for name, value in columns.items()
                }
            self._buffer.append((piece, take))
            self._buffered += take
            start += take
            if self._buffered == self._row_group_rows:
                self._flush()
        self.rows += rows

    def _take(self) -> pa.Table:
        """Return the rows that wait, and let them wait no longer."""
        pieces = self._buffer if self._complete is None else self._complete(self._buffer)
        arrays = [_array([(piece[field.name], rows) for piece, rows in pieces], field) for field in self.schema]
        self._buffer, self._buffered = [], 0
        return pa.Table.from_arrays(arrays, schema=self.schema)

    def _flush(self) -> None:
        if self._buffered:
            table = self._take()
            with self._named_errors():
                self._writer.write_table(table, row_group_size=self._row_group_rows)

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Give an OSError of Arrow the name of the file, so that its message can name it."""
        try:
            yield
        except OSError as error:
            if error.errno is None or error.filename is not None:
                raise
            raise OSError(error.errno, error.strerror, str(self.path)) from error

    def close(self) -> None:
        """Write the rows that are left and the footer. Calling it again does nothing."""
        if self._stream is None:
            return
        try:
            self._flush()
            with self._named_errors():
                self._writer.close()
                self._stream.close()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file without caring for its content (after an error)."""
        stream, self._stream = self._stream, None
        self._buffer, self._buffered = [], 0
        if stream is not None:
            with contextlib.suppress(OSError, pa.ArrowException):
                self._writer.close()
            with contextlib.suppress(OSError):
                stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()
