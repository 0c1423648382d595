"""Figures of a run of `stereophd.commands.track`: of all of it, of each camera and of each identity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.pipeline.tracking.knocked import Knock
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.run_figures.explained import CameraSums, Explained


@dataclass
class Losses:
    """Events after which a bound left something out, and the most that it left out at once."""

    cut: int = 0
    most_left_out: int = 0
    bursts: int = 0
    burst_detections: int = 0
    crowded: int = 0
    most_hypotheses: int = 0

    def add(self, record: Record) -> None:
        """Take in a record."""
        if not record.is_event:
            return
        info = record.info
        self.cut += info.left_out > 0
        self.most_left_out = max(self.most_left_out, info.left_out)
        self.bursts += info.burst > 0
        self.burst_detections += info.burst
        self.crowded += info.hypotheses_left_out > 0
        self.most_hypotheses = max(self.most_hypotheses, info.hypotheses_left_out)

    def report(self) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        return {
            "events": self.cut,
            "most": self.most_left_out,
            "burst_frames": self.bursts,
            "burst_detections": self.burst_detections,
            "hypothesis_events": self.crowded,
            "most_hypotheses": self.most_hypotheses,
        }


@dataclass
class IdentitySums:
    """Running figures of one track."""

    first_s: float
    last_s: float
    n_estimates: int = 0
    existence: float = 0.0
    speed: float = 0.0
    position_std: float = 0.0


@dataclass
class FigureSums:
    """Figures of a run so far, all that `RunFigures` counts."""

    events: int = 0
    confirmed: int = 0
    log_likelihood: float = 0.0
    first_s: float = math.nan
    last_s: float = math.nan
    losses: Losses = field(default_factory=Losses)
    cameras: dict[str, CameraSums] = field(default_factory=dict)
    identities: dict[int, IdentitySums] = field(default_factory=dict)
    detections: dict[int, dict[str, int]] = field(default_factory=dict)  # Track -> camera -> number
    knocks: list[Knock] = field(default_factory=list)


class RunFigures:
    """Figures of a run for ``report.json``, counted as its records come.

    The cameras are in order, for the figures of each. `sums` is where the figures begin, and is kept up to date.
    """

    def __init__(self, cameras: Sequence[Camera], sums: FigureSums | None = None) -> None:
        self._cameras = cameras
        self._sums = FigureSums() if sums is None else sums
        self._explained = Explained(cameras, self._sums.cameras)

    def add(self, record: Record) -> None:
        """Count a record, reported or not."""
        sums = self._sums
        sums.losses.add(record)
        if record.knock is not None:
            sums.knocks.append(record.knock)
        if record.is_event:
            sums.events += 1
            sums.first_s, sums.last_s = (record.time_s if sums.events == 1 else sums.first_s), record.time_s
        sums.log_likelihood += record.info.log_likelihood
        for track_id, counts in record.attributed.items():
            total = sums.detections.setdefault(track_id, {})
            for camera, count in counts.items():
                total[camera] = total.get(camera, 0) + count
        self._explained.add(record)

    def add_estimates(self, estimates: Estimates, time_s: float) -> None:
        """Count what is reported at a time, s."""
        self._sums.confirmed += len(estimates.track_ids)
        if not len(estimates.track_ids):
            return
        speeds = np.sqrt(np.einsum("ni,ni->n", estimates.states[:, 3:], estimates.states[:, 3:]))
        stds = np.sqrt(np.trace(estimates.covariances[:, :3, :3], axis1=1, axis2=2))
        columns = (estimates.track_ids, estimates.existence, speeds, stds)
        for track_id, existence, speed, std in zip(*(column.tolist() for column in columns), strict=True):
            identity = self._sums.identities.setdefault(track_id, IdentitySums(time_s, time_s))
            identity.last_s = time_s
            identity.n_estimates += 1
            identity.existence += existence
            identity.speed += speed
            identity.position_std += std

    def report(self, reports: int, estimates: int) -> dict[str, Any]:
        """Return the figures of a run that wrote so many reports and so many estimates, tentative ones included."""
        return {
            "events": self._sums.events,
            "duration_s": self._sums.last_s - self._sums.first_s,
            "reports": reports,
            "estimates": self._sums.confirmed,
            "tentative_estimates": estimates - self._sums.confirmed,
            "log_likelihood": self._sums.log_likelihood,
            "left_out": self._sums.losses.report(),
            "cameras": self._explained.report(),
            "knocks": [asdict(knock) for knock in self._sums.knocks],
            "tracks": [self._track(track_id, identity) for track_id, identity in sorted(self._sums.identities.items())],
        }

    def _track(self, track_id: int, identity: IdentitySums) -> dict[str, Any]:
        detections = self._sums.detections.get(track_id, {})
        return {
            "track_id": track_id,
            "first_s": identity.first_s,
            "last_s": identity.last_s,
            "n_estimates": identity.n_estimates,
            "n_detections": {camera.name: detections.get(camera.name, 0) for camera in self._cameras},
            "mean_existence": identity.existence / identity.n_estimates,
            "mean_speed": identity.speed / identity.n_estimates,
            "mean_position_std": identity.position_std / identity.n_estimates,
        }
