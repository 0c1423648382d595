"""Figures of a run of `stereophd.commands.track`: of all of it, of each camera and of each identity."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.io.outputs.columns import pack_counts, unpack_counts
from stereophd.pipeline.tracking.explained import CameraSums, Explained
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.losses import Losses


@dataclass
class _Identity:
    """Running figures of one track."""

    first_s: float
    last_s: float
    n_estimates: int = 0
    existence: float = 0.0
    speed: float = 0.0
    position_std: float = 0.0


@dataclass(frozen=True)
class SavedFigures:
    """`RunFigures` for a checkpoint."""

    # Of the whole run.
    events: int
    confirmed: int
    log_likelihood: float
    first_s: float
    last_s: float
    losses: Losses
    explained: dict[str, CameraSums]  # Camera -> sums
    # `track_ids`, `identities`: (n,), array (n, 6): Running figures of each track.
    track_ids: NDArray[np.int64]
    identities: NDArray[np.float64]
    # Track -> camera -> detections, as `stereophd.io.outputs.columns.pack_counts` returns them.
    detections: dict[str, Any]


class RunFigures:
    """Figures of a run for ``report.json``, counted as its records come.

    Parameters
    ----------
    cameras : sequence of Camera
        In order, for the figures of each camera.
    saved : SavedFigures, optional
        Where the figures begin.
    """

    def __init__(self, cameras: Sequence[Camera], saved: SavedFigures | None = None) -> None:
        self._cameras = cameras
        self._explained, self._losses = Explained(cameras), Losses()
        self._identities: dict[int, _Identity] = {}
        self._detections: dict[int, Counter[str]] = {}
        self._events, self._confirmed, self._log_likelihood = 0, 0, 0.0
        self._first_s, self._last_s = math.nan, math.nan
        if saved is not None:
            self._begin_at(saved)

    def _begin_at(self, saved: SavedFigures) -> None:
        self._explained, self._losses = Explained(self._cameras, saved.explained), saved.losses
        for track_id, row in zip(saved.track_ids.tolist(), saved.identities.tolist(), strict=True):
            first_s, last_s, count, *sums = row
            self._identities[track_id] = _Identity(first_s, last_s, int(count), *sums)
        self._detections = {track: Counter(counts) for track, counts in unpack_counts(saved.detections).items()}
        self._events, self._confirmed, self._log_likelihood = saved.events, saved.confirmed, saved.log_likelihood
        self._first_s, self._last_s = saved.first_s, saved.last_s

    def saved(self) -> SavedFigures:
        """Return the figures for a checkpoint."""
        identities = [
            (one.first_s, one.last_s, one.n_estimates, one.existence, one.speed, one.position_std)
            for one in self._identities.values()
        ]
        return SavedFigures(
            self._events, self._confirmed, self._log_likelihood, self._first_s, self._last_s, self._losses,
            self._explained.saved(), np.array(list(self._identities), dtype=np.int64),
            np.array(identities, dtype=np.float64).reshape(-1, 6), pack_counts(self._detections),
        )  # fmt: skip

    def add(self, record: Record) -> None:
        """Count a record, reported or not."""
        self._losses.add(record)
        if record.is_event:
            self._events += 1
            self._first_s, self._last_s = (record.time_s if self._events == 1 else self._first_s), record.time_s
        self._log_likelihood += record.info.log_likelihood
        for track_id, counts in record.attributed.items():
            self._detections.setdefault(track_id, Counter()).update(counts)
        self._explained.add(record)

    def add_estimates(self, estimates: Estimates, time_s: float) -> None:
        """Count what is reported at a time, s."""
        self._confirmed += len(estimates.track_ids)
        if not len(estimates.track_ids):
            return
        speeds = np.sqrt(np.einsum("ni,ni->n", estimates.states[:, 3:], estimates.states[:, 3:]))
        stds = np.sqrt(np.trace(estimates.covariances[:, :3, :3], axis1=1, axis2=2))
        columns = (estimates.track_ids, estimates.existence, speeds, stds)
        for track_id, existence, speed, std in zip(*(column.tolist() for column in columns), strict=True):
            identity = self._identities.setdefault(track_id, _Identity(time_s, time_s))
            identity.last_s = time_s
            identity.n_estimates += 1
            identity.existence += existence
            identity.speed += speed
            identity.position_std += std

    def report(self, reports: int, estimates: int) -> dict[str, Any]:
        """Return the figures of a run that wrote so many reports and so many estimates, tentative ones included."""
        return {
            "events": self._events,
            "duration_s": self._last_s - self._first_s,
            "reports": reports,
            "estimates": self._confirmed,
            "tentative_estimates": estimates - self._confirmed,
            "log_likelihood": self._log_likelihood,
            "left_out": self._losses.report(),
            "cameras": self._explained.report(),
            "tracks": [self._track(track_id, identity) for track_id, identity in sorted(self._identities.items())],
        }

    def _track(self, track_id: int, identity: _Identity) -> dict[str, Any]:
        detections = self._detections.get(track_id, Counter())
        return {
            "track_id": track_id,
            "first_s": identity.first_s,
            "last_s": identity.last_s,
            "n_estimates": identity.n_estimates,
            "n_detections": {camera.name: detections[camera.name] for camera in self._cameras},
            "mean_existence": identity.existence / identity.n_estimates,
            "mean_speed": identity.speed / identity.n_estimates,
            "mean_position_std": identity.position_std / identity.n_estimates,
        }
