"""Which detections belong to which reported tracks (``associations.parquet``).

A filter claims detections for labels. A label is a track once it has been reported: its earlier claims wait until
then, and are forgotten with the label.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.multi.association.attribution import Claims
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.numerics.rows import ArrayRows

# Claims of a smaller probability are left out.
LEAST_PROBABILITY = 1e-3


@dataclass(frozen=True)
class Associated(ArrayRows):
    """Detections of one event that tracks claim; one row a detection and track."""

    # `time_s`, `camera`, `frame`: The event.
    time_s: float
    camera: str
    frame: int
    pixels: Array  # (k, 2): As in the log, distorted
    rows: Integers  # (k,): Those of `Event`: a detection is known by its row
    track_ids: Integers  # (k,) of int: (Labels, as long as they are not reported.)
    probabilities: Array  # (k,): Probability that the object of the track exists and made the detection

    def columns(self) -> dict[str, Any]:
        """Columns of ``associations.parquet``."""
        return {
            "time_s": self.time_s,
            "camera": self.camera,
            "frame": self.frame,
            "u_px": self.pixels[:, 0],
            "v_px": self.pixels[:, 1],
            "track_id": self.track_ids,
            "probability": self.probabilities,
        }


@dataclass
class Associations:
    """Claims of labels until they are reported as tracks."""

    known: dict[int, int] = field(default_factory=dict)  # Label -> track of the labels that have been reported
    # Number of an event -> what was claimed in it, of events with claims that wait: thousands of labels may wait with
    # claims to one event.
    claimed: dict[int, Associated] = field(default_factory=dict)
    # Label -> (number of an event, row in it), of the labels that are not reported yet.
    pending: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    events: int = 0

    def update(self, event: Event, camera: str, claims: Claims | None) -> tuple[Associated, ...]:
        """Take in the claims of an event; return those of the labels that have been reported before it."""
        if claims is None or event.pixels is None or event.rows is None:
            return ()
        labels, places, probabilities = _joined(claims)
        if not len(labels):
            return ()
        found = Associated(
            event.time_s, camera, event.frame, event.pixels[places], event.rows[places], labels, probabilities
        )
        ids = np.array([self.known.get(label, -1) for label in labels.tolist()], dtype=np.int64)
        known = ids >= 0
        if not known.all():
            self.claimed[self.events] = found
            for row in np.flatnonzero(~known).tolist():
                self.pending.setdefault(int(labels[row]), []).append((self.events, row))
            self.events += 1
        return (replace(found.take(known), track_ids=ids[known]),) if known.any() else ()

    def report(self, estimates: Estimates) -> Iterator[Associated]:
        """Take in which labels are reported; yield the claims of those that had not been reported before."""
        for track_id, label in zip(estimates.track_ids.tolist(), estimates.labels.tolist(), strict=True):
            self.known[label] = track_id
            for event, row in self.pending.pop(label, ()):
                yield replace(self.claimed[event].take(np.array([row])), track_ids=np.array([track_id]))

    def keep(self, labels: Integers) -> None:
        """Forget all labels but these: memory does not grow with the log."""
        alive = set(labels.tolist())
        self.known = {label: track for label, track in self.known.items() if label in alive}
        self.pending = {label: rows for label, rows in self.pending.items() if label in alive}
        waiting = {event for rows in self.pending.values() for event, _ in rows}
        self.claimed = {event: found for event, found in self.claimed.items() if event in waiting}


def _joined(claims: Claims) -> tuple[Integers, Integers, Array]:
    """Return labels, detections and probabilities with the alternatives of a label added up, negligible ones left out.

    Rows are in order of detection, then of label.
    """
    kept = np.flatnonzero(claims.labels >= 0)
    order = kept[np.lexsort((claims.labels[kept], claims.detections[kept]))]
    labels, detections = claims.labels[order], claims.detections[order]
    if not len(order):
        return labels, detections, claims.probabilities[order]
    starts = np.flatnonzero(np.append(True, (np.diff(labels) != 0) | (np.diff(detections) != 0)))
    probabilities = np.add.reduceat(claims.probabilities[order], starts)
    probable = probabilities >= LEAST_PROBABILITY
    starts = starts[probable]
    return labels[starts], detections[starts], probabilities[probable]
