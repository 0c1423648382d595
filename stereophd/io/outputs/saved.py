"""What an unfinished run has done, in files: numbers, text and arrays, never code.

A file begins with a mark and the identity of its run. Frames follow: the length of a content, its CRC-32, the content.
A file with one frame is written at once; a file that grows counts as far as another file says, and what follows is the
work of a run that was killed. Objects are encoded by msgspec (MessagePack), which builds only objects of the types that
the reader names. Arrays come back equal to the bit, in their order of memory.
"""

import contextlib
import os
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_origin

import msgspec
import numpy as np

from stereophd.errors import InputError
from stereophd.io.outputs.atomic import atomic_write
from stereophd.io.outputs.disk import sync

MARK = b"stereophd unfinished run 4\n"

# Kinds of NumPy types that hold plain data: truth values, integers, floats.
_PLAIN_KINDS = "biuf"

# Bytes of the length and of the checksum before a frame.
_LENGTH, _CHECKSUM = 8, 4


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
    """Return what a frame of a file holds; `read` comes from `decoder`. InputError if it holds something else."""
    try:
        return read(content)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:  # msgspec's are ValueError
        raise InputError(
            f"{path}: expected an unfinished run of this version, found something else ({_short(error)})"
        ) from error


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


def _head(identity: str) -> bytes:
    return MARK + identity.encode() + b"\n"


def _frame(content: bytes) -> bytes:
    return len(content).to_bytes(_LENGTH, "little") + zlib.crc32(content).to_bytes(_CHECKSUM, "little") + content


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
    """Write an object as a file of an unfinished run, whole or not at all."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(_head(identity) + _frame(encode(value)))


def read_saved(path: Path, identity: str, read: Callable[[bytes], Any]) -> Any:
    """Return the object of a file that `write_saved` wrote; `read` comes from `decoder`.

    Raises InputError when the file is missing, damaged, or one of another run.
    """
    frames = list(read_frames(path, identity))
    if len(frames) != 1:
        raise InputError(f"{path}: expected the state of an unfinished run, found {len(frames)} parts")
    return decode(frames[0], read, path)


def read_frames(path: Path, identity: str, length: int | None = None) -> Iterator[bytes]:
    """Yield the contents of the frames of a file, as far as `length` bytes (default: all).

    Raises InputError when the file is missing, a link, damaged, shorter than that, or one of another run.
    """
    head = _head(identity)
    if not is_saved(path):
        found = "none" if not os.path.lexists(path) else "something else"
        raise InputError(f"{path}: expected a file of an unfinished run, found {found}")
    with open(path, "rb") as stream:
        if stream.read(len(head)) != head:
            raise InputError(f"{path}: expected an unfinished run of this configuration and log, found another's")
        end = os.fstat(stream.fileno()).st_size if length is None else length
        place = len(head)
        while place < end:
            size = int.from_bytes(stream.read(_LENGTH), "little")
            checksum = int.from_bytes(stream.read(_CHECKSUM), "little")
            place += _LENGTH + _CHECKSUM + size
            content = stream.read(size) if place <= end else b""
            if place > end or len(content) != size or zlib.crc32(content) != checksum:
                raise InputError(f"{path}: expected a file of an unfinished run, found it damaged or cut off")
            yield content


class GrowingFile:
    """A file of an unfinished run, its `identity`, that grows frame by frame.

    `length` bytes of an earlier process count, and what follows them is dropped; with None the file begins anew.
    """

    def __init__(self, path: Path, identity: str, length: int | None = None) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if length is None:
            path.unlink(missing_ok=True)
            self._stream = open(path, "xb")  # noqa: SIM115 (closed by close)
            self._stream.write(_head(identity))
            self._stream.flush()  # known as ours from here on
        else:
            if not is_saved(path) or path.stat().st_size < length:
                raise InputError(f"{path}: expected a file of an unfinished run, found it damaged or cut off")
            if path.stat().st_nlink > 1:  # somebody's copy stays whole
                with atomic_write(path) as temporary:
                    temporary.write_bytes(path.read_bytes())
            os.truncate(path, length)
            self._stream = open(path, "ab")  # noqa: SIM115 (closed by close)
        self.length = self._stream.tell()

    def append(self, content: bytes) -> None:
        """Add a frame."""
        frame = _frame(content)
        self._stream.write(frame)
        self.length += len(frame)

    def flush(self) -> int:
        """Bring all frames to the disk; return the number of bytes that count then."""
        self._stream.flush()
        sync(self.path)
        return self.length

    def close(self) -> None:
        """Close the file; what was not flushed does not count. Calling it again does nothing."""
        with contextlib.suppress(OSError):
            self._stream.close()
