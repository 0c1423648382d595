"""Parquet tables that another process can continue, to the bytes of a table written in one go."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from stereophd.errors import InputError
from stereophd.io.disk import sync
from stereophd.io.parquet_footers import MAGIC, joined_footer, moved_footer, split_file
from stereophd.io.table_writing import TableWriter, parquet_writer


@dataclass(frozen=True)
class WrittenTable:
    """How far a table is written.

    Attributes
    ----------
    length : int
        Bytes of its file that count; what follows them is dropped.
    footers, ends : array (n,) of uint8, array (k,)
        Footers of the row groups in the file, end to end, and where each ends.
    rows : int
        Rows so far, those that wait included.
    waiting_rows : int
    waiting : mapping
        Name -> column of the rows that wait for the rest of their group: numbers (n,) or (n, k), or texts as an
        array of codes and the words that they stand for.
    """

    length: int
    footers: NDArray[np.uint8]
    ends: NDArray[np.int64]
    rows: int
    waiting_rows: int
    waiting: dict[str, Any]


class ContinuedTable(TableWriter):
    """A `TableWriter` of columns without nulls, whose file another process can continue.

    Parameters
    ----------
    path, schema, metadata, row_group_rows
        As in `TableWriter`.
    written : WrittenTable, optional
        How far the file at `path` is written; default: not at all.

    Raises
    ------
    InputError
        The file cannot be made, or it is shorter than `written` says.
    """

    def __init__(
        self,
        path: Path | str,
        schema: pa.Schema,
        metadata: Mapping[Any, Any] | None = None,
        row_group_rows: int | None = None,
        written: WrittenTable | None = None,
    ) -> None:
        self._written = written
        super().__init__(path, schema, metadata, row_group_rows)
        if written is not None:
            self.rows = written.rows
        if written is not None and written.waiting_rows:
            columns = {name: _values(column) for name, column in written.waiting.items()}
            self._buffer, self._buffered = [(columns, written.waiting_rows)], written.waiting_rows

    def _opened(self) -> BinaryIO:
        if self._written is None:
            return super()._opened()
        stream = open(self.path, "r+b")  # noqa: SIM115 (closed in close)
        if os.fstat(stream.fileno()).st_size < self._written.length:
            stream.close()
            raise InputError(f"{self.path}: expected the beginning of a table, found one that was cut off")
        stream.truncate(self._written.length)
        stream.seek(self._written.length)
        return stream

    def _writer_to(self, stream: BinaryIO) -> _Groups:
        self._groups = _Groups(stream, self.schema, self._written)
        return self._groups

    def written(self) -> WrittenTable:
        """Return how far the table is written; the file is on the disk as far as that."""
        with self._named_errors():
            self._groups.stream.flush()
            sync(self.path)
        footers = self._groups.footers
        table = self._waiting() if self._buffered else None
        return WrittenTable(
            self._groups.length,
            np.frombuffer(b"".join(footers), dtype=np.uint8),
            np.cumsum([len(footer) for footer in footers], dtype=np.int64),
            self.rows,
            self._buffered,
            {} if table is None else {name: _column(table[name].chunk(0)) for name in self.schema.names},
        )

    def move(self, path: Path) -> None:
        """Move the file to another place of its file system, and continue there."""
        self._groups.stream.close()
        os.replace(self.path, path)
        self.path = path
        self._stream = self._groups.stream = open(path, "ab")  # noqa: SIM115 (closed in close)


class _Groups:
    """Writes each row group as a file of its own in memory, then its bytes to the file, and the footers at the end."""

    def __init__(self, stream: BinaryIO, schema: pa.Schema, written: WrittenTable | None) -> None:
        self.stream = stream
        self._closed = False
        self.length = len(MAGIC)
        self.footers: list[bytes] = []
        self._schema = schema
        # What the metadata of the file say stands in its own footer, once.
        self._plain = schema.with_metadata(None)
        if written is None:
            stream.write(MAGIC)
        else:
            self.length = written.length
            everything = written.footers.tobytes()
            self.footers = [everything[start:end] for start, end in pairwise([0, *written.ends.tolist()])]

    def write_table(self, table: pa.Table, row_group_size: int) -> None:
        sink = pa.BufferOutputStream()
        writer = parquet_writer(sink, self._plain)
        writer.write_table(table.replace_schema_metadata(None), row_group_size=row_group_size)
        writer.close()
        rows, footer = split_file(memoryview(sink.getvalue()))
        self.stream.write(rows)
        self.footers.append(moved_footer(footer, self.length - len(MAGIC), len(self.footers)))
        self.length += len(rows)

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        sink = pa.BufferOutputStream()
        parquet_writer(sink, self._schema).close()
        _, empty = split_file(memoryview(sink.getvalue()))
        self.stream.write(joined_footer(empty, self.footers))


def _column(array: pa.Array) -> Any:
    """Return a column as arrays of NumPy, for a checkpoint."""
    if pa.types.is_string(array.type):
        texts = array.to_pylist()
        words = sorted(set(texts))
        places = {word: place for place, word in enumerate(words)}
        return {"words": words, "codes": np.array([places[text] for text in texts])}
    if pa.types.is_fixed_size_list(array.type):
        return _column(array.flatten()).reshape(len(array), -1)
    if array.null_count:
        raise TypeError("a table with nulls cannot be continued")
    return np.frombuffer(array.buffers()[1], dtype=np.float64 if pa.types.is_floating(array.type) else np.int64)


def _values(column: Any) -> Any:
    """Return what `_column` made as `TableWriter.append` takes it."""
    if isinstance(column, dict):
        return [column["words"][code] for code in column["codes"].tolist()]
    return column
