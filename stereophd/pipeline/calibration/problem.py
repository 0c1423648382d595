"""The problem of a calibration, its run and its outcome; the filters of its configuration."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from stereophd.config.calibration import BaselineScale, CalibrationConfig
from stereophd.config.loading import LoadedConfig
from stereophd.core.alignment.to_points import ControlPoints
from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.adjustment.track_moves import TrackMoves
from stereophd.core.calibration.annealing.control import World, WorldControl
from stereophd.core.calibration.annealing.fits import HistoryRow
from stereophd.core.calibration.annealing.method import SAID_FACTOR, Remark
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.time_limit import ENDLESS, TimeLimit
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.errors import InputError, unknown_camera
from stereophd.pipeline.build import build_filter, with_filter
from stereophd.pipeline.calibration.configured_unknowns import build_parameters, calibration_section
from stereophd.pipeline.checks.log.sample import CameraSample, sample_log
from stereophd.pipeline.control import read_control
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.pipeline.runs.sizes import Size
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.stream import covered, open_stream
from stereophd.validated import NO_LENGTH
from stereophd.wording import instant


@dataclass(frozen=True)
class CalibrationProblem:
    """The unknowns of a calibration and the data that constrain them."""

    parameters: ParameterSet
    reference: int  # Index of the reference camera
    recording: Recording  # The log
    scale: ScaleMeasurement | None  # A known baseline
    counts: dict[str, int]  # Counts of the log, as in ``report.json``
    remarks: tuple[Remark, ...] = ()  # What of the configuration the log replaces
    control: WorldControl | None = None
    noise_in_log: bool = False  # Whether the log states the noise of every detection

    def scans(self) -> Scans:
        """Return the events by the cameras of the prior mean."""
        return Scans.of(self.recording, self.parameters.cameras)


@dataclass(frozen=True)
class CalibrationRun:
    """A problem with its configuration, and how it is worked on."""

    loaded: LoadedConfig
    problem: CalibrationProblem
    unfinished: UnfinishedRun
    jobs: int = 1  # Processes, or threads of particles
    progress: Progress = ignore
    limit: TimeLimit = ENDLESS
    is_searched: bool = False  # Whether no pose was known, and all were found before
    history_times: Array | None = None  # As in a `Task`

    @property
    def section(self) -> CalibrationConfig:
        """The ``calibration`` section."""
        return calibration_section(self.loaded)


@dataclass(frozen=True)
class Outcome:
    """The result of a method."""

    parameters: ParameterSet  # The unknowns of the result: those of the problem, and what was contradicted and freed
    # `values`, `covariance`: arrays (m,), (m, m): Mean (or optimum) and covariance; NaN where nothing agrees with the
    # data.
    values: Array
    covariance: Array
    # `particles`, `log_weights`: arrays (k, m), (k,): Posterior as particles.
    particles: Array
    log_weights: Array
    history: tuple[HistoryRow, ...]
    reason: str = ""  # Why nothing was found; empty if something was
    doubt: str = ""  # Why the posterior is not to be trusted; empty if it may be
    fit: Fit | None = None  # Trajectories and residuals, of method annealed
    remarks: tuple[Remark, ...] = ()  # On the answer, for the report
    moves: TrackMoves | None = None  # How tracks move with the values, of method annealed
    world: World | None = None  # That of the control track
    details: dict[str, Any] = field(default_factory=dict)  # For the report
    noise: Array | float = 1.0  # That of the cameras of the result over that of the detectors, (c,) or of all

    @classmethod
    def of_none(cls, parameters: ParameterSet, reason: str, details: dict[str, Any] | None = None) -> Self:
        """Return the outcome where nothing was found that agrees with the data."""
        nothing = np.full((parameters.size,) * 2, np.nan)
        return cls(parameters, nothing[0], nothing, nothing[:0], np.empty(0), (), reason, details=details or {})

    def build_cameras(self) -> tuple[Camera, ...]:
        """Return the cameras of the result, with the noise that the residuals show where what is stated is wrong."""
        cameras = self.parameters.build(self.values)
        return tuple(
            camera.with_noise(factor * camera.detector.sigma)
            for camera, factor in zip(cameras, np.broadcast_to(self.noise, len(cameras)).tolist(), strict=True)
        )


def build_scale(loaded: LoadedConfig, parameters: ParameterSet) -> ScaleMeasurement | None:
    """Return a known baseline as a measurement; None if another length is known, or none.

    Raises InputError for a name that no camera has, or one camera twice.
    """
    scale = calibration_section(loaded).scale
    if not isinstance(scale, BaselineScale):
        return None
    names = [camera.name for camera in parameters.cameras]
    first, second = scale.cameras
    where = f"{loaded.path}: calibration.scale.cameras"
    for name in (first, second):
        if name not in names:
            raise InputError(f"{where}: {unknown_camera(name, names)}")
    if first == second:
        raise InputError(f"{where}: expected two cameras, found {first} twice")
    return ScaleMeasurement("baseline", scale.distance, scale.std, (names.index(first), names.index(second)))


def read_problem(loaded: LoadedConfig, log_path: Path | str, is_placed: bool = True) -> CalibrationProblem:
    """Read a log, and check that it can constrain the unknown cameras; `is_placed` if poses and clocks are stated.

    The noise of a camera is what its tracks show, where that is far more than the configuration states.

    Raises InputError as `build_parameters` does, and when the log is not usable, or an unknown camera saw nothing, or
    not while another did.
    """
    parameters, reference = build_parameters(loaded)
    scale = build_scale(loaded, parameters)
    stream = open_stream(loaded.config, parameters.cameras, log_path)
    frames = list(covered(parameters.cameras, stream.frames, stream.source))
    cameras, remarks = parameters.cameras, tuple[Remark, ...]()
    if not stream.has_noise:
        cameras, remarks = _with_shown_noise(sample_log(frames, cameras))
    parameters = replace(parameters, cameras=cameras)
    recording = Recording.of(parameters.cameras, [(f.camera, f.time_s, f.pixels, f.sigma) for f in frames])
    _check_overlap(parameters, recording, log_path, is_placed)
    counts = {**stream.counts, "not_invertible": recording.not_invertible(parameters.cameras)}
    _check_method(loaded, parameters)
    return CalibrationProblem(
        parameters, reference, recording, scale, counts, remarks, build_control(loaded, cameras), stream.has_noise
    )


def _with_shown_noise(samples: list[CameraSample]) -> tuple[tuple[Camera, ...], tuple[Remark, ...]]:
    """Return the cameras, with the noise that their tracks show beyond doubt where it is far more, and what to say."""
    cameras, remarks = [], []
    for sample in samples:
        camera, stated = sample.camera, float(sample.camera.detector.sigma.mean())
        if sample.measured_noise_px is not None and sample.noise_px and sample.noise_px[1] > SAID_FACTOR * stated:
            noise = sample.noise_px[0]
            camera = camera.with_noise(noise)
            text = f"{camera.name}: detections scatter by {noise:.2g} px about one-camera tracks (or turn within three "
            remarks.append(Remark("noise", f"{text}frames): it was used in place of a sigma_px of {stated:g}"))
        cameras.append(camera)
    return tuple(cameras), tuple(remarks)


def control_path(loaded: LoadedConfig) -> Path | None:
    """Return the file of the control track: relative to the configuration, else to the working folder."""
    section = loaded.config.calibration
    if section is None or section.control is None:
        return None
    path = loaded.path.parent / section.control.file
    return path if path.exists() else Path(section.control.file)


def build_control(loaded: LoadedConfig, cameras: Sequence[Camera]) -> WorldControl | None:
    """Return the control; InputError where it is not usable, or in another unit of length."""
    path, unit = control_path(loaded), loaded.config.units.length
    if path is None:
        return None
    control = read_control(path, cameras)
    if unit not in (NO_LENGTH, control.length_unit or unit):
        raise InputError(f"{path}: expected lengths in {unit} as in {loaded.path}, found {control.length_unit}")
    length_unit = control.length_unit or (unit if unit != NO_LENGTH else "m")
    if isinstance(control, ControlPoints):
        return WorldControl(control, None, unit == NO_LENGTH, length_unit)
    std = None if control.std is None else float(np.median(control.std))
    return WorldControl(control.track, std, unit == NO_LENGTH, length_unit)


def _check_method(loaded: LoadedConfig, parameters: ParameterSet) -> None:
    """Refuse the paper's plain filter for unknowns that its conditional filters share."""
    section = calibration_section(loaded)
    moving = any(not camera.pose.is_static for camera in parameters.cameras)
    plain = section.method == "sequential" and section.sequential.moves == "none"
    if plain and (moving or not parameters.only_poses):
        names = ", ".join(quantity.name for quantity in parameters.quantities)
        raise InputError(
            f"{loaded.path}: calibration.sequential.moves: expected rerun for cameras that move or have unknowns "
            f"besides their pose ({names}), found none"
        )


