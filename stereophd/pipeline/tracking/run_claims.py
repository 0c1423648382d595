"""Which tracks claim which detections of a whole run, as one table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.rows import ArrayRows
from stereophd.core.trajectories.chain import NONE, WholeRun
from stereophd.core.trajectories.smoothing import Trajectory
from stereophd.pipeline.tracking.associations import LEAST_PROBABILITY, Associated
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.run_figures.explained import PROBABLE


@dataclass(frozen=True)
class RunClaims(ArrayRows):
    """Detections of a run that tracks claim; one row a detection and track."""

    detections: Integers  # (k,), their numbers in the run
    track_ids: Integers  # (k,)
    probabilities: Array  # (k,)

    def renamed(self, name: Callable[[int], int]) -> RunClaims:
        """Return the rows with other names of their tracks."""
        ids, places = np.unique(self.track_ids, return_inverse=True)
        names = np.array([name(one) for one in ids.tolist()], dtype=np.int64)
        return replace(self, track_ids=names[places])

    def without(self, track_ids: Integers, events: Integers, run: WholeRun) -> RunClaims:
        """Return the rows without those of tracks (n,) at events (n,)."""
        pairs = set(zip(track_ids.tolist(), events.tolist(), strict=True))
        own = zip(self.track_ids.tolist(), run.event_of(self.detections).tolist(), strict=True)
        return self.take(np.array([pair not in pairs for pair in own], dtype=np.bool_))

    def reduced(self, sure: RunClaims) -> RunClaims:
        """Return the rows reduced so that all rows of a detection, with others that are sure, add up to at most 1.

        They share what the others leave; the negligible ones are left out.
        """
        count = 1 + int(max(sure.detections.max(initial=NONE), self.detections.max(initial=NONE)))
        taken, wanted = (np.bincount(one.detections, one.probabilities, count) for one in (sure, self))
        room = np.maximum(1.0 - taken, 0.0) / np.maximum(wanted, LEAST_PROBABILITY)
        reduced = replace(self, probabilities=self.probabilities * np.minimum(room[self.detections], 1.0))
        return reduced.take(reduced.probabilities >= LEAST_PROBABILITY)

    def detections_of(self, track: Trajectory, run: WholeRun) -> Integers:
        """Return the detection (k,) that a track has at each of its events, or `NONE`."""
        out = np.full(len(track.events), NONE)
        own = self.detections[(self.track_ids == track.track_id) & (self.probabilities > PROBABLE)]
        events = run.event_of(own)
        places = np.minimum(np.searchsorted(track.events, events), len(track.events) - 1)
        there = track.events[places] == events
        out[places[there]] = own[there]
        return out

    def by_record(self, whole: Sequence[Record], run: WholeRun) -> list[tuple[Associated, ...]]:
        """Return the rows of each record, in order of detection, then of track; those of one pair are added up."""
        order = np.lexsort((self.track_ids, self.detections))
        detections, ids = self.detections[order], self.track_ids[order]
        firsts = np.flatnonzero((np.diff(detections, prepend=NONE) != 0) | (np.diff(ids, prepend=NONE) != 0))
        sums = np.add.reduceat(self.probabilities[order], firsts) if len(firsts) else np.empty(0)
        detections, ids = detections[firsts], ids[firsts]
        bounds = np.searchsorted(detections, run.starts).tolist()
        out: list[tuple[Associated, ...]] = []
        for number, record in enumerate(whole):
            rows, event = slice(bounds[number], bounds[number + 1]), record.event
            if rows.start == rows.stop or event is None or event.pixels is None:
                out.append(())
                continue
            own = detections[rows]
            pixels = event.pixels[own - run.starts[number]]
            out.append(
                (Associated(record.time_s, record.camera, record.frame, pixels, run.rows[own], ids[rows], sums[rows]),)
            )
        return out


def claims_of_run(whole: Sequence[Record], run: WholeRun) -> RunClaims:
    """Return what the records of a run claim."""
    parts = [one for record in whole for one in record.associations]
    rows = np.concatenate([np.empty(0, dtype=np.int64), *(one.rows for one in parts)])
    order = np.argsort(run.rows, kind="stable")
    return RunClaims(
        order[np.searchsorted(run.rows[order], rows)],
        np.concatenate([np.empty(0, dtype=np.int64), *(one.track_ids for one in parts)]),
        np.concatenate([np.empty(0), *(one.probabilities for one in parts)]),
    )
