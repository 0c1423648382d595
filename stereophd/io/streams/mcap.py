"""Frames and rows as MCAP files, the recordings of robotics: messages of JSON with their schemas (extra ``mcap``).

Frames are messages of the schema ``stereophd.Frame``, on any topics. Rows go to the topic ``/stereophd/tracks``, events
to ``/stereophd/events``, at the true time of their record.
"""

import json
import struct
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import msgspec

from stereophd.errors import InputError
from stereophd.io.documents import need_package
from stereophd.io.streams.documents import LiveEvent, RecordDocument, schema
from stereophd.io.streams.messages import Message, parse_line

MARK = b"\x89MCAP0\r\n"
FRAME_SCHEMA, TRACKS, EVENTS = "stereophd.Frame", "/stereophd/tracks", "/stereophd/events"
# Other schemas that a message names where no frame is there.
MOST_NAMED = 3
_encode = msgspec.json.Encoder().encode


def read_mcap(path: Path) -> Iterator[Message]:
    """Yield the frames of an MCAP file, in the order in which they were logged; messages of other schemas are ignored.

    Raises InputError when MCAP is not installed, or the file is damaged or holds no frame.
    """
    reader, number, others = need_package("mcap", f"{path}: MCAP", "mcap.reader"), 0, set[str]()
    with path.open("rb") as stream:
        try:
            for kind, channel, message in reader.make_reader(stream).iter_messages():
                if kind is not None and kind.name == FRAME_SCHEMA and channel.message_encoding == "json":
                    number += 1
                    yield parse_line(message.data, f"{path}: message {number} of {channel.topic}")
                elif len(others) < MOST_NAMED:
                    others.add(f"{kind.name if kind is not None else 'no schema'} ({channel.message_encoding})")
        except (import_module("mcap.exceptions").McapError, struct.error) as error:
            raise InputError(f"{path}: expected an MCAP file, found it damaged ({error})") from error
    if not number:
        found = ", ".join(sorted(others)) or "none"
        raise InputError(f"{path}: expected messages of the schema {FRAME_SCHEMA} (json), found {found}")


class McapRows:
    """Rows and events of a run as an MCAP file; complete after `close`.

    Raises InputError when MCAP is not installed, or the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        writer = need_package("mcap", f"{path}: MCAP", "mcap.writer")
        try:
            self._stream = path.open("xb")
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        self._writer: Any = writer.Writer(self._stream)
        self._writer.start(library="stereophd")
        self._time_ns = 0
        # Any message of the schema is one of its kinds.
        document = json.dumps({"type": "object", **schema()}).encode()
        number = self._writer.register_schema(name="stereophd.Message", encoding="jsonschema", data=document)
        self._topics = {
            topic: self._writer.register_channel(topic=topic, message_encoding="json", schema_id=number)
            for topic in (TRACKS, EVENTS)
        }

    def add(self, document: RecordDocument) -> None:
        """See `stereophd.io.streams.rows.RowSink`."""
        self._time_ns = max(round(1e9 * document.time_s), 0)  # (MCAP knows no times before 0)
        self._write(TRACKS, document)

    def tell(self, event: LiveEvent) -> None:
        """See `stereophd.io.streams.rows.RowSink`."""
        self._write(EVENTS, event)

    def _write(self, topic: str, content: RecordDocument | LiveEvent) -> None:
        self._writer.add_message(self._topics[topic], self._time_ns, _encode(content), self._time_ns)

    def close(self) -> None:
        """Write what is left, and the index."""
        self._writer.finish()
        self._stream.close()
