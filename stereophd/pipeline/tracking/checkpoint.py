"""The records of an unfinished run on the disk, with the state from which the run continues.

Runs that are smoothed keep their records; all others keep their tables
(`stereophd.pipeline.tracking.table_journal`). A run writes its records in chunks to a folder inside its output folder,
and about once a minute the state of its estimator. A killed run continues from there. The records of the folder,
together with those that follow from the state and the rest of the log, equal the records of an undisturbed run, and so
do the files written from them. What the folder holds is data, never code (`stereophd.io.outputs.checkpoints`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import atomic_write
from stereophd.io.outputs.checkpoints import reachable_classes, read_checkpoint, write_checkpoint
from stereophd.io.outputs.columns import pack, pack_counts, unpack, unpack_counts
from stereophd.pipeline.tracking.associations import Associated, Associations
from stereophd.pipeline.tracking.loop import (
    LEFT_OUT,
    Attribution,
    Estimator,
    Record,
    ReportTimes,
    RunState,
    run_estimator,
)

STATE_FILE = "state.npz"

# Seconds between two states that are kept; more where keeping one takes more than a hundredth of it.
KEEP_EVERY_S = 60.0
MOST_SHARE = 0.01

# Largest numbers of records of a chunk, and of estimates in them: some megabytes.
CHUNK_RECORDS = 20_000
# Records that are packed at a time: few enough to be in the cache of the processor still. To pack thousands at once
# takes more than twice as long.
PACKED_AT_ONCE = 256


@dataclass(frozen=True)
class SavedRun:
    """A `RunState`, without what the records hold."""

    estimator: Any  # State of the estimator
    events: int
    forecast_from_s: float
    attribution: dict[str, Any]  # Labels not reported yet, and their detections by camera
    tracks: NDArray[np.int64]  # (n, 2): Labels reported so far, and their tracks
    # (n, 3): Labels not reported yet, the event of a claim (its place in `claimed`), and its row there.
    claims: NDArray[np.int64]
    claimed: list[Associated]  # Each event once: thousands of labels may wait with claims to the same event
    chunks: list[tuple[float, float]]  # Spans of the chunks that lead up to this state (`RecordChunks`)

    @classmethod
    def of(cls, run: RunState[Any], chunks: Sequence[tuple[float, float]]) -> SavedRun:
        """Return what is to be kept of a run."""
        claims: list[tuple[int, int, int]] = []
        claimed: dict[int, tuple[int, Associated]] = {}
        for label, waiting in run.associations.pending.items():
            for event, row in waiting:
                place, _ = claimed.setdefault(id(event), (len(claimed), event))
                claims.append((label, place, row))
        return cls(
            run.estimator,
            run.events,
            run.forecast_from_s,
            pack_counts(run.attribution.pending),
            np.array(list(run.associations.known.items()), dtype=np.int64).reshape(-1, 2),
            np.array(claims, dtype=np.int64).reshape(-1, 3),
            [event for _, event in claimed.values()],
            list(chunks),
        )

    def run_state(self, last: Record | None) -> RunState[Any]:
        """Return the state of the run, `last` being the record of its last event."""
        pending: dict[int, list[tuple[Associated, int]]] = {}
        for label, place, row in self.claims.tolist():
            pending.setdefault(label, []).append((self.claimed[place], row))
        return RunState(
            self.estimator,
            self.events,
            last,
            self.forecast_from_s,
            Attribution(unpack_counts(self.attribution)),
            Associations(dict(self.tracks.tolist()), pending),
        )


class Pace:
    """Says when a state is to be kept."""

    def __init__(self) -> None:
        self._next_s = time.monotonic() + KEEP_EVERY_S

    def keep(self, write: Callable[[], None]) -> None:
        """Write the state if the last time was a while ago."""
        start = time.monotonic()
        if start < self._next_s:
            return
        write()
        now = time.monotonic()
        self._next_s = now + max(KEEP_EVERY_S, (now - start) / MOST_SHARE)


class RecordChunks:
    """Records in files of some megabytes each.

    Parameters
    ----------
    folder : Path
        Made when there is something to keep.
    identity : str
        Identity of configuration and log; files of another run are refused.
    """

    def __init__(self, folder: Path, identity: str) -> None:
        self.folder = folder
        self.identity = identity
        #: Times of the first and the last record of each chunk, s.
        self.spans: list[tuple[float, float]] = []
        self._waiting: list[Record] = []
        self._packed: list[dict[str, Any]] = []
        self._period: list[float] = []
        self._records = self._estimates = 0

    def add(self, record: Record) -> None:
        """Keep a record."""
        self._waiting.append(record if record.event is None else replace(record, event=None))
        self._period = [*self._period[:1], record.time_s]
        self._records += 1
        self._estimates += len(record.estimates.track_ids)
        if len(self._waiting) >= PACKED_AT_ONCE:
            self._pack()
        if max(self._records, self._estimates) >= CHUNK_RECORDS:
            self.flush()

    def _pack(self) -> None:
        if self._waiting:
            self._packed.append(pack(self._waiting, LEFT_OUT))
            self._waiting = []

    def flush(self) -> None:
        """Write the records that wait."""
        self._pack()
        if not self._packed:
            return
        self.write(self._path(len(self.spans)).name, {"records": self._packed})
        self.spans.append((self._period[0], self._period[-1]))
        self._packed, self._period, self._records, self._estimates = [], [], 0, 0

    def write(self, name: str, parts: dict[str, Any]) -> None:
        """Write another file of the folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.folder / name) as temporary:
            write_checkpoint(temporary, self.identity, parts)

    def read(self, from_s: float = -math.inf, until_s: float = math.inf) -> Iterator[Record]:
        """Yield the records of the chunks from one time to before another."""
        classes = reachable_classes([Record])
        for number, (first_s, last_s) in enumerate(self.spans):
            if last_s < from_s or first_s >= until_s:
                continue
            for packed in read_checkpoint(self._path(number), self.identity, [Record])["records"]:
                for record in unpack(packed, classes):
                    if from_s <= record.time_s < until_s:
                        yield record

    def keep_only(self, spans: Sequence[tuple[float, float]]) -> None:
        """Keep the first chunks, and remove the others."""
        self.spans = list(spans)
        kept = {self._path(number).name for number in range(len(self.spans))}
        for path in self.folder.glob("records-*.npz"):
            if path.name not in kept:
                path.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"records-{number:06d}.npz"


