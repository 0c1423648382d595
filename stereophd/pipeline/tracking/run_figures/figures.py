"""Figures of a run of `stereophd.commands.track`: of all of it, of each camera and of each identity."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from stereophd.core.calibration.unknowns.considered import CommonPart
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.state.estimates import Estimates
from stereophd.pipeline.tracking.knocked import Knock
from stereophd.pipeline.tracking.loop import Record
from stereophd.pipeline.tracking.run_figures.explained import CameraSums


@dataclass
class Losses:
    """Events after which a bound left something out, and the most that it left out at once."""

    events: int = 0
    most: int = 0
    burst_frames: int = 0
    burst_detections: int = 0
    hypothesis_events: int = 0
    most_hypotheses: int = 0

    def add(self, record: Record) -> None:
        """Take in a record."""
        if not record.is_event:
            return
        info = record.info
        self.events += info.left_out > 0
        self.most = max(self.most, info.left_out)
        self.burst_frames += info.burst > 0
        self.burst_detections += info.burst
        self.hypothesis_events += info.hypotheses_left_out > 0
        self.most_hypotheses = max(self.most_hypotheses, info.hypotheses_left_out)


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
class RunFigures:
    """Figures of a run so far, and what waits for the next row of the table of events: all that is kept of them."""

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
    # Since the last row of the table of events: what happened between two reports belongs to the second.
    new_detections: int = 0
    new_log_likelihood: float = 0.0
    cameras_part: CommonPart | None = None  # Of what uncertain cameras add

    def add(self, record: Record, cameras: Mapping[str, Camera]) -> None:
        """Count a record, reported or not, of a run of these cameras."""
        self.losses.add(record)
        if record.knock is not None:
            self.knocks.append(record.knock)
        if record.is_event:
            self.events += 1
            self.first_s, self.last_s = (record.time_s if self.events == 1 else self.first_s), record.time_s
            sums = self.cameras.setdefault(record.camera, CameraSums())
            sums.frames += 1
            sums.detections += record.n_detections
            sums.outside += record.outside
        self.log_likelihood += record.info.log_likelihood
        self.new_detections += record.n_detections
        self.new_log_likelihood += record.info.log_likelihood
        for track_id, counts in record.attributed.items():
            total = self.detections.setdefault(track_id, {})
            for camera, count in counts.items():
                total[camera] = total.get(camera, 0) + count
        for sightings in record.associations:
            sums = self.cameras.setdefault(sightings.camera, CameraSums())
            sums.add(record, sightings, cameras[sightings.camera])

    def add_estimates(self, estimates: Estimates, time_s: float) -> None:
        """Count what is reported at a time, s."""
        self.confirmed += len(estimates.track_ids)
        if not len(estimates.track_ids):
            return
        speeds = np.sqrt(np.einsum("ni,ni->n", estimates.states[:, 3:], estimates.states[:, 3:]))
        stds = np.sqrt(np.trace(estimates.covariances[:, :3, :3], axis1=1, axis2=2))
        columns = (estimates.track_ids, estimates.existence, speeds, stds)
        for track_id, existence, speed, std in zip(*(column.tolist() for column in columns), strict=True):
            identity = self.identities.setdefault(track_id, IdentitySums(time_s, time_s))
            identity.last_s = time_s
            identity.n_estimates += 1
            identity.existence += existence
            identity.speed += speed
            identity.position_std += std

    def report(self, cameras: Mapping[str, Camera], reports: int, estimates: int) -> dict[str, Any]:
        """Return the figures of a run that wrote so many reports and so many estimates, tentative ones included."""
        common, other = (0.0, 0.0) if self.cameras_part is None else self.cameras_part.stds()
        return {
            "events": self.events,
            "duration_s": self.last_s - self.first_s,
            "reports": reports,
            "estimates": self.confirmed,
            "tentative_estimates": estimates - self.confirmed,
            "log_likelihood": self.log_likelihood,
            "left_out": asdict(self.losses),
            "cameras": {name: self.cameras.get(name, CameraSums()).report(camera) for name, camera in cameras.items()},
            "knocks": [asdict(knock) for knock in self.knocks],
            "tracks": [
                self._track(track_id, identity, cameras) for track_id, identity in sorted(self.identities.items())
            ],
            **({} if self.cameras_part is None else {"cameras_part": {"common_std": common, "other_std": other}}),
        }

    def _track(self, track_id: int, identity: IdentitySums, cameras: Iterable[str]) -> dict[str, Any]:
        detections = self.detections.get(track_id, {})
        return {
            "track_id": track_id,
            "first_s": identity.first_s,
            "last_s": identity.last_s,
            "n_estimates": identity.n_estimates,
            "n_detections": {camera: detections.get(camera, 0) for camera in cameras},
            "mean_existence": identity.existence / identity.n_estimates,
            "mean_speed": identity.speed / identity.n_estimates,
            "mean_position_std": identity.position_std / identity.n_estimates,
        }
