"""Make the problem of a calibration from a configuration and a log."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereophd.config.calibration import BaselineScale, CalibrationConfig
from stereophd.core.alignment.cameras import moved_camera
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.annealing.control import ControlTrack, World
from stereophd.core.calibration.annealing.task import Task
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.calibration.unknowns.unknown_sets import UnknownSet, default_stages, stages_named
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError, unknown_camera
from stereophd.pipeline.alignment.control import alignment_report, read_control
from stereophd.pipeline.calibration.filters import pmb_filter
from stereophd.pipeline.calibration.unit_of_length import with_unit
from stereophd.pipeline.calibration.unknowns import build_parameters, calibration_section
from stereophd.pipeline.stream import covered, open_stream
from stereophd.validated import NO_LENGTH

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


@dataclass(frozen=True)
class CalibrationProblem:
    """The unknowns of a calibration and the data that constrain them."""

    parameters: ParameterSet
    reference: int  # Index of the reference camera
    recording: Recording  # The log
    scale: ScaleMeasurement | None  # A known baseline
    counts: dict[str, int]  # Counts of the log, as in ``report.json``
    control: ControlTrack | None = None

    def frames(self, most: int | None = None) -> NDArray[np.int64]:
        """Return the frames of the recording, at most about `most`."""
        return np.arange(len(self.recording.cameras)) if most is None else tracked_frames(self.recording, most)

    def scans(self, most: int | None = None) -> Scans:
        """Return the events by the cameras of the prior mean, at most about `most`."""
        return Scans.of(self.recording, self.parameters.cameras, self.frames(most))


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


def read_problem(loaded: LoadedConfig, log_path: Path | str) -> CalibrationProblem:
    """Read a log, and check that it can constrain the unknown cameras.

    Raises InputError as `build_parameters` does, and when the log is not usable, or an unknown camera saw nothing, or
    not while another did.
    """
    parameters, reference = build_parameters(loaded)
    scale = build_scale(loaded, parameters)
    stream = open_stream(loaded.config, parameters.cameras, log_path)
    frames = covered(parameters.cameras, stream.frames, stream.source)
    recording = Recording.of(parameters.cameras, [(f.camera, f.time_s, f.pixels, f.sigma) for f in frames])
    _check_overlap(parameters, recording, log_path)
    counts = {**stream.counts, "not_invertible": recording.not_invertible(parameters.cameras)}
    _check_method(loaded, parameters)
    return CalibrationProblem(parameters, reference, recording, scale, counts, build_control(loaded))


def control_path(loaded: LoadedConfig) -> Path | None:
    """Return the file of the control track: relative to the configuration, else to the working folder."""
    section = loaded.config.calibration
    if section is None or section.control is None:
        return None
    path = loaded.path.parent / section.control.track
    return path if path.exists() else Path(section.control.track)


def build_control(loaded: LoadedConfig) -> ControlTrack | None:
    """Return the control track; InputError where it is not usable, or in another unit of length."""
    path, unit = control_path(loaded), loaded.config.units.length
    if path is None:
        return None
    control = read_control(path)
    if unit not in (NO_LENGTH, control.length_unit or unit):
        raise InputError(f"{path}: expected lengths in {unit} as in {loaded.path}, found {control.length_unit}")
    std = None if control.std is None else float(np.median(control.std))
    known = unit if unit != NO_LENGTH else "m"
    return ControlTrack(control.track, std, unit == NO_LENGTH, control.length_unit or known)


def in_world(
    loaded: LoadedConfig, cameras: tuple[Camera, ...], world: World, unit: str
) -> tuple[LoadedConfig, tuple[Camera, ...], dict[str, Any]]:
    """Return configuration and cameras in the unit and the world of a control track, and what is reported of it."""
    found = world.alignment
    if unit != loaded.config.units.length:
        loaded = with_unit(loaded, unit, found.registration.scale)
    report = {**alignment_report(found, unit), "std": world.std}
    return loaded, tuple(moved_camera(camera, found.registration) for camera in cameras), report


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


def _check_overlap(parameters: ParameterSet, recording: Recording, path: Path | str) -> None:
    """Refuse a log in which an unknown camera shares no time with another."""
    spans: dict[int, tuple[float, float]] = {}
    seen = np.diff(recording.first) > 0
    for number in range(len(parameters.cameras)):
        times = recording.times[seen & (recording.cameras == number)]
        if len(times):
            spans[number] = (float(times[0]), float(times[-1]))
    for number, camera in enumerate(parameters.cameras):
        if not parameters.unknown(camera.name):
            continue
        if number not in spans:
            raise InputError(f"{path}: expected detections of camera {camera.name}, which is unknown, found none")
        start, end = spans[number]
        others = [span for other, span in spans.items() if other != number]
        if not any(span[0] <= end and span[1] >= start for span in others):
            raise InputError(
                f"{path}: expected camera {camera.name} to overlap with another in time, found it alone from "
                f"{start:g} to {end:g} s"
            )


def tracked_frames(recording: Recording, most: int) -> NDArray[np.int64]:
    """Return every n-th frame of each camera, so that at most about `most` remain."""
    return recording.every(max(math.ceil(len(recording.cameras) / most), 1))


def annealed_task(loaded: LoadedConfig, section: CalibrationConfig, problem: CalibrationProblem) -> Task:
    """Return what every start of method annealed works on."""
    settings = section.annealed
    return Task.of(
        problem.parameters,
        problem.reference,
        pmb_filter(loaded, problem.parameters.cameras),
        problem.recording,
        tracked_frames(problem.recording, settings.max_events),
        problem.scale,
        settings,
        build_stages(loaded, problem.parameters),
    )


def build_stages(loaded: LoadedConfig, parameters: ParameterSet) -> tuple[UnknownSet, ...]:
    """Return the stages in which unknowns are freed; raises InputError when one names what is no unknown."""
    stages = calibration_section(loaded).stages
    if stages == "auto":
        return default_stages(parameters)
    try:
        return stages_named(parameters, stages)
    except ValueError as error:
        raise InputError(f"{loaded.path}: calibration.stages: {error}") from None
