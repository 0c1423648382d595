"""Where the frames of a running recording come from: standard input, files that grow, the network.

Each source yields messages as they arrive, and None after every `IDLE_S` without one, so that the reader can act while
nothing comes. It ends with the stream, at the end of a file that is not followed, or by an interrupt.
"""

import io
import os
import re
import select
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Literal, cast

from stereophd.errors import InputError
from stereophd.io.documents import expecting, need_package
from stereophd.io.streams.mcap import MARK, read_mcap
from stereophd.io.streams.messages import Message, messages_of_rows, parse_line

# Longest time between two looks at a source, s.
IDLE_S = 0.005
# A line of a frame of a million detections is shorter.
MAX_LINE_BYTES = 100_000_000
# An Arrow stream begins with the mark of a continuation, before the length of its schema.
_ARROW_HEAD = b"\xff\xff\xff\xff"
_CHUNK_BYTES = 1 << 16
# What ZeroMQ can take for an address, which a user without it may learn first.
_ADDRESS = re.compile(r"tcp://.+:(\d+|\*)|(?!tcp:)\w+://.+")

Arrivals = Iterator[Message | None]


def from_stream(stream: BinaryIO, name: str = "standard input") -> Arrivals:
    """Yield the frames of a stream of JSON lines or of Arrow IPC, distinguished by the first bytes.

    Raises InputError when the stream is neither.
    """
    buffered = cast(io.BufferedReader, stream if hasattr(stream, "peek") else io.BufferedReader(cast(Any, stream)))
    # looked at when the first frame is wanted: until something comes, the reader makes itself ready
    is_arrow = buffered.peek(4)[:4] == _ARROW_HEAD
    yield from _arrow(buffered, name) if is_arrow else _lines(_chunks(buffered), name)


def _chunks(stream: io.BufferedReader) -> Iterator[bytes]:
    """Yield what a stream has, as soon as it has it, and nothing (b"") after each idle time."""
    yield stream.read1(_CHUNK_BYTES)
    try:
        descriptor = stream.fileno()
    except (OSError, io.UnsupportedOperation):
        descriptor = None
    while True:
        # what `peek` had buffered is read by now: from here on the descriptor itself shows what is there
        if descriptor is not None and os.name == "posix" and not select.select([descriptor], [], [], IDLE_S)[0]:
            yield b""
            continue
        data = stream.read1(_CHUNK_BYTES) if descriptor is None else os.read(descriptor, _CHUNK_BYTES)
        if not data:
            return
        yield data


def _lines(chunks: Iterator[bytes], name: str) -> Arrivals:
    rest, number = b"", 0
    for chunk in chunks:
        if not chunk:
            yield None
            continue
        arrived_s = time.perf_counter()
        *lines, rest = (rest + chunk).split(b"\n")
        if len(rest) > MAX_LINE_BYTES:
            raise InputError(f"{name}: line {number + 1}: expected at most {MAX_LINE_BYTES // 10**6} MB, found more")
        for line in lines:
            number += 1
            if line.strip():
                yield parse_line(line, f"{name}: line {number}", arrived_s)
    if rest.strip():
        yield parse_line(rest, f"{name}: line {number + 1}")


def _arrow(stream: Any, name: str) -> Arrivals:
    import pyarrow as pa

    try:
        for batch in pa.ipc.open_stream(stream):
            yield from messages_of_rows(batch, name)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{name}: expected an Arrow stream of a detection log, found: {error}") from error


def follow(path: Path) -> Arrivals:
    """Yield the frames of JSON lines or an Arrow stream that grows, of an MCAP file, or of a folder of Parquet parts.

    A folder is read in the order of the names of its files; a part must come into it whole (written elsewhere and
    renamed). A file or folder is followed until an interrupt, an MCAP file read to its end. Raises InputError when it
    is not there, or holds something else.
    """
    if path.is_dir():
        return _parts(path)
    with expecting("frames", path):
        stream = open(path, "rb")  # noqa: SIM115 (open as long as it is followed)
    head = stream.read(4)
    stream.seek(0)
    if head == MARK[:4]:
        stream.close()
        return read_mcap(path)
    if head == _ARROW_HEAD:
        return _arrow(io.BufferedReader(_Growing(stream)), str(path))
    return _lines(_growing_chunks(stream), str(path))


def _growing_chunks(stream: BinaryIO) -> Iterator[bytes]:
    while True:
        data = stream.read(_CHUNK_BYTES)
        if not data:
            time.sleep(IDLE_S)
        yield data


class _Growing(io.RawIOBase):
    """A file whose reader waits for what is not yet written."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        while not (data := self._stream.read(len(buffer))):
            time.sleep(IDLE_S)
        buffer[: len(data)] = data
        return len(data)


def _parts(folder: Path) -> Arrivals:
    import pyarrow.parquet as pq

    from stereophd.io.tables.reading import damaged_is_input_error, open_parquet

    read: set[str] = set()
    while True:
        new = sorted(path for path in folder.glob("*.parquet") if path.name not in read)
        for path in new:
            read.add(path.name)
            with open_parquet(path, "part of a detection log") as parquet, damaged_is_input_error(path):
                assert isinstance(parquet, pq.ParquetFile)
                for batch in parquet.iter_batches(use_threads=False):
                    yield from messages_of_rows(batch, str(path))
        if not new:
            yield None
            time.sleep(IDLE_S)


def listen(address: str) -> Arrivals:
    """Yield the frames that arrive at a ZeroMQ address (PULL, bound here): one JSON document a message.

    Raises InputError when ZeroMQ is not installed (extra ``live``), or the address cannot be bound.
    """
    return _received(bind("PULL", address), address)


def bind(kind: Literal["PULL", "PUB"], address: str) -> Any:
    """Return a ZeroMQ socket that is bound to an address; InputError when it cannot be, or ZeroMQ is not installed."""
    return _socket(kind, address, lambda socket: socket.bind(address))


def connect(address: str) -> Any:
    """Return a ZeroMQ socket (SUB) with all that a publisher at an address sends; errors as `bind`."""
    socket = _socket("SUB", address, lambda socket: socket.connect(address))
    socket.subscribe("")
    return socket


def _socket(kind: str, address: str, join: Callable[[Any], object]) -> Any:
    wrong = f"{address}: expected an address such as tcp://127.0.0.1:5555, found"
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"{wrong} none of this form")
    zmq = need_package("pyzmq", f"{address}: a stream over the network", "zmq")
    socket: Any = zmq.Context.instance().socket(getattr(zmq, kind))
    try:
        join(socket)
    except zmq.ZMQError as error:
        raise InputError(f"{wrong}: {error}") from error
    return socket


def _received(socket: Any, address: str) -> Arrivals:
    number = 0
    try:
        while True:
            if not socket.poll(1000.0 * IDLE_S):
                yield None
                continue
            number += 1
            content = socket.recv()
            if content == b"":  # the end of the recording
                return
            yield parse_line(content, f"{address}: message {number}")
    finally:
        socket.close(0)
