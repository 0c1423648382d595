"""Footers of Parquet files: moved to another place of a file, and joined.

A Parquet file is its row groups and a footer that says where they are. Arrow writes files from their beginning only.
So that a file can be continued, each row group is written as a file of its own, whose footer is then moved to the place
of the group in the whole file. The whole file has the bytes that Arrow writes in one go.

A footer is a structure of the Thrift compact protocol
(https://github.com/apache/thrift/blob/master/doc/specs/thrift-compact-protocol.md); the numbers of its fields are in
https://github.com/apache/parquet-format/blob/master/src/main/thrift/parquet.thrift.
"""

from __future__ import annotations

from collections.abc import Iterable

import pyarrow as pa
import pyarrow.parquet as pq

MAGIC = b"PAR1"

# What follows a footer: its length in four bytes, and the mark.
_LENGTH_BYTES = 4
_TAIL_BYTES = _LENGTH_BYTES + len(MAGIC)

_STOP, _TRUE, _FALSE, _BYTE, _I16, _I32, _I64, _DOUBLE, _BINARY, _LIST, _SET, _MAP, _STRUCT = range(13)
_WIDTHS = {_BYTE: 1, _DOUBLE: 8}
_INTEGERS = (_I16, _I32, _I64)

# Fields of a footer, by the numbers on the way to them: row_groups is 4, columns 1, meta_data 3.
_PLACES = frozenset(
    {
        (4, 5),  # row group: file_offset
        (4, 1, 2),  # column: file_offset
        (4, 1, 4),  # column: offset_index_offset
        (4, 1, 6),  # column: column_index_offset
        (4, 1, 3, 9),  # data_page_offset
        (4, 1, 3, 10),  # index_page_offset
        (4, 1, 3, 11),  # dictionary_page_offset
        (4, 1, 3, 14),  # bloom_filter_offset
    }
)
_ORDINAL = (4, 7)
_MOST_ORDINAL = 2**15 - 1


def split_end(content: bytes) -> tuple[bytes, bytes]:
    """Return what lies before the footer in the end of a Parquet file, and the footer."""
    end = len(content) - _TAIL_BYTES
    start = end - int.from_bytes(content[end : end + _LENGTH_BYTES], "little")
    return content[:start], content[start:end]


def moved_footer(footer: bytes, distance: int, ordinal: int) -> bytes:
    """Return the footer of a file of one row group for a file in which this is the row group number `ordinal`.

    Parameters
    ----------
    footer : bytes
    distance : int
        Bytes by which the row group lies further from the beginning of the file.
    ordinal : int

    Raises
    ------
    ValueError
        The footer has a type of field that the protocol does not know.
    """
    return _Mover(footer, distance, ordinal).moved()


def joined_footer(empty: bytes, footers: Iterable[bytes]) -> bytes:
    """Return the end of a file, from its footer on.

    Parameters
    ----------
    empty : bytes
        Footer of a file without rows, with the metadata of the file.
    footers : iterable of bytes
        Footers of its row groups, in order.

    Raises
    ------
    pyarrow.ArrowInvalid, OSError
        One of them is no footer.
    """
    whole = _parsed(empty)
    for footer in footers:
        whole.append_row_groups(_parsed(footer))
    sink = pa.BufferOutputStream()
    whole.write_metadata_file(sink)
    return bytes(sink.getvalue().to_pybytes()[len(MAGIC) :])


def _parsed(footer: bytes) -> pq.FileMetaData:
    length = len(footer).to_bytes(_LENGTH_BYTES, "little")
    return pq.read_metadata(pa.BufferReader(b"".join((MAGIC, footer, length, MAGIC))))


class _Mover:
    """Copies a footer, value by value, with other places in it."""

    def __init__(self, footer: bytes, distance: int, ordinal: int) -> None:
        self._footer, self._at = footer, 0
        self._distance, self._ordinal = distance, min(ordinal, _MOST_ORDINAL)
        self._out = bytearray()

    def moved(self) -> bytes:
        """Return the copy."""
        self._struct(())
        return bytes(self._out)

    def _copy(self, count: int) -> bytes:
        """Copy bytes as they are."""
        found = self._footer[self._at : self._at + count]
        self._at += count
        self._out += found
        return found

    def _read(self) -> int:
        """Read a number of seven bits a byte, the lowest first."""
        number = shift = 0
        while True:
            byte = self._footer[self._at]
            self._at += 1
            number |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return number

    def _write(self, number: int) -> None:
        while number >= 0x80:
            self._out.append(number & 0x7F | 0x80)
            number >>= 7
        self._out.append(number)

    def _copy_length(self) -> int:
        length = self._read()
        self._write(length)
        return length

    def _struct(self, path: tuple[int, ...]) -> None:
        field = 0
        while (header := self._copy(1)[0]) != _STOP:
            field = field + (header >> 4) if header >> 4 else _signed(self._copy_length())
            # The value of a truth value is in its type.
            if header & 0xF not in (_TRUE, _FALSE):
                self._value(header & 0xF, (*path, field))

    def _value(self, kind: int, path: tuple[int, ...]) -> None:
        if kind in _INTEGERS:
            self._integer(path)
        elif kind == _BINARY:
            self._copy(self._copy_length())
        elif kind in (_LIST, _SET):
            self._list(path)
        elif kind == _STRUCT:
            self._struct(path)
        elif kind in _WIDTHS:
            self._copy(_WIDTHS[kind])
        else:
            raise ValueError(f"a Parquet footer cannot hold a value of type {kind}")

    def _integer(self, path: tuple[int, ...]) -> None:
        number = _signed(self._read())
        # Where there is nothing, some versions of Arrow write 0.
        if path in _PLACES and number:
            number += self._distance
        elif path == _ORDINAL:
            number = self._ordinal
        self._write(number * 2 if number >= 0 else -number * 2 - 1)

    def _list(self, path: tuple[int, ...]) -> None:
        header = self._copy(1)[0]
        count, kind = header >> 4, header & 0xF
        for _ in range(self._copy_length() if count == 0xF else count):
            if kind in (_TRUE, _FALSE):
                self._copy(1)
            else:
                self._value(kind, path)


def _signed(number: int) -> int:
    """Return the number whose sign is in the lowest bit."""
    return (number >> 1) ^ -(number & 1)