class RecordJournal:
    """The records of one unfinished run, and its last state.

    Parameters
    ----------
    folder, identity
        The same as in `RecordChunks`.
    estimator : Estimator
        What runs.
    """

    def __init__(self, folder: Path, identity: str, estimator: Estimator[Any]) -> None:
        self.chunks = RecordChunks(folder, identity)
        self._classes = [SavedRun, Record, *classes_of(estimator.init())]
        self._pace = Pace()

    def load(self) -> SavedRun | None:
        """Return the last state that was kept, or None; records after it are forgotten.

        Raises
        ------
        InputError
            The folder holds a state of another run, or a damaged one.
        """
        path = self.chunks.folder / STATE_FILE
        saved = None
        if path.exists():
            saved = read_checkpoint(path, self.chunks.identity, self._classes)["run"]
            if not isinstance(saved, SavedRun):
                raise InputError(f"{path}: expected the state of a run, found something else")
        self.chunks.keep_only([] if saved is None else saved.chunks)
        return saved

    def add(self, record: Record, run: RunState[Any]) -> None:
        """Keep a record, of which `run` is the state; the state too, if the last time was a while ago."""
        self.chunks.add(record)
        self._pace.keep(lambda: self._keep(run))

    def _keep(self, run: RunState[Any]) -> None:
        self.chunks.flush()
        self.chunks.write(STATE_FILE, {"run": SavedRun.of(run, self.chunks.spans)})

    def records(
        self, estimator: Estimator[Any], events: Iterable[Event], times: ReportTimes, keep_events: bool
    ) -> Iterator[Record]:
        """Run an estimator as `run_estimator` does, from where the journal ends, and keep what it gives there.

        Parameters
        ----------
        estimator, events, times, keep_events
            The same as in `stereophd.pipeline.tracking.loop.run_estimator`; all events of the log.

        Yields
        ------
        Record
            Those of the journal, then those that follow.
        """
        run: RunState[Any] = RunState(estimator.init())
        saved = self.load()
        rest = iter(events)
        if saved is not None:
            last = None
            for record in self.chunks.read():
                event = next(rest) if record.is_event else None
                last = record if record.is_event else last
                yield replace(record, event=event if keep_events else None)
            run = saved.run_state(last)
        for record in run_estimator(estimator, rest, times, keep_events, run):
            self.add(record, run)
            yield record


def classes_of(value: Any) -> list[type]:
    """Return the dataclasses of an object and of what it holds."""
    if not is_dataclass(value) or isinstance(value, type):
        return []
    inner = [kind for field in fields(value) for kind in classes_of(getattr(value, field.name))]
    return [type(value), *inner]
