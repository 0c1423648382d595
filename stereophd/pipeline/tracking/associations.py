"""Which detections belong to which reported tracks (``associations.parquet``).

A filter claims detections for labels. A label is a track once it has been reported: its earlier claims wait until
then, and are forgotten with the label.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.multi.association.attribution import Claims
from stereophd.core.multi.state.estimates import Estimates

# Claims of a smaller probability are left out.
LEAST_PROBABILITY = 1e-3


@dataclass(frozen=True)
class Associated:
    """Detections of one event that tracks claim; one row a detection and track."""

    # `time_s`, `camera`, `frame`: The event.
    time_s: float
    camera: str
    frame: int
    pixels: Array  # (k, 2): As in the log, distorted
    rows: Integers  # (k,): Those of `Event`: a detection is known by its row
    track_ids: Integers  # (k,) of int: (Labels, as long as they are not reported.)
    probabilities: Array  # (k,): Probability that the object of the track exists and made the detection

    def take(self, kept: NDArray[Any]) -> Associated:
        """Return some of the rows."""
        return replace(
            self, pixels=self.pixels[kept], rows=self.rows[kept], track_ids=self.track_ids[kept],
            probabilities=self.probabilities[kept],
        )  # fmt: skip

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


class Associations:
    """Claims of labels until they are reported as tracks."""

    def __init__(
        self, known: Mapping[int, int] | None = None, pending: Mapping[int, list[tuple[Associated, int]]] | None = None
    ) -> None:
        self._known = dict(known or {})
        # label -> rows of the events that it claimed
        self._pending = {label: list(rows) for label, rows in (pending or {}).items()}

    def copy(self) -> Associations:
        """Return a copy that does not change when the run continues."""
        return Associations(self._known, self._pending)

    @property
    def known(self) -> Mapping[int, int]:
        """Label -> track of the labels that have been reported."""
        return self._known

    @property
    def pending(self) -> Mapping[int, list[tuple[Associated, int]]]:
        """Label -> its rows in the claims of events, of the labels that are not reported yet."""
        return self._pending

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
        ids = np.array([self._known.get(label, -1) for label in labels.tolist()], dtype=np.int64)
        known = ids >= 0
        for row in np.flatnonzero(~known).tolist():
            self._pending.setdefault(int(labels[row]), []).append((found, row))
        return (replace(found.take(known), track_ids=ids[known]),) if known.any() else ()

    def report(self, estimates: Estimates) -> Iterator[Associated]:
        """Take in which labels are reported; yield the claims of those that had not been reported before."""
        for track_id, label in zip(estimates.track_ids.tolist(), estimates.labels.tolist(), strict=True):
            self._known[label] = track_id
            for found, row in self._pending.pop(label, ()):
                yield replace(found.take(np.array([row])), track_ids=np.array([track_id]))

    def keep(self, labels: Integers) -> None:
        """Forget all labels but these: memory does not grow with the log."""
        alive = set(labels.tolist())
        self._known = {label: track for label, track in self._known.items() if label in alive}
        self._pending = {label: found for label, found in self._pending.items() if label in alive}


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