def pmb_filter(loaded: LoadedConfig, cameras: tuple[Camera, ...]) -> PmbFilter:
    """Return the PMB filter of a configuration; of a PHD configuration, one with the same births and survival."""
    built = build_filter(with_filter(loaded.config, PmbSettings), cameras, loaded.path)
    assert isinstance(built, PmbFilter)
    return built


def phd_filter(loaded: LoadedConfig, cameras: tuple[Camera, ...], samples: int | None) -> PhdFilter:
    """Return the PHD filter of a configuration, with `samples` pseudo-random samples (None: the configuration's).

    For a PMB configuration it is the paper's filter, with the same births and survival.
    """
    config = with_filter(loaded.config, PhdSettings, merge_moments="intensity")
    if samples is not None:
        config = config.model_copy(update={"moments": MomentsSettings(method="particle", samples=samples)})
    built = build_filter(config, cameras, loaded.path)
    assert isinstance(built, PhdFilter)
    return built


def _check_overlap(parameters: ParameterSet, recording: Recording, path: Path | str, is_placed: bool) -> None:
    """Refuse a log in which an unknown camera saw nothing, or, if its clock is known, shares no time with another."""
    spans: dict[int, tuple[float, float]] = {}
    seen = np.diff(recording.first) > 0
    for number in range(len(parameters.cameras)):
        times = recording.times[seen & (recording.cameras == number)]
        if len(times):
            spans[number] = (float(times[0]), float(times[-1]))
    for number, camera in enumerate(parameters.cameras):
        if is_placed and not parameters.unknown(camera.name):
            continue
        if number not in spans:
            raise InputError(f"{path}: expected detections of camera {camera.name}, found none")
        if not is_placed:
            continue
        start, end = spans[number]
        others = [span for other, span in spans.items() if other != number]
        if not any(span[0] <= end and span[1] >= start for span in others):
            raise InputError(
                f"{path}: expected camera {camera.name} to overlap with another in time, found it alone from "
                f"{instant(start)} to {instant(end)} s"
            )


