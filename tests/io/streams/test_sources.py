"""Sources of frames: standard input, files that grow, folders of parts, the network."""

from __future__ import annotations

import io
import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from stereophd.errors import InputError
from stereophd.io.streams.documents import Checkpoint, RecordDocument
from stereophd.io.streams.mcap import McapRows
from stereophd.io.streams.messages import Message
from stereophd.io.streams.sources import Arrivals, follow, from_stream, listen

FRAMES = [Message("left", k, k / 10, np.array([[k + 0.5, 2.0]] * (k % 3))) for k in range(20)]
# Far longer than any of these sources takes; a source that never yields fails the test by it.
PATIENCE_S = 60.0


def table(frames: list[Message]) -> pa.Table:
    rows = [(f.time_s, f.camera, f.frame, u, v) for f in frames for u, v in (f.pixels.tolist() or [(None, None)])]
    names = ("time_s", "camera", "frame", "u_px", "v_px")
    return pa.table({name: [row[k] for row in rows] for k, name in enumerate(names)})


def taken(arrivals: Arrivals, count: int) -> Iterator[Message]:
    """Yield so many messages of a source that has no end."""
    end = time.monotonic() + PATIENCE_S
    while count:
        message = next(arrivals)
        assert time.monotonic() < end, "the source yields nothing"
        if message is not None:
            count -= 1
            yield message


def assert_same(messages: list[Message]) -> None:
    assert [(m.camera, m.frame, m.time_s, m.pixels.tolist()) for m in messages] == [
        (m.camera, m.frame, m.time_s, m.pixels.tolist()) for m in FRAMES
    ]


def lines() -> bytes:
    return "".join(f.to_line() + "\n" for f in FRAMES).encode()


def arrow() -> bytes:
    target = io.BytesIO()
    whole = table(FRAMES)
    with pa.ipc.new_stream(target, whole.schema) as writer:
        for frame in FRAMES:
            writer.write_table(table([frame]).cast(whole.schema))
    return target.getvalue()


@pytest.mark.parametrize("content", [lines(), lines().rstrip(b"\n"), lines().replace(b"\n", b"\n\n"), arrow()])
def test_a_stream_is_told_by_its_first_bytes(content: bytes) -> None:
    assert_same([m for m in from_stream(io.BytesIO(content)) if m is not None])


def test_a_pipe_is_read_as_it_is_written() -> None:
    reading, writing = os.pipe()
    with open(reading, "rb") as source, open(writing, "wb", buffering=0) as sink:
        content = lines()
        cut = content.index(b"\n") + 5  # within the second line
        sink.write(content[:cut])
        arrivals = from_stream(source)
        first = list(taken(arrivals, 1))
        assert next(arrivals) is None  # nothing more is there
        sink.write(content[cut:])
        sink.close()
        assert_same([*first, *(m for m in arrivals if m is not None)])


@pytest.mark.parametrize("content", [lines(), arrow()])
def test_a_file_is_followed_as_it_grows(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "growing"
    path.write_bytes(content[: len(content) // 2])
    read: list[Message] = []
    reader = threading.Thread(target=lambda: read.extend(taken(follow(path), len(FRAMES))), daemon=True)
    reader.start()
    with open(path, "ab") as stream:
        stream.write(content[len(content) // 2 :])
    reader.join(PATIENCE_S)
    assert_same(read)


def test_a_folder_is_followed_as_parts_come(tmp_path: Path) -> None:
    folder = tmp_path / "parts"
    folder.mkdir()
    pq.write_table(table(FRAMES[:7]), folder / "000.parquet")
    arrivals = follow(folder)
    read = list(taken(arrivals, 7))
    pq.write_table(table(FRAMES[7:]).cast(table(FRAMES).schema), tmp_path / "whole")
    (tmp_path / "whole").rename(folder / "001.parquet")
    assert_same([*read, *taken(arrivals, len(FRAMES) - 7)])


@pytest.mark.skipif(os.name != "posix", reason="sockets in the file system")
def test_messages_arrive_over_the_network(tmp_path: Path) -> None:
    zmq = pytest.importorskip("zmq")
    address = f"ipc://{tmp_path}/s"
    arrivals = listen(address)
    sender = zmq.Context.instance().socket(zmq.PUSH)
    sender.connect(address)
    for frame in FRAMES:
        sender.send(frame.to_line().encode())
    sender.send(b"")
    assert_same([m for m in arrivals if m is not None])
    sender.close(0)


def test_a_source_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        follow(tmp_path / "none")
    with pytest.raises(InputError, match="standard input: line 1: expected a frame"):
        list(from_stream(io.BytesIO(b"PAR1 is no line of JSON\n")))
    with pytest.raises(InputError, match="expected an Arrow stream"):
        list(from_stream(io.BytesIO(arrow()[:-40][:200])))


@pytest.mark.parametrize("address", ["nowhere", "tcp://127.0.0.1", "tcp://127.0.0.1:port", "://5555"])
def test_a_wrong_address_is_refused_before_a_missing_package(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zmq", None)  # as where it is not installed
    with pytest.raises(InputError, match="expected an address such as tcp"):
        listen(address)
    with pytest.raises(InputError, match="pyzmq"):
        listen("tcp://127.0.0.1:5555")


def test_an_address_that_cannot_be_bound_is_refused() -> None:
    pytest.importorskip("zmq")
    with pytest.raises(InputError, match="expected an address such as tcp"):
        listen("tcp://nowhere:5555")


def test_frames_and_rows_are_mcap(tmp_path: Path) -> None:
    writer = pytest.importorskip("mcap.writer", reason="MCAP needs mcap (the extra mcap)")
    reader = pytest.importorskip("mcap.reader")
    log = tmp_path / "log.mcap"
    with log.open("wb") as stream:
        recording = writer.Writer(stream)
        recording.start()
        schema = recording.register_schema(name="stereophd.Frame", encoding="jsonschema", data=b"{}")
        channel = recording.register_channel(topic="/left", message_encoding="json", schema_id=schema)
        for frame in FRAMES:
            recording.add_message(channel, round(1e9 * frame.time_s), frame.to_line().encode(), 0)
        recording.finish()
    assert_same([message for message in follow(log) if message is not None])
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(log.read_bytes()[:100])
    with pytest.raises(InputError, match="expected an MCAP file, found it damaged"):
        list(follow(damaged))
    rows = McapRows(tmp_path / "rows.mcap")
    rows.tell(Checkpoint(3))
    rows.add(RecordDocument(1.5, "left", 3, False, []))
    rows.close()
    with pytest.raises(
        InputError, match=r"expected messages of the schema stereophd.Frame \(json\), found stereophd.Message \(json\)"
    ):
        list(follow(tmp_path / "rows.mcap"))
    with (tmp_path / "rows.mcap").open("rb") as stream:
        written = [
            (channel.topic, message.log_time) for _, channel, message in reader.make_reader(stream).iter_messages()
        ]
    assert written == [("/stereophd/events", 0), ("/stereophd/tracks", 1_500_000_000)]
