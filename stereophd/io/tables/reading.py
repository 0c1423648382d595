"""Read Parquet tables with checks: every way in which a file can be wrong is a clear `InputError`."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from stereophd.errors import InputError
from stereophd.io.documents import check_parquet
from stereophd.io.file_kinds import HEAD_BYTES, PARQUET, kind_of_content, remedy
from stereophd.io.outputs.commit import refuse_unsettled
from stereophd.io.outputs.disk import for_arrow
from stereophd.io.tables.writing import ROW_GROUP_ROWS

# What pyarrow raises for a damaged Parquet file; the last where the name of a column is no text.
DAMAGED = (pa.ArrowException, OSError, UnicodeDecodeError)


# Largest magnitude of a time, place or speed: sums of squares of larger ones are no numbers any more.
LARGEST = 1e100


def open_parquet(path: Path | str, what: str = "table", words: Sequence[str] = ()) -> pq.ParquetFile:
    """Open a Parquet file, which should be `what` (``detection log``, say).

    Columns of `words` that hold text are read as dictionaries: each word once, and its number in each row.
    Raises InputError when it is not there, not readable, empty, not Parquet, or cut off.
    """
    file = Path(path)
    try:
        refuse_unsettled(file)
        if file.is_dir():
            raise InputError(f"{file}: expected a {what} (Parquet file), found a folder")
        size = file.stat().st_size
        if size == 0:
            raise InputError(f"{file}: expected a {what} (Parquet file), found an empty file")
        with open(file, "rb") as stream:
            head = stream.read(HEAD_BYTES)
    except FileNotFoundError as error:
        raise InputError(f"{file}: there is no such file; expected a {what}") from error
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or error}") from error
    if (found := kind_of_content(head)) != PARQUET:
        described = found or "something that is not Parquet"
        raise InputError(f"{file}: expected a {what} (Parquet file), found {described}{remedy(what, found)}")
    try:
        parquet = pq.ParquetFile(for_arrow(file), memory_map=False, read_dictionary=words)
    except DAMAGED as error:
        raise InputError(
            f"{file}: expected a {what} (Parquet file), found one that is truncated or damaged ({_first_line(error)})"
        ) from error
    check_parquet(parquet.metadata, file)
    return parquet


def read_metadata(path: Path | str, what: str = "table") -> Mapping[bytes, bytes]:
    """Return the key-value metadata of a Parquet file; errors as `open_parquet`."""
    with open_parquet(path, what) as parquet:
        return parquet.schema_arrow.metadata or {}


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or ["no details"])[0].rstrip(".")


@contextlib.contextmanager
def damaged_is_input_error(path: Path | str) -> Iterator[None]:
    """Turn the errors that reading the data of a damaged Parquet file raises into `InputError`."""
    try:
        yield
    except DAMAGED as error:
        raise InputError(f"{path}: the file is damaged or truncated: {_first_line(error)}") from error


def check_texts(column: pa.Array | pa.ChunkedArray, name: str, path: Path | str, start: int = 0) -> None:
    """Check that all texts of a column are UTF-8, as Parquet requires and other programs may not know.

    Raises InputError with the column, the file, and the row, `start` being the index of the first row in the file.
    """
    for chunk in column.chunks if isinstance(column, pa.ChunkedArray) else [column]:
        try:
            chunk.validate(full=True)
        except pa.ArrowInvalid:
            texts = chunk.cast(pa.binary()).to_pylist()
            row = next(row for row, text in enumerate(texts) if text and text.decode(errors="ignore").encode() != text)
            raise InputError(
                f"{path}: row {start + row}: column {name}: expected text in UTF-8, found {texts[row][:40]!r}"
            ) from None
        start += len(chunk)


def cast_column(
    column: pa.Array | pa.ChunkedArray, name: str, kind: pa.DataType, path: Path | str, start: int = 0
) -> pa.Array | pa.ChunkedArray:
    """Return a column, of a type that `check_columns` accepts for `kind`, as that type, without loss.

    Raises InputError where a value does not fit; `start` is the index of the column's first row in the file.
    """
    if column.type == kind:  # to cast a column loads all compute functions of Arrow
        return column
    try:
        return column.cast(kind)
    except pa.ArrowInvalid:
        row, value = _first_misfit(column, kind)
    expected, hint = f"a value of type {kind}", ""
    if pa.types.is_integer(kind):
        expected = f"a whole number of type {kind}"
    elif name == "time_s":
        expected, hint = "seconds as float64", " (nanoseconds?)"
    raise InputError(f"{path}: row {start + row}: column {name}: expected {expected}, found {value}{hint}")


def _first_misfit(column: pa.Array | pa.ChunkedArray, kind: pa.DataType) -> tuple[int, object]:
    """Return index and value of the first row that does not fit a type, by halving."""
    low, count = 0, len(column)
    while count > 1:
        half = count // 2
        try:
            column.slice(low, half).cast(kind)
        except pa.ArrowInvalid:
            count = half
        else:
            low, count = low + half, count - half
    return low, column[low].as_py()


def _is_text(kind: pa.DataType) -> bool:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _fits(found: pa.DataType, expected: pa.DataType) -> bool:
    """Whether a column can be read as `expected` without loss: wider numbers, other kinds of text, nulls alone."""
    if pa.types.is_null(found):
        return True
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


def check_columns(
    schema: pa.Schema, required: Mapping[str, pa.DataType], optional: Mapping[str, pa.DataType], path: Path | str
) -> list[str]:
    """Check the columns of a table, and return the names of those of `optional` that are there.

    Raises InputError when a required column is missing, or a column has another type.
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
        expected = required[name] if name in required else optional[name]
        found = schema.field(name).type
        # pandas keeps whole numbers with gaps as floats
        is_whole = name in present and pa.types.is_integer(expected) and pa.types.is_floating(found)
        if not (is_whole or _fits(found, expected)):
            raise InputError(f"{path}: column {name}: expected type {expected}, found {found}")
    return present