def part_used(problem: CalibrationProblem, task: Task) -> dict[str, Any]:
    """Return how much of the log a task tracks and fits, and the setting that limits it, for the report."""
    part, frames, detections = task.recording, len(problem.recording.cameras), len(problem.recording.pixels)
    is_whole = len(task.frames) == frames
    of_frames = task.settings.max_events / max(frames, 1) < task.settings.max_detections / max(detections, 1)
    return {
        "frames_tracked": len(task.frames), "frames_used": len(part.cameras), "detections_used": len(part.pixels),
        "limited_by": None if is_whole else f"calibration.annealed.max_{'events' if of_frames else 'detections'}",
    }  # fmt: skip


def annealed_task(loaded: LoadedConfig, section: CalibrationConfig, problem: CalibrationProblem) -> Task:
    """Return what every start of method annealed works on."""
    return Task.of(
        problem.parameters,
        problem.reference,
        pmb_filter(loaded, problem.parameters.cameras),
        problem.recording,
        problem.scale,
        section.annealed,
    )


# Memory of a hypothesis for each detection of a frame (13 kB in one run of 256 hypotheses), and of a detection
# (assumed).
_HYPOTHESIS_BYTES, _DETECTION_BYTES = 8e3, 1e3


def size_of_calibration(section: CalibrationConfig, frames: float, detections: float) -> Size:
    """Estimate memory, not disk (outputs are small), from frames and detections of the log, of all cameras together."""
    hypotheses = 0
    if section.method == "sequential":
        settings = section.sequential
        hypotheses = settings.particles
        if settings.moves == "rerun":
            hypotheses = max(settings.particles, settings.first_particles)
    elif section.posterior == "smc":
        hypotheses = section.smc.particles
    each = _HYPOTHESIS_BYTES * (1.0 + detections / max(frames, 1.0))
    if section.method == "annealed":
        detections = min(detections, section.annealed.max_detections)
    cause = f"{frames:.3g} frames, {detections:.3g} detections"
    cause += f", {hypotheses:.3g} camera hypotheses" if hypotheses else ""
    return Size(detections * _DETECTION_BYTES + hypotheses * each, 0.0, cause)
