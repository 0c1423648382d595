"""What annealed calibration works on and brings forth: the task, a fit of cameras and trajectories, a start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.adjustment import Adjustment, Observations
from stereophd.core.calibration.association import Scans
from stereophd.core.calibration.pairing import TrackPairs, make_pairs, one_camera_tracks
from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.scale import ScaleMeasurement
from stereophd.core.calibration.trajectories import Knots
from stereophd.core.multi.pmb import PmbFilter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SUCCEEDED = "succeeded"


@dataclass(frozen=True)
class AnnealedSettings:
    """Parameters of the method; see `stereophd.config.calibration.AnnealedConfig`."""

    starts: int = 8
    agreeing_starts: int = 2
    inflation: tuple[float, ...] = (7.0, 5.0, 3.5, 2.0, 1.4, 1.0)
    min_detections: int = 16
    min_tracked: float = 0.5


@dataclass(frozen=True)
class Task:
    """What a start needs.

    Attributes
    ----------
    parameters : ParameterSet
    reference : int
        Index of the reference camera.
    filter : PmbFilter
        Template; its cameras are replaced.
    scans : Scans
        All events.
    tracking : Scans
        Those that are tracked: all, or a part of a long log.
    tracks : tuple of (int, array)
        One-camera tracks among those events: camera and detections.
    pairs : TrackPairs
        Which of them may be one object.
    scale : ScaleMeasurement or None
    settings : AnnealedSettings
    """

    parameters: ParameterSet
    reference: int
    filter: PmbFilter
    scans: Scans
    tracking: Scans
    tracks: tuple[tuple[int, Integers], ...]
    pairs: TrackPairs
    scale: ScaleMeasurement | None
    settings: AnnealedSettings

    @property
    def followed(self) -> float:
        """Share of the tracked events' detections that one-camera tracks hold."""
        return sum(len(detections) for _, detections in self.tracks) / max(len(self.tracking.points), 1)

    @staticmethod
    def of(
        parameters: ParameterSet,
        reference: int,
        multi_filter: PmbFilter,
        scans: Scans,
        tracking: Scans,
        scale: ScaleMeasurement | None,
        settings: AnnealedSettings,
    ) -> Task:
        """Prepare what all starts share: the tracks that each camera has by itself."""
        tracks = one_camera_tracks(multi_filter, tracking, settings.min_detections)
        pairs = make_pairs(parameters, tracking, tracks)
        return Task(parameters, reference, multi_filter, scans, tracking, tuple(tracks), pairs, scale, settings)


@dataclass(frozen=True)
class Fit:
    """Cameras and trajectories after an adjustment, with the detections they were adjusted to."""

    adjustment: Adjustment
    knots: Knots
    observations: Observations
    detections: Integers


@dataclass(frozen=True)
class Start:
    """Outcome of one start.

    Attributes
    ----------
    number : int
    outcome : str
        `SUCCEEDED`, or why not.
    start : array (m,)
        Values it began with.
    passes : array (p, m)
        Values after every pass.
    fit : Fit or None
        The last one.
    log_evidence, log_prior : float
        At the last values; NaN where the start failed.
    explained : float
        Detections of shared trajectories, in parts of those not expected to be false.
    """

    number: int
    outcome: str
    start: Array
    passes: Array
    fit: Fit | None
    log_evidence: float
    log_prior: float
    explained: float

    @property
    def succeeded(self) -> bool:
        """Whether the start found cameras that agree with the data."""
        return self.outcome == SUCCEEDED

    @property
    def score(self) -> float:
        """Evidence plus log-prior."""
        return self.log_evidence + self.log_prior
