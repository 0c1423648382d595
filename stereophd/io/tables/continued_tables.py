"""Parquet tables that another process can continue, to the bytes of a table written in one go."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from stereophd.errors import InputError
from stereophd.io.outputs.disk import sync
from stereophd.io.tables.parquet_footers import MAGIC, joined_footer, moved_footer, split_end
from stereophd.io.tables.writing import TableWriter, parquet_writer

# Bytes read at a time.
_BLOCK_BYTES = 2**20


@dataclass(frozen=True)
class WrittenTable:
    """How far a table is written."""

    length: int  # Bytes of its file that count; what follows them is dropped
    checksum: int  # CRC-32 of these bytes
    # `footers`, `ends`: (n,) of uint8, array (k,): Footers of the row groups in the file, end to end, and where each
    # ends.
    footers: NDArray[np.uint8]
    ends: NDArray[np.int64]
    rows: int  # Rows so far, those that wait included
    waiting_rows: int
    # Name -> column of the rows that wait for the rest of their group: numbers (n,) or (n, k), or texts as an array
    # of codes and the words that they stand for.
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
        The file cannot be made, or its beginning is not the one of `written`.
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
        # Rows that wait and were kept, in one table: they are converted once.
        self._joined: pa.Table | None = None
        super().__init__(path, schema, metadata, row_group_rows)
        if written is not None and written.waiting_rows:
            columns = {name: _values(column) for name, column in written.waiting.items()}
            self._buffer = [(columns, written.waiting_rows)]
            self._joined = super()._take()
        if written is not None:
            self.rows, self._buffered = written.rows, written.waiting_rows

    def _opened(self) -> BinaryIO:
        if self._written is None:
            return super()._opened()
        stream = open(self.path, "r+b")  # noqa: SIM115 (closed in close)
        try:
            if _checksum(stream, self._written.length) != self._written.checksum:
                raise InputError(f"{self.path}: expected the table that the checkpoint belongs to, found it damaged")
            stream.truncate(self._written.length)
        except BaseException:
            stream.close()
            raise
        return stream

    def _writer_to(self, stream: BinaryIO) -> _Groups:
        self._groups = _Groups(stream, self.schema, self._written)
        return self._groups

    def written(self) -> WrittenTable:
        """Return how far the table is written; the file is on the disk as far as that."""
        with self._named_errors():
            self._groups.stream.flush()
            sync(self.path)
        footers, waiting_rows = self._groups.footers, self._buffered
        self._joined = table = self._take() if waiting_rows else None
        self._buffered = waiting_rows
        return WrittenTable(
            self._groups.length,
            self._groups.checksum,
            np.frombuffer(b"".join(footers), dtype=np.uint8),
            np.cumsum([len(footer) for footer in footers], dtype=np.int64),
            self.rows,
            waiting_rows,
            {} if table is None else {name: _column(table[name].chunk(0)) for name in self.schema.names},
        )

    def _take(self) -> pa.Table:
        joined, self._joined = self._joined, None
        if joined is None:
            return super()._take()
        if not self._buffer:
            self._buffered = 0
            return joined
        return pa.concat_tables([joined, super()._take()]).combine_chunks()

    def move(self, path: Path) -> None:
        """Move the file to another place of its file system, and continue there."""
        self._groups.stream.close()
        os.replace(self.path, path)
        self.path = path
        self._stream = self._groups.stream = open(path, "ab")  # noqa: SIM115 (closed in close)


class _OneGroup:
    """A file of one row group for Arrow to write: the group goes to another file, the footer stays in memory."""

    closed = False

    def __init__(self, stream: BinaryIO, checksum: int) -> None:
        self._stream = stream
        #: Bytes of the group so far, and the CRC-32 of the file with them.
        self.length, self.checksum = 0, checksum
        self._skipped = 0
        # What is written last, from `end` on.
        self._last: list[bytes] | None = None

    def write(self, content: bytes) -> int:
        """Take what Arrow writes."""
        # The mark at the beginning is in the whole file once.
        new = content[len(MAGIC) - self._skipped :] if self._skipped < len(MAGIC) else content
        self._skipped += len(content) - len(new)
        if self._last is None:
            self._pass_on(new)
        else:
            self._last.append(new)
        return len(content)

    def flush(self) -> None:
        """Do nothing: the other file is flushed when it has to be."""

    def end(self) -> None:
        """Keep what follows in memory."""
        self._last = []

    def footer(self) -> bytes:
        """Return the footer, once all is written."""
        rest, footer = split_end(b"".join(self._last or []))
        self._pass_on(rest)
        return footer

    def _pass_on(self, content: bytes) -> None:
        self._stream.write(content)
        self.checksum = zlib.crc32(content, self.checksum)
        self.length += len(content)


class _Groups:
    """Writes row groups, each as a file of its own with `_OneGroup`, and in the end the footer of all."""

    def __init__(self, stream: BinaryIO, schema: pa.Schema, written: WrittenTable | None) -> None:
        self.stream = stream
        self._closed = False
        self.length, self.checksum = len(MAGIC), zlib.crc32(MAGIC)
        self.footers: list[bytes] = []
        self._schema = schema
        # What the metadata of the file say stands in its own footer, once.
        self._plain = schema.with_metadata(None)
        if written is None:
            stream.write(MAGIC)
        else:
            self.length, self.checksum = written.length, written.checksum
            everything = written.footers.tobytes()
            self.footers = [everything[start:end] for start, end in pairwise([0, *written.ends.tolist()])]

    def write_table(self, table: pa.Table, row_group_size: int) -> None:
        group = _OneGroup(self.stream, self.checksum)
        writer = parquet_writer(group, self._plain)
        writer.write_table(table.replace_schema_metadata(None), row_group_size=row_group_size)
        group.end()
        writer.close()
        self.footers.append(moved_footer(group.footer(), self.length - len(MAGIC), len(self.footers)))
        self.length += group.length
        self.checksum = group.checksum

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        sink = pa.BufferOutputStream()
        parquet_writer(sink, self._schema).close()
        _, empty = split_end(sink.getvalue().to_pybytes())
        self.stream.write(joined_footer(empty, self.footers))


def _checksum(stream: BinaryIO, length: int) -> int:
    """Return the CRC-32 of the first bytes of a file, which is then read as far as that."""
    checksum, left = 0, length
    while left and (block := stream.read(min(left, _BLOCK_BYTES))):
        checksum = zlib.crc32(block, checksum)
        left -= len(block)
    return checksum


def _column(array: pa.Array) -> Any:
    """Return a column as arrays of NumPy, for a checkpoint."""
    if array.null_count:
        raise TypeError("a table with nulls cannot be continued")
    if pa.types.is_string(array.type):
        coded = array.dictionary_encode()
        codes = np.frombuffer(coded.indices.buffers()[1], dtype=np.int32)
        return {"words": coded.dictionary.to_pylist(), "codes": codes[: len(array)]}
    if pa.types.is_fixed_size_list(array.type):
        return _column(array.values).reshape(len(array), -1)
    dtype = np.float64 if pa.types.is_floating(array.type) else np.int64
    return np.frombuffer(array.buffers()[1], dtype=dtype, count=len(array))


def _values(column: Any) -> Any:
    """Return what `_column` made as `TableWriter.append` takes it."""
    if isinstance(column, dict):
        return [column["words"][code] for code in column["codes"].tolist()]
    return column
