"""A long log in pieces: tracked independently of each other, joined where they overlap.

A piece is tracked from some time before its own span, so that its filter has forgotten the beginning when the span
begins. The tracks of two successive pieces are paired in that overlap by the probability that they are one object
(`stereophd.core.trajectories.joins`); a pair that is more probable than not becomes one track. Smoothed pieces also
continue beyond their spans: the smoother looks ahead.

A piece is finished when its whole file is there; what a piece holds does not depend on who made it, nor when.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.geometry.camera import Camera
from stereophd.core.trajectories.joins import PROBABLE, join_probabilities
from stereophd.errors import InputError, StereophdError
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.stream import EventStream, open_log
from stereophd.pipeline.tracking.loop import Record, RunState
from stereophd.pipeline.tracking.run_figures import LastingTracks
from stereophd.pipeline.tracking.single import SingleTrackerState
from stereophd.pipeline.tracking.smoothed import trajectories_of
from stereophd.pipeline.tracking.tracking_run import build_tracking
from stereophd.pipeline.tracking.unfinished import keep_record, read_records
from stereophd.pipeline.workers.places import ATTEMPTS, complete, open_workers
from stereophd.wording import instant

# A piece is tracked this long before its span, s: an object in only one view keeps the depth that it had in two,
# so the time is that for which objects stay in one view.
OVERLAP_S = 60.0

# More pieces than this are an error.
MOST_PIECES = 100_000


@dataclass(frozen=True)
class LogPiece:
    """A piece of a log."""

    number: int
    # `from_s`, `to_s`: Its own span of true time.
    from_s: float
    to_s: float
    # `begin_s`, `end_s`: What is tracked.
    begin_s: float
    end_s: float
    # Events of the log before `begin_s`: filters choose their samples by the number of an event, and so choose those
    # of the whole run.
    events_before: int


def overlap_of(length_s: float, overlap_s: float | None) -> float:
    """Return the overlap of pieces, s: as stated, else 60 s, or the length of shorter pieces.

    Raises InputError if the overlap is longer than a piece.
    """
    if overlap_s is None:
        return min(OVERLAP_S, length_s)
    if not 0.0 < overlap_s <= length_s:
        raise InputError(
            f"`overlap_s`: expected more than 0 s and at most a piece's {length_s:g} s, found {overlap_s:g}"
        )
    return overlap_s


def plan_pieces(frames: Iterable[Frame], length_s: float, overlap_s: float, ahead: bool) -> tuple[LogPiece, ...]:
    """Cut a log into pieces of one length; the last one is longer by up to the overlap, or shorter.

    Spans without a frame have no piece: a pause of the recording costs nothing. The frames of the log are read once,
    with all its checks. With `ahead` pieces continue beyond their spans too.
    """
    first_s, last_s = math.nan, math.nan
    # Number of a span of the length, from the first frame on -> events before what is tracked with it.
    before: dict[int, int] = {}
    spans: set[int] = set()  # Those with a frame
    for number, frame in enumerate(frames):
        first_s = frame.time_s if number == 0 else first_s
        span = math.floor((frame.time_s - first_s) / length_s)
        # The division rounds; the cuts are these products.
        span += int(frame.time_s >= first_s + (span + 1) * length_s) - int(frame.time_s < first_s + span * length_s)
        spans.add(span)
        before.setdefault(span, number)
        if frame.time_s >= first_s + (span + 1) * length_s - overlap_s:
            before.setdefault(span + 1, number)
        if len(spans) > MOST_PIECES:
            raise InputError(
                f"`pieces_s`: expected at most {MOST_PIECES} pieces, found more of {length_s:g} s until "
                f"{instant(frame.time_s)} s: choose longer pieces, or cut the log"
            )
        last_s = frame.time_s
    if not spans:
        return (LogPiece(0, -math.inf, math.inf, -math.inf, math.inf, 0),)
    last = max(0, math.floor((last_s - overlap_s - first_s) / length_s))
    kept = sorted({min(span, last) for span in spans})
    more = overlap_s if ahead else 0.0
    pieces = []
    for number, span in enumerate(kept):
        from_s = -math.inf if number == 0 else first_s + span * length_s
        to_s = math.inf if number == len(kept) - 1 else first_s + (span + 1) * length_s
        begun = before[span] if span in before else before[span + 1]
        pieces.append(LogPiece(number, from_s, to_s, from_s - overlap_s, to_s + more, begun))
    return tuple(pieces)


# A join of a smaller probability is reported as uncertain.
CERTAIN = 0.99


@dataclass(frozen=True)
class PieceWork:
    """What all pieces of a run share; it is sent to the workers."""

    loaded: LoadedConfig
    cameras: tuple[Camera, ...]  # With their detectors
    log: Path  # Absolute
    unfinished: UnfinishedRun  # Absolute; holds the records of a piece, and that it is done
    threads: int

    def done(self, piece: LogPiece) -> Any:
        """Return the `PieceDone` of a piece; None if it is not finished."""
        return self.unfinished.read(_name(piece), PieceDone)


@dataclass(frozen=True)
class PieceDone:
    """A finished piece: its records, and the number of detections left out."""

    count: int  # Parts of the records
    not_invertible: int


def track_pieces(work: PieceWork, pieces: Sequence[LogPiece], jobs: int, dask: str | None, progress: Progress) -> None:
    """Track the pieces that are not finished.

    Raises InputError if the log is at fault, or no scheduler answers; StereophdError if the worker of a piece dies
    again and again, and finished pieces stay.
    """
    todo = [piece for piece in pieces if work.done(piece) is None]
    finished = len(pieces) - len(todo)

    def tick(done: float = 0, of: float = 0) -> None:
        progress(finished, len(pieces))

    with open_workers(jobs, dask) as workers:
        track = partial(track_piece, work, tick=ignore if workers.remote else tick)
        for number, result in complete(workers, track, todo):
            if result is None:
                raise StereophdError(
                    f"{work.log}: the worker of piece {todo[number].number} died {ATTEMPTS} times: is there enough "
                    "memory? finished pieces are kept: use `resume=True`"
                )
            finished += 1
            tick()


def track_piece(work: PieceWork, piece: LogPiece, tick: Progress = ignore) -> int:
    """Track one piece, and write its records; return their number."""
    tracking = build_tracking(work.loaded, work.threads, work.cameras)
    config = work.loaded.config
    reader = open_log(config.input, work.cameras, work.log, piece.begin_s)
    # without what the records of other pieces decide
    tracking = replace(tracking, report=config.report.model_copy(update={"min_track_length": 0.0}))
    # what is left out in the overlaps is counted by the pieces whose they are
    stream = EventStream(work.cameras, reader, tick, piece.begin_s, piece.end_s, (piece.from_s, piece.to_s))
    count, kept = 0, work.unfinished.parts(_name(piece))
    run = RunState(_numbered(tracking.estimator.init(), piece.events_before))
    for record in tracking.records(stream, run=run):
        keep_record(kept, record)
        count += 1
    work.unfinished.write(_name(piece), PieceDone(kept.flush(), stream.not_invertible))
    return count


def _name(piece: LogPiece) -> str:
    return f"piece-{piece.number:05d}"


def _numbered(state: Any, events: int) -> Any:
    """Return the first state of an estimator for a run whose first event has this number."""
    if isinstance(state, SingleTrackerState):
        return replace(state, estimator=replace(state.estimator, n_events=events))
    # a filter that draws no samples counts no events
    return replace(state, n_events=events) if hasattr(state, "n_events") else state


@dataclass
class JoinedPieces:
    """The records of all pieces as those of one run, and how sure the joins are."""

    work: PieceWork
    pieces: Sequence[LogPiece]  # All finished
    length_s: float
    overlap_s: float
    one_object: bool  # Whether there is one track only, number 0
    _joined: int = 0
    _uncertain: list[dict[str, Any]] = field(default_factory=list)
    _next_id: int = 0

    def records(self) -> Iterator[Record]:
        """Yield the records in order of time."""
        names: dict[int, int] = {}
        for piece in self.pieces:
            if piece.number > 0 and not self.one_object:
                names = self._names(self.pieces[piece.number - 1], piece, names)
            for record in self._records(piece, piece.from_s, piece.to_s):
                yield record if self.one_object else self._renamed(record, names, piece.number == 0)

    def lasting_records(self) -> Iterator[Record]:
        """Yield the records without tracks shorter than ``report.min_track_length``."""
        least = self.work.loaded.config.report.min_track_length
        return LastingTracks(least).records(self.records()) if least > 0.0 else self.records()

    @property
    def not_invertible(self) -> int:
        """Number of detections that were left out."""
        return sum(self.work.done(piece).not_invertible for piece in self.pieces)

    def report(self) -> dict[str, Any]:
        """Return the figures of the joins, for ``report.json``."""
        return {
            "count": len(self.pieces),
            "length_s": self.length_s,
            "overlap_s": self.overlap_s,
            "joined_tracks": self._joined,
            "uncertain_joins": self._uncertain,
        }

    def _records(self, piece: LogPiece, from_s: float, until_s: float) -> Iterator[Record]:
        return read_records(self.work.unfinished.parts(_name(piece), self.work.done(piece).count), from_s, until_s)

    def _names(self, earlier: LogPiece, later: LogPiece, names: Mapping[int, int]) -> dict[int, int]:
        """Return track of the later piece -> track of the run, for those that continue one."""
        before = list(self._records(earlier, later.begin_s, earlier.end_s))
        after = list(self._records(later, later.begin_s, earlier.end_s))
        keys = sorted({_key(record) for record in (*before, *after)})
        number = {key: k for k, key in enumerate(keys)}
        times = np.array([key[0] for key in keys])
        left, right = (
            trajectories_of(records, (number[_key(record)] for record in records), times) for records in (before, after)
        )
        pairs = join_probabilities(left, right, times, later.from_s, self.overlap_s / 4.0)
        found: dict[int, int] = {}
        rows = zip(pairs.before.tolist(), pairs.after.tolist(), pairs.probabilities.tolist(), strict=True)
        for i, j, probability in rows:
            earlier_id = names.get(left[i].track_id)
            if earlier_id is None:  # a track that begins after the join
                continue
            joined = probability > PROBABLE
            if joined:
                found[right[j].track_id] = earlier_id
                self._joined += 1
            if 1.0 - CERTAIN < probability < CERTAIN:
                self._uncertain.append(
                    {"time_s": later.from_s, "track_id": earlier_id, "probability": probability, "joined": joined}
                )
        return found

    def _renamed(self, record: Record, names: dict[int, int], first: bool) -> Record:
        """Return a record with the tracks of the run in place of those of the piece; the first one keeps its own."""

        def name(track_id: int) -> int:
            if track_id not in names:
                names[track_id] = track_id if first else self._next_id
            self._next_id = max(self._next_id, names[track_id] + 1)
            return names[track_id]

        filtered = record.filtered
        record = replace(record, filtered=None).renamed(name)
        if filtered is None:
            return record
        return replace(record, filtered=filtered.of_tracks(names.__contains__).renamed(name))


def _key(record: Record) -> tuple[float, str, bool]:
    """What an event or a time of the grid is called in both pieces."""
    return record.time_s, record.camera, record.is_event