def read_pieces(
    path: Path | str, columns: Sequence[str] | None = None, what: str = "table", rows: int | None = None
) -> Iterator[pa.RecordBatch]:
    """Yield columns of a Parquet table in pieces of so many rows; errors as `open_parquet`, and of damaged data."""
    start = 0
    with open_parquet(path, what) as parquet, damaged_is_input_error(path):
        for batch in parquet.iter_batches(batch_size=rows or ROW_GROUP_ROWS, columns=columns, use_threads=False):
            for name in batch.schema.names:
                if _is_text(batch.schema.field(name).type):
                    check_texts(batch.column(name), name, path, start)
            yield batch
            start += len(batch)


def finite_column(table: pa.Table | pa.RecordBatch, name: str, path: Path | str, start: int = 0) -> NDArray[np.float64]:
    """Return a column of a table, or of the piece from row `start`, as numbers.

    Raises InputError, with its row, where one is none, or above `LARGEST`.
    """
    values: NDArray[np.float64] = np.array(table[name], dtype=np.float64)
    bad = np.flatnonzero(~(np.abs(values) <= LARGEST))
    if bad.size:
        found = values[bad[0]]
        expected = f"one of at most {LARGEST:g}" if np.isfinite(found) else "a finite number"
        raise InputError(f"{path}: row {start + bad[0]}: column {name}: expected {expected}, found {found}")
    return values


def arrays_of(table: pa.Table | pa.RecordBatch) -> dict[str, NDArray[Any]]:
    """Return the columns of a table as arrays; those of lists of n numbers are (rows, n)."""
    arrays = {}
    for name, column in zip(table.schema.names, table.columns, strict=True):
        column = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
        lists = pa.types.is_fixed_size_list(column.type)
        values = (column.flatten() if lists else column).to_numpy(zero_copy_only=False)
        arrays[name] = values.reshape(len(column), column.type.list_size) if lists else values
    return arrays


def read_table(
    path: Path | str,
    required: Mapping[str, pa.DataType],
    optional: Mapping[str, pa.DataType] | None = None,
    what: str = "table",
) -> pa.Table:
    """Read columns (name -> type) of a Parquet table, checked and in these types.

    Narrower numbers are widened, any kind of text becomes a string, and other columns are not read. Returns the
    required columns in their order, then the optional ones that are there; the file's key-value metadata are its
    ``schema.metadata``. Raises InputError when the table is not there, not Parquet, or damaged, or a column is missing,
    of another type, or (required) with nulls; or a required ``time_s`` is not finite.
    """
    optional = optional or {}
    with open_parquet(path, what) as parquet:
        names = [*required, *check_columns(parquet.schema_arrow, required, optional, path)]
        with damaged_is_input_error(path):
            table = parquet.read(columns=names).select(names)
    return checked_table(table.replace_schema_metadata(parquet.schema_arrow.metadata), required, optional, path)


def checked_table(
    table: pa.Table, required: Mapping[str, pa.DataType], optional: Mapping[str, pa.DataType], path: Path | str
) -> pa.Table:
    """Return a table of the required columns and of some optional ones in their types; see `read_table`."""
    fields = []
    for name in table.column_names:
        kind = required[name] if name in required else optional[name]
        fields.append(pa.field(name, kind))
        nulls = table.column(name).null_count
        if nulls and name in required:
            row = table.column(name).is_null().index(True).as_py()
            raise InputError(f"{path}: row {row}: column {name}: expected a value, found null")
    try:
        columns = [cast_column(table.column(field.name), field.name, field.type, path) for field in fields]
        table = pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata=table.schema.metadata))
        for field in fields:
            if pa.types.is_string(field.type):
                check_texts(table.column(field.name), field.name, path)
        if "time_s" in required:
            finite_column(table, "time_s", path)
        return table
    except pa.ArrowException as error:
        raise InputError(f"{path}: {_first_line(error)}") from error
