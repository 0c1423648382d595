"""What an unfinished run has done, in files: numbers, text and arrays, never code.

A file begins with a mark and the identity of its run; the CRC-32 of its content follows, and the content. It is written
whole or not at all. What is too much to be written each time grows by further files (`KeptParts`): they count as far as
another file says, and those after them are the work of a run that was killed. Objects are encoded by msgspec
(MessagePack), which builds only objects of the types that the reader names. Arrays come back equal to the bit, in their
order of memory.
"""

import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_origin

import msgspec
import numpy as np

from stereophd.errors import InputError
from stereophd.io.outputs.atomic import atomic_write

MARK = b"stereophd unfinished run 7\n"

# Ending of the files of `KeptParts`, and bytes of contents of which one is made.
PART, PART_BYTES = ".part", 8_000_000

# Kinds of NumPy types that hold plain data: truth values, integers, floats.
_PLAIN_KINDS = "biuf"

# Bytes of the checksum before a content.
_CHECKSUM = 4


def _encode_array(value: Any) -> Any:
    """Return an array as its type, shape, order and bytes, and a number of NumPy as one of Python."""
    if type(value) is np.ndarray and value.dtype.kind in _PLAIN_KINDS and value.dtype.isnative:
        return value.dtype.char, value.shape, value.flags.fnc, value.tobytes("A")
    if isinstance(value, np.generic) and value.dtype.kind in _PLAIN_KINDS:
        return value.item()
    raise TypeError(f"an unfinished run cannot keep a {type(value).__name__}")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode_array)

#: Returns the bytes of an object: numbers, text, arrays, lists, tuples, mappings, dataclasses, named tuples, None.
encode: Callable[[Any], bytes] = _ENCODER.encode


def decoder(kind: Any, given: Mapping[type, Any] | None = None) -> Callable[[bytes], Any]:
    """Return what turns the bytes of an object back into it, its `kind` being its type as an annotation.

    `given`, type -> object, stands wherever this type is annotated, whatever the file holds: the reader knows it
    anyway.
    """

    def decode_array(wanted: Any, value: Any) -> Any:
        if given is not None and wanted in given:
            return given[wanted]
        if (get_origin(wanted) or wanted) is not np.ndarray:
            raise ValueError(f"no {wanted} is kept")
        char, shape, is_fortran, content = value
        dtype = np.dtype(char)
        if dtype.kind not in _PLAIN_KINDS:
            raise ValueError(f"no array of {dtype} is kept")
        array = np.frombuffer(content, dtype).reshape(shape, order="F" if is_fortran else "C")
        return array.copy(order="A")  # of its own, aligned and writable as any other

    return msgspec.msgpack.Decoder(kind, dec_hook=decode_array).decode


def decode(content: bytes, read: Callable[[bytes], Any], path: Path) -> Any:
    """Return what is in a content of a file; `read` comes from `decoder`. InputError if it is something else."""
    try:
        return read(content)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:  # msgspec's are ValueError
        found = " ".join(str(error).split())[:200]
        raise InputError(
            f"{path}: expected an unfinished run of this version, found something else ({found})"
        ) from error


def _head(identity: str) -> bytes:
    return MARK + identity.encode() + b"\n"


def is_saved(path: Path) -> bool:
    """Whether a file is one of an unfinished run, of any run and any version; a link is not."""
    mark = MARK.rstrip(b"0123456789\n")
    try:
        if path.is_symlink():
            return False
        with open(path, "rb") as stream:
            return stream.read(len(mark)) == mark
    except OSError:
        return False


def write_saved(path: Path, identity: str, value: Any) -> None:
    """Write an object as a file of an unfinished run, whole or not at all; its folder is made."""
    content = encode(value)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        stream.writelines((_head(identity), zlib.crc32(content).to_bytes(_CHECKSUM, "little"), content))


def read_saved(path: Path, identity: str, read: Callable[[bytes], Any]) -> Any:
    """Return the object of a file that `write_saved` wrote; `read` comes from `decoder`.

    Raises InputError when the file is missing, a link, damaged, or one of another run.
    """
    if not is_saved(path):
        found = "none" if not os.path.lexists(path) else "something else"
        raise InputError(f"{path}: expected a file of an unfinished run, found {found}")
    head = _head(identity)
    with open(path, "rb") as stream:
        if stream.read(len(head)) != head:
            raise InputError(f"{path}: expected an unfinished run of this configuration and log, found another's")
        checksum, content = stream.read(_CHECKSUM), stream.read()
    if zlib.crc32(content).to_bytes(_CHECKSUM, "little") != checksum:
        raise InputError(f"{path}: expected a file of an unfinished run, found it damaged or cut off")
    return decode(content, read, path)


class KeptParts:
    """Contents of an unfinished run, its `identity`, that grow by whole files, whose names begin as `path`.

    `count` files of an earlier process count, which are iterated over; further ones are replaced.
    """

    def __init__(self, path: Path, identity: str, count: int = 0) -> None:
        self.path = path
        self._identity, self._count = identity, count
        self._waiting: list[bytes] = []
        self._waiting_bytes = 0

    def __iter__(self) -> Iterator[bytes]:
        """Yield the contents that count; errors as `read_saved`."""
        read = decoder(list[bytes])
        for number in range(self._count):
            yield from read_saved(self._place(number), self._identity, read)

    def append(self, content: bytes) -> None:
        """Add a content, which may wait for further ones."""
        self._waiting.append(content)
        self._waiting_bytes += len(content)
        if self._waiting_bytes >= PART_BYTES:
            self.flush()

    def flush(self) -> int:
        """Bring all contents to the disk; return the number of files that count then."""
        if self._waiting:
            write_saved(self._place(self._count), self._identity, self._waiting)
            self._waiting, self._waiting_bytes = [], 0
            self._count += 1
        return self._count

    def _place(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}-{number:05d}{PART}")
