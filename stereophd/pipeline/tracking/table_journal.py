"""The tables of an unfinished run on the disk, with the state from which the run continues them.

About once a minute a run keeps the state of its estimator, its running figures, and how far its tables are written
(`io.tables.continued_tables`). Nothing is kept of a single event. The files of the tables lie in the folder of the
unfinished run from the first state on, and a killed run continues them there. At the end they have the bytes of an
undisturbed run.

A run whose records are used again once they are complete (smoothing) keeps its records instead
(`stereophd.pipeline.tracking.checkpoint`).
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from stereophd.core.disparity.events import Event
from stereophd.errors import InputError
from stereophd.io.outputs.atomic import atomic_write
from stereophd.io.outputs.checkpoints import reachable_classes, read_checkpoint, write_checkpoint
from stereophd.io.outputs.columns import pack, unpack
from stereophd.io.tables.continued_tables import ContinuedTable, WrittenTable
from stereophd.pipeline.runs.unfinished import UNFINISHED_TABLE
from stereophd.pipeline.tracking.checkpoint import STATE_FILE, Pace, SavedRun, classes_of
from stereophd.pipeline.tracking.lifetimes import LastingTracks, SavedLasting
from stereophd.pipeline.tracking.loop import LEFT_OUT, Estimator, Record, ReportTimes, RunState, run_estimator
from stereophd.pipeline.tracking.outputs import RecordWriter, SavedWriting

LOGGER = logging.getLogger("stereophd")


@dataclass(frozen=True)
class SavedTables:
    """A run and its tables, for a checkpoint."""

    run: SavedRun  # Without chunks of records
    last: dict[str, Any] | None  # Record of the last event, as `stereophd.io.outputs.columns.pack` returns it
    writing: SavedWriting
    tables: dict[str, WrittenTable]  # Name of a file -> how far it is written
    lasting: SavedLasting | None = None  # Where short tracks are left out

    @classmethod
    def of(
        cls,
        run: RunState[Any],
        writer: RecordWriter,
        tables: Mapping[str, ContinuedTable],
        lasting: LastingTracks | None = None,
    ) -> SavedTables:
        """Return what is to be kept of a run, whose tables are then on the disk as far as that."""
        # The loop needs the diagnostics of the last event, and when it was.
        last = None if run.last is None else replace(run.last, event=None, attributed={}, associations=())
        return cls(
            SavedRun.of(run, []),
            None if last is None else pack([last], LEFT_OUT),
            writer.saved(),
            {name: table.written() for name, table in tables.items()},
            None if lasting is None else lasting.saved(),
        )

    def run_state(self) -> RunState[Any]:
        """Return the state of the run."""
        last = None if self.last is None else unpack(self.last, reachable_classes([Record]))[0]
        return self.run.run_state(last)


class TableJournal:
    """The tables of one unfinished run, and its last state.

    Parameters
    ----------
    folder : Path
        Folder of the unfinished run. Made when there is something to keep.
    identity : str
        Identity of configuration and log; the state of another run is refused.
    estimator : Estimator
        What runs.
    """

    def __init__(self, folder: Path, identity: str, estimator: Estimator[Any]) -> None:
        self.folder = folder
        self.identity = identity
        self._classes = [SavedTables, *classes_of(estimator.init())]
        self._pace = Pace()
        self._tables: dict[str, ContinuedTable] = {}
        # Where the tables belong in the end.
        self._places: dict[str, Path] = {}
        self._writer: RecordWriter | None = None
        self._lasting: LastingTracks | None = None
        self._saved: SavedTables | None = None
        # Whether the files of the tables lie in the folder.
        self._kept = False

    def load(self) -> SavedWriting | None:
        """Read the last state that was kept, and return the figures in it; None if there is none.

        Raises
        ------
        InputError
            The folder holds the state of another run, or a damaged one.
        """
        path = self.folder / STATE_FILE
        if path.exists():
            self._saved = read_checkpoint(path, self.identity, self._classes).get("run")
            if not isinstance(self._saved, SavedTables):
                raise InputError(f"{path}: expected the state of a run, found something else")
            missing = [name for name in self._saved.tables if not self._part(name).exists()]
            if missing:
                # Killed between the first state and the move of the tables, or after they were moved to their places.
                LOGGER.warning("%s: no %s to continue: the run begins anew", self.folder, missing[0])
                self._saved = None
        self._kept = self._saved is not None
        if self._saved is None:
            # The state last: without it the other files are not known as ours.
            for old in (*self.folder.glob(UNFINISHED_TABLE), path):
                old.unlink(missing_ok=True)
            return None
        return self._saved.writing

    def table(self, place: Path, schema: pa.Schema, metadata: Mapping[bytes, bytes]) -> ContinuedTable:
        """Return the table that belongs at a place in the end; it continues that of the unfinished run, if any."""
        name = place.name
        self._places[name] = place
        if self._saved is None:
            self._tables[name] = ContinuedTable(place, schema, metadata)
        else:
            path = self._part(name)
            if path.stat().st_nlink > 1:
                # Outputs that are in their places already, or somebody's copy, may share the file: they stay whole.
                with atomic_write(path) as temporary:
                    shutil.copyfile(path, temporary)
            self._tables[name] = ContinuedTable(path, schema, metadata, written=self._saved.tables[name])
        return self._tables[name]

    def attach(self, writer: RecordWriter) -> None:
        """Take what writes the records into the tables."""
        self._writer = writer

    def records(
        self, estimator: Estimator[Any], events: Iterable[Event], times: ReportTimes, keep_events: bool
    ) -> Iterator[Record]:
        """Run an estimator as `run_estimator` does, from the state that was loaded.

        What `attach` was given must have written a record before the next one is asked for, or it waits in `lasting`.
        """
        run = RunState(estimator.init()) if self._saved is None else self._saved.run_state()
        rest = iter(events)
        for _ in range(run.events):
            next(rest)
        for record in run_estimator(estimator, rest, times, keep_events, run):
            yield record
            self.add(record, run)

    def lasting(self, records: Iterable[Record], min_length_s: float) -> Iterator[Record]:
        """Yield records without short tracks, as `stereophd.pipeline.tracking.lifetimes.lasting` does."""
        saved = None if self._saved is None else self._saved.lasting
        self._lasting = LastingTracks(min_length_s, saved)
        yield from self._lasting.records(records)

    def add(self, record: Record, run: RunState[Any]) -> None:
        """Note that a record is written, of which `run` is the state; keep it if the last time was a while ago."""
        self._pace.keep(lambda: self._keep(run))

    def _keep(self, run: RunState[Any]) -> None:
        assert self._writer is not None
        saved = SavedTables.of(run, self._writer, self._tables, self._lasting)
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.folder / STATE_FILE) as temporary:
            write_checkpoint(temporary, self.identity, {"run": saved})
        if not self._kept:
            # After the first state: it marks the folder as ours. Without all tables it does not count.
            for name, table in self._tables.items():
                table.move(self._part(name))
            self._kept = True

    def place(self) -> None:
        """Put the tables, closed, into their places, where they count once the run is done.

        They stay in the folder too, so that a run that is killed before then continues. On file systems without hard
        links they move, and such a run begins anew.
        """
        for name, place in self._places.items():
            if not self._kept:
                continue
            try:
                os.link(self._part(name), place)
            except OSError:
                os.replace(self._part(name), place)

    def _part(self, name: str) -> Path:
        return self.folder / UNFINISHED_TABLE.replace("*", name)
