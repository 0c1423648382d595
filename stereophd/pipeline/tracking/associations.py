"""Which detections belong to which reported tracks (``associations.parquet``).

A filter claims detections for labels. A label is a track once it has been reported: its earlier claims wait until
then, and are forgotten with the label.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.multi.association.attribution import Claims, join_claims
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
    # What labels that were not reported yet claimed, an event each, in order of time: labels in the place of tracks.
    waiting: list[Associated] = field(default_factory=list)

    def update(self, event: Event, camera: str, claims: Claims | None) -> tuple[Associated, ...]:
        """Take in the claims of an event; return those of the labels that have been reported before it."""
        if claims is None or event.pixels is None or event.rows is None:
            return ()
        labels, detections, probabilities = join_claims(claims, LEAST_PROBABILITY)
        pixels, rows = event.pixels[detections], event.rows[detections]
        ids = np.array([self.known.get(label, -1) for label in labels.tolist()], dtype=np.int64)

        def claimed(chosen: Booleans, names: Integers) -> Associated:
            return Associated(
                event.time_s, camera, event.frame, pixels[chosen], rows[chosen], names[chosen], probabilities[chosen]
            )

        is_known = ids >= 0
        if not is_known.all():
            self.waiting.append(claimed(~is_known, labels))
        return (claimed(is_known, ids),) if is_known.any() else ()

    def report(self, estimates: Estimates) -> Iterator[Associated]:
        """Take in which labels are reported; yield the claims of those that had not been reported before."""
        for track_id, label in zip(estimates.track_ids.tolist(), estimates.labels.tolist(), strict=True):
            if label not in self.known:
                for claimed in self.waiting:
                    for row in np.flatnonzero(claimed.track_ids == label).tolist():
                        yield replace(claimed.take(np.array([row])), track_ids=np.array([track_id]))
            self.known[label] = track_id

    def keep(self, labels: Integers) -> None:
        """Forget all labels but these: memory does not grow with the log."""
        alive = set(labels.tolist())
        self.known = {label: track for label, track in self.known.items() if label in alive}
        new = alive - self.known.keys()
        self.waiting = [one for one in self.waiting if not new.isdisjoint(one.track_ids.tolist())]
