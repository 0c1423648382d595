"""What a run of `track` keeps while it is unfinished, and how another process continues it.

About once a minute a run keeps its state (`TrackingState`), and before it what it has written: the rows of its tables,
or, where the records are used again once they are complete (smoothing, pieces), the records themselves. A process that
continues replays the rows or records, passes over the events of the log that the state knows, and goes on from there:
the outputs are those of an undisturbed run.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic

import pyarrow as pa

from stereophd.core.disparity.events import Event
from stereophd.io.outputs.saved import KeptParts, decode, decoder, encode
from stereophd.io.tables.kept_tables import KeptTable
from stereophd.io.tables.writing import Complete
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.tracking.loop import Estimator, Record, ReportTimes, RunState, State, run_estimator
from stereophd.pipeline.tracking.run_figures import LastingTracks, RunFigures
from stereophd.pipeline.tracking.single import SingleTrackerState

STATE, RECORDS = "state", "records"


@dataclass
class TrackingState(Generic[State]):
    """Where a run continues."""

    run: RunState[State]
    figures: RunFigures | None = None  # Of the tables; None where records are kept
    lasting: LastingTracks | None = None  # Where short tracks are left out
    counts: dict[str, int] = field(default_factory=dict)  # Table or records -> its parts that count


def state_type(state: Any) -> Any:
    """Return the type of an estimator's state, as a reader has to name it."""
    if isinstance(state, SingleTrackerState):
        kind: Any = SingleTrackerState
        return kind[type(state.estimator)]
    return type(state)


def bare(record: Record) -> dict[str, Any]:
    """Return the fields of a record without what only the loop and the smoother need."""
    info = replace(record.info, detected=record.info.detected[:0], claims=None)
    return {**record.__dict__, "info": info, "event": None}


def keep_record(parts: KeptParts, record: Record) -> None:
    """Keep a record after those that are in parts of an unfinished run, in order of time."""
    parts.append(encode((record.time_s, encode(bare(record)))))


def read_records(parts: KeptParts, from_s: float = -math.inf, until_s: float = math.inf) -> Iterator[Record]:
    """Yield the records in parts, from one time to before another, s; the others are not decoded."""
    read, read_record = decoder(tuple[float, bytes]), decoder(Record)
    for content in parts:
        time_s, record = decode(content, read, parts.path)
        if from_s <= time_s < until_s:
            yield decode(record, read_record, parts.path)


class UnfinishedTracking:
    """What one run of `track` keeps: its records if `keeps_records`, otherwise the rows of its tables.

    Nothing is written before there is something to keep. Raises InputError if what an earlier process kept is damaged,
    or of another run.
    """

    def __init__(self, unfinished: UnfinishedRun, estimator: Estimator[Any], keeps_records: bool) -> None:
        self.keeps_records = keeps_records
        self._unfinished = unfinished
        self._estimator = estimator
        self._tables: dict[str, KeptTable] = {}
        self._records: KeptParts | None = None
        self._lasting: LastingTracks | None = None
        kind: Any = TrackingState
        self._saved: TrackingState[Any] | None = unfinished.read(STATE, kind[state_type(estimator.init())])
        figures = None if self._saved is None else self._saved.figures
        #: Figures of the tables, kept up to date by what writes them.
        self.figures = RunFigures() if figures is None else figures

    def table(
        self, place: Path, schema: pa.Schema, metadata: Mapping[bytes, bytes], complete: Complete | None = None
    ) -> KeptTable:
        """Return a table of this run, with the rows that were kept."""
        kept = self._unfinished.parts(place.name, self._count(place.name))
        self._tables[place.name] = KeptTable(place, schema, metadata, kept, complete)
        return self._tables[place.name]

    def _count(self, name: str) -> int:
        """Return the number of parts that count of a table or the records."""
        return 0 if self._saved is None else self._saved.counts[name]

    def records(self, events: Iterable[Event], times: ReportTimes, keep_events: bool) -> Iterator[Record]:
        """Run the estimator on all events of a log, from the last state on, and yield its records.

        The parameters are those of `stereophd.pipeline.tracking.loop.run_estimator`. Records that were kept, if any
        are, come first, then those that follow. Where tables are kept, what writes a record must have written it before
        the next one is asked for, or it waits in `lasting`.
        """
        rest = iter(events)
        run = RunState(self._estimator.init()) if self._saved is None else self._saved.run
        if self.keeps_records:
            yield from self._kept_records(rest, keep_events)
        else:
            for _ in range(run.events):
                next(rest)
        for record in run_estimator(self._estimator, rest, times, keep_events, run):
            if self._records is not None:
                keep_record(self._records, record)
            yield record
            self._unfinished.keep(STATE, lambda: self._state(run))

    def _kept_records(self, events: Iterator[Event], keep_events: bool) -> Iterator[Record]:
        parts = self._unfinished.parts(RECORDS, self._count(RECORDS))
        for record in read_records(parts):
            event = next(events) if record.is_event else None
            yield replace(record, event=event if keep_events else None)
        self._records = parts

    def lasting(self, records: Iterable[Record], min_length_s: float) -> Iterator[Record]:
        """Yield records without short tracks, as `LastingTracks` does."""
        kept = None if self._saved is None else self._saved.lasting
        lasting = LastingTracks(min_length_s) if kept is None else kept
        if not self.keeps_records:
            self._lasting = lasting
        return lasting.records(records)

    def _state(self, run: RunState[Any]) -> TrackingState[Any]:
        """Return the state of a run to keep, after flushing what it has written to the disk."""
        if self._records is not None:
            counts = {RECORDS: self._records.flush()}
        else:
            counts = {name: table.keep() for name, table in self._tables.items()}
        last = None if run.last is None else Record(**bare(run.last))
        figures = None if self.keeps_records else self.figures
        return TrackingState(replace(run, last=last), figures, self._lasting, counts)
