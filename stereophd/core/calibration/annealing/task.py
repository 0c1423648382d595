"""What annealed calibration works on and returns: the task, a fit of cameras and trajectories, a start."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Self

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.noise import weights_of
from stereophd.core.calibration.adjustment.problem import Observations
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.adjustment.trajectories import Knots, MotionNoise
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.pairing.track_pairs import TrackPairs, make_pairs, one_camera_tracks
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.calibration.time_limit import ENDLESS, TimeLimit
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.pmb.filter import PmbFilter

SUCCEEDED = "succeeded"
# Most starts by default: where poses alone are unknown, and otherwise.
STARTS_OF_POSES, STARTS = 24, 8
# Where the passes of a start began: a pairing of one-camera tracks, or the start's own values at the widest noise.
PAIRING, WIDE = "pairing", "wide"
# A stretch of a log lasts this many times as long as the shortest track that is used, and as clocks may be apart by
# the standard deviations of their priors.
STRETCH = 4.0


def parts_of(
    recording: Recording, settings: AnnealedSettings, parameters: ParameterSet
) -> list[tuple[Recording, Integers]]:
    """Return the parts of a recording that may be worked on, and which of their frames are tracked.

    The whole, unless it has more frames or detections than the settings allow; then instants that are spread over it,
    of which those that are tracked may be fewer, and stretches of the full rate, unless clocks are too far apart.
    """
    frames, detections = len(recording.cameras), len(recording.pixels)
    fitted, tracked = settings.max_detections / max(detections, 1), settings.max_events / max(frames, 1)
    spread = recording.part(recording.spread(fitted))
    parts = [(spread, spread.spread(settings.max_events / max(len(spread.cameras), 1)))]
    share = min(fitted, tracked)
    if share >= 1.0 or not frames:
        return parts
    apart = float(parameters.clock_offset_stds.max(initial=0.0))
    period = float(recording.periods(len(parameters.cameras)).max())
    length = STRETCH * max(settings.min_detections, apart / period if period > 0.0 else 0.0)
    if length * period <= share * float(recording.times[-1] - recording.times[0]):
        stretches = recording.part(recording.spread(share, length))
        parts.append((stretches, np.arange(len(stretches.cameras))))
    return parts


@dataclass(frozen=True)
class Task:
    """What a start needs."""

    parameters: ParameterSet
    reference: int  # Index of the reference camera
    filter: PmbFilter  # Template; its cameras are replaced
    recording: Recording
    frames: Integers  # Frames of the recording that are tracked: all, or a part of a long log
    # `scans`, `tracking`: Events of all frames and of those that are tracked, by the cameras of the prior mean.
    scans: Scans
    tracking: Scans
    # One-camera tracks among the tracked frames: camera and detections of the recording.
    tracks: tuple[tuple[int, Integers], ...]
    pairs: TrackPairs  # Which of them may be one object
    scale: ScaleMeasurement | None
    settings: AnnealedSettings
    limit: TimeLimit = ENDLESS
    threads: int = 1  # Of what is computed side by side from an answer
    # (c,): Part of the noise's variance that detections of a cell share (`adjustment.noise`); default none.
    shared: Array | None = None
    history_times: Array | None = None  # (t,): Of the history, before its end, s; default as `fits.history_of` says

    @property
    def most_starts(self) -> int:
        """Largest number of starts."""
        if self.settings.starts is not None:
            return self.settings.starts
        return STARTS_OF_POSES if self.parameters.only_poses else STARTS

    @property
    def followed(self) -> float:
        """Share of the tracked events' detections that one-camera tracks hold."""
        return sum(len(detections) for _, detections in self.tracks) / max(len(self.tracking.points), 1)

    @classmethod
    def of(
        cls,
        parameters: ParameterSet,
        reference: int,
        multi_filter: PmbFilter,
        recording: Recording,
        scale: ScaleMeasurement | None,
        settings: AnnealedSettings,
    ) -> Self:
        """Prepare what all starts share: the one-camera tracks of each camera.

        Of a long log that part is worked on that has more detections to fit in these: instants that are spread over the
        log hold objects that stay, stretches of it those that are seen briefly.
        """
        tried: list[tuple[float, Recording, Integers, Scans, Scans, tuple[tuple[int, Integers], ...]]] = []
        for part, frames in parts_of(recording, settings, parameters):
            if tried and len(part.pixels) <= tried[0][0]:
                continue  # no tracks in it can hold more
            scans = Scans.of(part, parameters.cameras)
            tracking = scans if len(frames) == len(scans.times) else Scans.of(part, parameters.cameras, frames)
            tracks = one_camera_tracks(multi_filter, tracking, settings)
            followed = sum(len(rows) for _, rows in tracks) / max(len(tracking.points), 1)
            tried.append((followed * len(part.pixels), part, frames, scans, tracking, tracks))
        _, part, frames, scans, tracking, tracks = max(tried, key=itemgetter(0))
        pairs = make_pairs(parameters, tracking, tracks)
        return cls(
            parameters, reference, multi_filter, part, frames, scans, tracking, tracks, pairs, scale, settings
        )  # fmt: skip

    def with_noise(self, factors: Array | float, shared: Array | None = None) -> Self:
        """Return the task with the noise of each camera's detections times factors (c,) or one, a part `shared`."""
        factors = np.broadcast_to(np.asarray(factors, dtype=np.float64), len(self.parameters.cameras))
        recording, cameras = self.recording.with_noise(factors), self.parameters.cameras
        scans = Scans.of(recording, cameras)
        tracking = scans if self.tracking is self.scans else Scans.of(recording, cameras, self.frames)
        return replace(self, recording=recording, scans=scans, tracking=tracking, shared=shared)

    def all_scans(self, cameras: Sequence[Camera]) -> Scans:
        """Return the events of all frames by these cameras."""
        return self.scans if self.parameters.same_events else Scans.of(self.recording, cameras)

    def tracked_scans(self, cameras: Sequence[Camera]) -> Scans:
        """Return the events of the tracked frames by these cameras."""
        return self.tracking if self.parameters.same_events else Scans.of(self.recording, cameras, self.frames)

    def observations(
        self, cameras: Sequence[Camera], trajectories: Integers, detections: Integers, inflation: float = 1.0
    ) -> Observations:
        """Return detections of the recording that belong to trajectories, timed by cameras, their noise inflated.

        Those that share an error count less.
        """
        observations = self.recording.observations(cameras, trajectories, detections, inflation)
        if self.shared is None or not self.shared.any():
            return observations
        weights = weights_of(observations, self.shared, self.settings.shared_error_px)
        return replace(observations, weights=weights)


