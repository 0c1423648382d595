"""Records of a live run, smoothed with a fixed lag: each comes once the recording has gone on for so long."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.smoothing import Trajectory, smooth
from stereophd.pipeline.tracking.loop import Record

# Part of the lag after which records are smoothed again.
HOP = 0.25


class LaggedRecords:
    """Smooths the records of a run when the recording is `lag_s` past them."""

    def __init__(self, motion: Motion, lag_s: float) -> None:
        self._motion, self._lag_s = motion, lag_s
        self._until_s = -math.inf  # Records before this have been yielded

    @property
    def span_s(self) -> float:
        """How long records are needed, s."""
        return (1.0 + 2.0 * HOP) * self._lag_s

    def is_due(self, newest_s: float) -> bool:
        """Whether records are due when the recording has come to a time."""
        return newest_s - self._lag_s >= self._until_s + HOP * self._lag_s

    def take(self, records: Sequence[Record], newest_s: float) -> Iterator[Record]:
        """Yield those of the records, in order of time, that are due then; at infinity all that are left."""
        waiting = [record for record in records if record.time_s >= self._until_s]
        self._until_s = newest_s - self._lag_s
        smoothed = smoothed_estimates(waiting, self._motion)
        yield from (record for record in smoothed if record.time_s < self._until_s)


def smoothed_estimates(records: Sequence[Record], motion: Motion) -> list[Record]:
    """Return records with the confirmed tracks smoothed among them (Rauch, Tung and Striebel 1965)."""
    places: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for number, record in enumerate(records):
        for row, track_id in enumerate(record.estimates.track_ids.tolist()):
            places[track_id].append((number, row))
    states = [record.estimates.states.copy() for record in records]
    covariances = [record.estimates.covariances.copy() for record in records]
    for track_id, rows in places.items():
        trajectory = Trajectory(
            track_id,
            np.array([number for number, _ in rows]),
            np.array([records[number].time_s for number, _ in rows]),
            np.array([states[number][row] for number, row in rows]),
            np.array([covariances[number][row] for number, row in rows]),
            np.ones(len(rows)),
        )
        found = smooth(trajectory, motion)
        for (number, row), state, covariance in zip(rows, found.states, found.covariances, strict=True):
            states[number][row], covariances[number][row] = state, covariance
    return [
        replace(record, estimates=replace(record.estimates, states=state, covariances=covariance))
        for record, state, covariance in zip(records, states, covariances, strict=True)
    ]
