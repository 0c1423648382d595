"""Which detections the labels of a filter claimed in the last events."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.rolling import NO_READINGS, READING_COLUMNS
from stereophd.core.multi.association.attribution import UNDECIDED

# Events of which detections are kept; at twice as many, every second one of the older half is dropped.
KEPT_EVENTS = 32

_NO_POINT, _NO_NOISE = np.empty((0, 2)), np.empty((0, 2, 2))
# Of a camera that reads all rows at once, beside others that do not.
_AT_FRAME = np.zeros((1, READING_COLUMNS))


class ClaimedDetections(NamedTuple):
    """The detections of one event, and those that labels claim."""

    # `camera`, `time_s`: The event.
    camera: int
    time_s: float
    # `labels`, `detections`: arrays (k,) of int: Labels, and the detection that each claims or `UNDECIDED`.
    labels: Integers
    detections: Integers
    # `points`, `noises`: arrays (m, 2), (m, 2, 2): Undistorted pixels of all detections, and their covariances.
    points: Array
    noises: Array
    readings: Array  # (m, 3) or (0, 3): Those of `stereophd.core.disparity.events.Event`


class DeferredPairs(NamedTuple):
    """Pairs that are not tested for a while: rows (first label, second label, camera) (n, 3), and the event (n,) until.

    A pair is tested again from that event on.
    """

    pairs: Integers
    due: Integers

    def after(self, event: int) -> DeferredPairs:
        """Return those that still wait at an event."""
        waits = self.due > event
        return DeferredPairs(self.pairs[waits], self.due[waits])

    def add(self, pair: tuple[int, int, int], due: int) -> DeferredPairs:
        """Return these and one more."""
        return DeferredPairs(np.concatenate([self.pairs, [pair]]), np.append(self.due, due))


def no_deferred_pairs() -> DeferredPairs:
    """Return the deferred pairs of a run before its first event."""
    return DeferredPairs(np.empty((0, 3), dtype=np.int64), np.empty(0, dtype=np.int64))


@dataclass(frozen=True)
class History:
    """What the test needs of the events before."""

    sightings: tuple[ClaimedDetections, ...] = ()  # In order of time
    deferred: DeferredPairs = field(default_factory=no_deferred_pairs)

    def add(self, sighting: ClaimedDetections) -> History:
        """Return the history after one more event."""
        if not len(sighting.labels):
            return self
        sightings = self.sightings
        if len(sightings) == 2 * KEPT_EVENTS:
            sightings = _thinned(sightings[:KEPT_EVENTS]) + sightings[KEPT_EVENTS:]
        return History((*sightings, sighting), self.deferred)

    def rows_of(self, first: int, second: int, recent: int | None = None) -> ClaimedRows:
        """Return the kept detections of two labels, one row each, in order of time; of the last events only."""
        kept = self.sightings if recent is None else self.sightings[-recent:]
        labels = np.concatenate([one.labels for one in kept])
        detections = np.concatenate([one.detections for one in kept])
        claimed = np.flatnonzero(((labels == first) | (labels == second)) & (detections != UNDECIDED))
        ends = np.cumsum([len(one.labels) for one in kept])
        events = [kept[event] for event in np.searchsorted(ends, claimed, side="right").tolist()]
        rows = [(one, slice(k, k + 1)) for one, k in zip(events, detections[claimed].tolist(), strict=True)]
        rolling = any(len(one.readings) for one in events)
        return ClaimedRows(
            np.array([one.camera for one in events], dtype=np.int64),
            np.array([one.time_s for one in events], dtype=np.float64),
            labels[claimed],
            np.concatenate([_NO_POINT, *(one.points[row] for one, row in rows)]),
            np.concatenate([_NO_NOISE, *(one.noises[row] for one, row in rows)]),
            np.concatenate([one.readings[row] if len(one.readings) else _AT_FRAME for one, row in rows])
            if rolling
            else NO_READINGS,
        )

    def swapped(self, first: int, second: int, camera: int, others: bool = False) -> History:
        """Return the history in which two labels have the detections of a camera, or of all others, swapped."""
        return History(
            tuple(_swapped(one, first, second) if (one.camera == camera) != others else one for one in self.sightings),
            self.deferred,
        )


def _thinned(sightings: tuple[ClaimedDetections, ...]) -> tuple[ClaimedDetections, ...]:
    """Return every second event of each camera, and the first of all."""
    kept, seen = [], dict[int, int]()
    for one in sightings:
        number = seen.get(one.camera, 0)
        seen[one.camera] = number + 1
        if number % 2 == 0:
            kept.append(one)
    return tuple(kept)


def _swapped(sighting: ClaimedDetections, first: int, second: int) -> ClaimedDetections:
    labels = sighting.labels.copy()
    labels[sighting.labels == first], labels[sighting.labels == second] = second, first
    return sighting._replace(labels=labels)


class ClaimedRows(NamedTuple):
    """In order of time: cameras, times, labels (n,), points (n, 2), noises (n, 2, 2), readings (n, 3) or (0, 3)."""

    cameras: Integers
    times: Array
    labels: Integers
    points: Array
    noises: Array
    readings: Array

    def take(self, index: Integers) -> ClaimedRows:
        """Return some of the rows."""
        return ClaimedRows._make(values[index] if len(values) else values for values in self)
