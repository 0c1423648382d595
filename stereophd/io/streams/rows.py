"""Estimates as they are known: documents of records, as lines of JSON, rows of Arrow, or messages."""

import math
import time
from dataclasses import dataclass
from itertools import repeat
from typing import BinaryIO, Protocol, TextIO

import msgspec
import numpy as np
import pyarrow as pa

from stereophd.core.multi.state.estimates import Estimates
from stereophd.io.streams.documents import LiveEvent, Ready, RecordDocument, ReportedTrack
from stereophd.io.streams.sources import bind
from stereophd.io.tables.schemas import CONFIRMED, EXTENTS, TENTATIVE

STATE = ("x", "y", "z", "vx", "vy", "vz")
ROWS = pa.schema(
    [
        ("time_s", pa.float64()),
        ("camera", pa.string()),
        ("frame", pa.int64()),
        ("revised", pa.bool_()),
        ("track_id", pa.int64()),
        *((name, pa.float64()) for name in STATE),
        ("position_covariance", pa.list_(pa.float64(), 6)),
        ("existence", pa.float64()),
        ("status", pa.string()),
        *((field.name, pa.float64()) for field in EXTENTS),
    ]
)
# Places of xx, xy, xz, yy, yz and zz among the 36 of a covariance.
UPPER = np.array([0, 1, 2, 7, 8, 14])
# Time between two repetitions of where the cameras are, s.
READY_EVERY_S = 5.0
# An eighth of the time of the standard library's, with fifty tracks.
_encode = msgspec.json.Encoder().encode


def document_of(time_s: float, camera: str, frame: int, estimates: Estimates, is_revised: bool) -> RecordDocument:
    """Return the document of a record."""
    tracks: list[ReportedTrack] = []
    for level, status in ((estimates, CONFIRMED), (estimates.tentative, TENTATIVE)):
        if level is None:
            continue
        upper = level.covariances.reshape(-1, 36).take(UPPER, axis=1).tolist()
        extents = () if level.extents is None else level.extents.T.tolist()
        columns = (level.track_ids.tolist(), *level.states.T.tolist(), upper, level.existence.tolist())
        tracks += map(ReportedTrack, *columns, repeat(status), *extents)
    return RecordDocument(time_s, camera, frame, is_revised, tracks)


class RowSink(Protocol):
    """What takes the documents of records as they come, and events such as that a camera was knocked."""

    def add(self, document: RecordDocument) -> None:
        """Take the document of a record."""

    def tell(self, event: LiveEvent) -> None:
        """Take an event."""


@dataclass(frozen=True)
class JsonLines:
    """A line of JSON for each record on one stream, and for each event on another, or none."""

    records: BinaryIO
    events: TextIO | None = None

    def add(self, document: RecordDocument) -> None:
        """See `RowSink`; numbers have all their digits, NaN is null."""
        self.records.write(_encode(document) + b"\n")
        self.records.flush()

    def tell(self, event: LiveEvent) -> None:
        """See `RowSink`."""
        if self.events is not None:
            self.events.write(_encode(event).decode() + "\n")
            self.events.flush()


class ArrowRows:
    """An Arrow IPC stream of rows as in ``tracks.parquet``, with ``revised``; events are lines of JSON elsewhere."""

    def __init__(self, records: BinaryIO, events: TextIO | None = None) -> None:
        self._records, self._lines = records, JsonLines(records, events)
        self._writer = pa.ipc.new_stream(records, ROWS)

    def add(self, document: RecordDocument) -> None:
        """See `RowSink`; a record without tracks has no rows."""
        content = msgspec.to_builtins(document)
        rows = [content | track for track in content["tracks"]]
        if rows:
            self._writer.write_batch(pa.RecordBatch.from_pylist(rows, schema=ROWS))
            self._records.flush()

    def tell(self, event: LiveEvent) -> None:
        """See `RowSink`."""
        self._lines.tell(event)


class Publisher:
    """A ZeroMQ publisher: each record and each event is a message, its line of JSON; nobody is waited for.

    Raises InputError when ZeroMQ is not installed (extra ``live``), or the address cannot be bound.
    """

    def __init__(self, address: str) -> None:
        self._socket = bind("PUB", address)
        #: Where it is bound: a port that the system chose in place of ``*``.
        self.address: str = self._socket.last_endpoint.decode()
        # Sent again for those who connect later.
        self._ready: Ready | None = None
        self._told_s = -math.inf

    def add(self, document: RecordDocument) -> None:
        """See `RowSink`."""
        if self._ready is not None and time.monotonic() > self._told_s + READY_EVERY_S:
            self.tell(self._ready)
        self._socket.send(_encode(document))

    def tell(self, event: LiveEvent) -> None:
        """See `RowSink`; the places of the cameras are sent again every few seconds."""
        if isinstance(event, Ready):
            self._ready, self._told_s = event, time.monotonic()
        self._socket.send(_encode(event))
