"""Records of a live run, smoothed with a fixed lag: each comes once the recording has gone on for so long."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from stereophd.core.motion.base import Motion
from stereophd.core.trajectories.smoothing import smooth
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.smoothed import trajectories_of

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
    times = np.array([record.time_s for record in records])
    rows = [{track_id: row for row, track_id in enumerate(one.estimates.track_ids.tolist())} for one in records]
    states = [record.estimates.states.copy() for record in records]
    covariances = [record.estimates.covariances.copy() for record in records]
    for trajectory in trajectories_of(records, range(len(records)), times):
        found = smooth(trajectory, motion)
        for number, state, covariance in zip(found.events.tolist(), found.states, found.covariances, strict=True):
            row = rows[number][trajectory.track_id]
            states[number][row], covariances[number][row] = state, covariance
    return [
        replace(record, estimates=replace(record.estimates, states=state, covariances=covariance))
        for record, state, covariance in zip(records, states, covariances, strict=True)
    ]