@dataclass(frozen=True)
class Fit:
    """Cameras and trajectories after an adjustment, with the detections of the recording they were adjusted to.

    The knots have the noise of the motion that was found. `held` (m,) are the values that the adjustment did not move;
    None if it moved all. Other fits look for the noise of the motion from that of the adjustment.
    """

    adjustment: Adjustment
    knots: Knots
    observations: Observations
    detections: Integers
    held: NDArray[np.bool_] | None = None

    @property
    def motion_factors(self) -> Array:
        """Noise of the motion along the axes of the world (3,) over what is stated."""
        return MotionNoise.of(self.adjustment.motion_noise, np.ones(3)).std


@dataclass(frozen=True)
class Start:
    """Outcome of one start."""

    number: int
    outcome: str  # `SUCCEEDED`, or why not
    passes: Array  # (p, m): Values after every pass
    fit: Fit | None  # The last one
    # `log_evidence`, `log_prior`: At the last values; NaN where the start failed. The evidence is also NaN while all
    # starts that succeeded agree (`starts.compared`).
    log_evidence: float
    log_prior: float
    explained: float  # Detections of shared trajectories, in parts of those not expected to be false
    origin: str  # Where the passes began: `PAIRING` and its number, or `WIDE`
    pairing: Pairing | None = None  # That pairing

    @property
    def succeeded(self) -> bool:
        """Whether the start found cameras that agree with the data."""
        return self.outcome == SUCCEEDED

    @property
    def score(self) -> float:
        """Evidence plus log-prior."""
        return self.log_evidence + self.log_prior

    def with_pass(self, fit: Fit) -> Self:
        """Return the start after a further pass."""
        return replace(self, passes=np.vstack([self.passes, fit.adjustment.values]), fit=fit)
