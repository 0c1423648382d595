"""Parquet tables: the schemas of the native files, a streaming writer, a checking reader.

The layouts are those of ``docs/formats.md``. The bytes of a table depend on its rows and metadata
only, never on how the rows were handed over, nor on the time of day.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereophd.errors import InputError
from stereophd.io.atomic import write_error

FLOAT, INTEGER, STRING = pa.float64(), pa.int64(), pa.string()
COVARIANCE = pa.list_(pa.field("item", FLOAT, nullable=False), 36)

# Rows of a group: about 3 MB of detections, so that a reader needs little memory at a time.
ROW_GROUP_ROWS = 65536


def _schema(columns: Mapping[str, pa.DataType], nullable: Sequence[str] = ()) -> pa.Schema:
    return pa.schema([pa.field(name, kind, nullable=name in nullable) for name, kind in columns.items()])


_KEY = {"time_s": FLOAT, "camera": STRING, "frame": INTEGER}
_POSITION = {"x": FLOAT, "y": FLOAT, "z": FLOAT}
_VELOCITY = {"vx": FLOAT, "vy": FLOAT, "vz": FLOAT}

#: One row a detection; a frame without detections is one row with null u_px, v_px.
DETECTIONS = _schema({**_KEY, "u_px": FLOAT, "v_px": FLOAT}, nullable=("u_px", "v_px"))
#: Optional column of a detection log: the true object (-1 clutter); null in a row without detection.
OBJECT_ID = pa.field("object_id", INTEGER, nullable=True)
#: One row a true object and time.
TRUTH = _schema({"time_s": FLOAT, "object_id": INTEGER, **_POSITION, **_VELOCITY})
#: One row a reported object and event; the covariance is 6x6, row-major, in the world frame.
TRACKS = _schema({**_KEY, "track_id": INTEGER, **_POSITION, **_VELOCITY, "covariance": COVARIANCE, "existence": FLOAT})
#: One row an event.
SCANS = _schema(
    {
        **_KEY,
        "n_detections": INTEGER,
        "cardinality_mean": FLOAT,
        "cardinality_estimate": INTEGER,
        "log_likelihood": FLOAT,
        "n_components": INTEGER,
    }
)


def _array(chunks: list[tuple[Any, int]], kind: pa.DataType) -> pa.Array:
    """Join the buffered chunks (value, rows) of one column; a scalar stands for all its rows."""
    if pa.types.is_fixed_size_list(kind):
        flat = np.concatenate([np.asarray(value, dtype=float).reshape(-1) for value, _ in chunks])
        return pa.FixedSizeListArray.from_arrays(pa.array(flat), type=kind)
    if pa.types.is_string(kind):
        texts: list[str] = []
        for value, rows in chunks:
            texts.extend([value] * rows if isinstance(value, str) else value)
        return pa.array(texts, kind)
    if all(isinstance(value, (np.ndarray, float, int, np.generic)) for value, _ in chunks):
        parts = [value if np.ndim(value) else np.full(rows, value) for value, rows in chunks]
        if not any(isinstance(part, np.ma.MaskedArray) for part in parts):
            return pa.array(np.concatenate(parts), kind, safe=True)
    # Chunks with nulls: masked arrays, lists with None, or None for all rows.
    return pa.concat_arrays([_nullable(value, rows, kind) for value, rows in chunks])


def _nullable(value: Any, rows: int, kind: pa.DataType) -> pa.Array:
    if value is None:
        return pa.nulls(rows, kind)
    if isinstance(value, np.ma.MaskedArray):
        return pa.array(np.asarray(value.data), kind, mask=np.ma.getmaskarray(value))
    if np.ndim(value) == 0:
        return pa.array([value] * rows, kind)
    return pa.array(value, kind)


class TableWriter:
    """Write a Parquet table piece by piece, in row groups of a fixed number of rows.

    Parameters
    ----------
    path
        The file; usually a temporary one of `stereophd.io.atomic.OutputFolder`.
    schema
        Columns; see `DETECTIONS`, `TRUTH`, `TRACKS`, `SCANS`.
    metadata
        Key-value metadata, as `stereophd.io.provenance.to_metadata` returns them.
    row_group_rows
        Rows held in memory before they are written.

    Raises
    ------
    InputError
        The file cannot be made; while writing, `OSError` with the file's name.
    """

    def __init__(
        self,
        path: Path | str,
        schema: pa.Schema,
        metadata: Mapping[Any, Any] | None = None,
        row_group_rows: int = ROW_GROUP_ROWS,
    ) -> None:
        self.path = Path(path)
        self.schema = schema.with_metadata(dict(metadata)) if metadata else schema
        self.rows = 0
        self._row_group_rows = row_group_rows
        self._buffer: list[tuple[dict[str, Any], int]] = []
        self._buffered = 0
        try:
            self._stream: BinaryIO | None = open(self.path, "wb")  # noqa: SIM115 (closed in close)
        except OSError as error:
            raise write_error(error, self.path) from error
        texts = [field.name for field in schema if pa.types.is_string(field.type)]
        self._writer = pq.ParquetWriter(
            self._stream, self.schema, compression="zstd", use_dictionary=texts or False, version="2.6"
        )

    def append(self, columns: Mapping[str, Any]) -> None:
        """Add rows.

        Parameters
        ----------
        columns
            Every column of the schema: an array or list of n values, or one value for all n rows. A
            null is None in a list, a masked element of a NumPy masked array, or None for all rows. A
            covariance is (n, 6, 6) or (n, 36). At least one column must be an array.

        Raises
        ------
        ValueError
            Missing or unknown columns, or arrays of different lengths.
        """
        if set(columns) != set(self.schema.names):
            raise ValueError(f"expected the columns {self.schema.names}, found {sorted(columns)}")
        lengths = {len(value) for value in columns.values() if not isinstance(value, str) and np.ndim(value) > 0}
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
                    name: value if isinstance(value, str) or np.ndim(value) == 0 else value[start : start + take]
                    for name, value in columns.items()
                }
            self._buffer.append((piece, take))
            self._buffered += take
            start += take
            if self._buffered == self._row_group_rows:
                self._flush()
        self.rows += rows

    def _flush(self) -> None:
        if not self._buffered:
            return
        arrays = [
            _array([(piece[field.name], rows) for piece, rows in self._buffer], field.type) for field in self.schema
        ]
        self._buffer, self._buffered = [], 0
        table = pa.Table.from_arrays(arrays, schema=self.schema)
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

    def __enter__(self) -> TableWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()


def open_parquet(path: Path | str, what: str = "table") -> pq.ParquetFile:
    """Open a Parquet file.

    Parameters
    ----------
    path
        The file.
    what
        What it should be, for the message (``detection log``).

    Raises
    ------
    InputError
        It is not there, not readable, empty, not Parquet, or cut off.
    """
    file = Path(path)
    try:
        if file.is_dir():
            raise InputError(f"{file}: expected a {what} (Parquet file), found a folder")
        size = file.stat().st_size
        if size == 0:
            raise InputError(f"{file}: expected a {what} (Parquet file), found an empty file")
        with open(file, "rb") as stream:
            magic = stream.read(4)
    except FileNotFoundError as error:
        raise InputError(f"{file}: there is no such file; expected a {what}") from error
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    if magic != b"PAR1":
        raise InputError(f"{file}: expected a {what} (Parquet file), found something that is not Parquet")
    try:
        return pq.ParquetFile(file, memory_map=False)
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            f"{file}: expected a {what} (Parquet file), found one that is truncated or damaged ({_first_line(error)})"
        ) from error


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or ["no details"])[0].rstrip(".")


@contextlib.contextmanager
def damaged_is_input_error(path: Path | str) -> Iterator[None]:
    """Turn the errors that reading the data of a damaged Parquet file raises into `InputError`."""
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: the file is damaged or truncated: {_first_line(error)}") from error


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _fits(found: pa.DataType, expected: pa.DataType) -> bool:
    """Whether a column can be read as `expected` without loss: wider numbers, other kinds of text."""
    if pa.types.is_floating(expected):
        return bool(pa.types.is_floating(found) or pa.types.is_integer(found))
    if pa.types.is_integer(expected):
        return bool(pa.types.is_integer(found))
    if pa.types.is_string(expected):
        return _is_text(found)
    if pa.types.is_fixed_size_list(expected):
        return bool(
            pa.types.is_fixed_size_list(found)
            and found.list_size == expected.list_size
            and _fits(found.value_type, expected.value_type)
        )
    return bool(found == expected)


def _data_type(kind: pa.DataType | str) -> pa.DataType:
    return pa.type_for_alias(kind) if isinstance(kind, str) else kind


def check_columns(
    schema: pa.Schema,
    required: Mapping[str, pa.DataType | str],
    optional: Mapping[str, pa.DataType | str],
    path: Path | str,
) -> list[str]:
    """Check the columns of a table, and return the names of those of `optional` that are there.

    Raises
    ------
    InputError
        A required column is missing, or a column has another type.
    """
    missing = [name for name in required if name not in schema.names]
    if missing:
        raise InputError(
            f"{path}: missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}; "
            f"expected {', '.join(required)}, found {', '.join(schema.names) or 'none'}"
        )
    present = [name for name in optional if name in schema.names]
    for name in [*required, *present]:
        if schema.names.count(name) > 1:
            raise InputError(f"{path}: column {name}: expected one column of this name, found several")
        expected = _data_type(required[name] if name in required else optional[name])
        found = schema.field(name).type
        if not _fits(found, expected):
            raise InputError(f"{path}: column {name}: expected type {expected}, found {found}")
    return present


def read_table(
    path: Path | str,
    required: Mapping[str, pa.DataType | str],
    optional: Mapping[str, pa.DataType | str] | None = None,
    what: str = "table",
) -> pa.Table:
    """Read columns of a Parquet table, checked and in the expected types.

    Parameters
    ----------
    path
        The file.
    required, optional
        Name -> type (`pyarrow.DataType` or its name, such as ``"float64"``). Narrower numbers are
        widened, any kind of text becomes a string. Other columns are not read.
    what
        What the table should be, for the messages.

    Returns
    -------
    pyarrow.Table
        The required columns in their order, then the optional ones that are there; the file's
        key-value metadata are its ``schema.metadata``.

    Raises
    ------
    InputError
        Not there, not Parquet, damaged, a column missing, of another type, or (required) with nulls.
    """
    optional = optional or {}
    with open_parquet(path, what) as parquet:
        schema = parquet.schema_arrow
        present = check_columns(schema, required, optional, path)
        names = [*required, *present]
        with damaged_is_input_error(path):
            table = parquet.read(columns=names).select(names)
    fields = []
    for name in names:
        kind = _data_type(required[name] if name in required else optional[name])
        fields.append(pa.field(name, kind))
        nulls = table.column(name).null_count
        if nulls and name in required:
            row = table.column(name).is_null().index(True).as_py()
            raise InputError(f"{path}: row {row}: column {name}: expected a value, found null")
    try:
        return table.cast(pa.schema(fields, metadata=schema.metadata))
    except pa.ArrowException as error:
        raise InputError(f"{path}: {_first_line(error)}") from error
