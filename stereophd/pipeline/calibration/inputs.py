"""From a configuration and a log to the problem of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereophd.config.calibration import BaselineScale, CalibrationConfig
from stereophd.config.cameras import CameraConfig
from stereophd.config.model import Config
from stereophd.core.calibration.parameters import Parameter, ParameterSet
from stereophd.core.calibration.quantities.base import IMAGES, Quantity
from stereophd.core.calibration.quantities.registry import quantities
from stereophd.core.calibration.recording import Recording, Scans
from stereophd.core.calibration.scale import ScaleMeasurement
from stereophd.core.calibration.task import Task
from stereophd.core.calibration.unknown_sets import UnknownSet, default_stages, stages_named
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.phd import PhdFilter
from stereophd.core.multi.pmb import PmbFilter
from stereophd.core.multi.settings import FilterSettings
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.core.single.settings import SingleSettings
from stereophd.errors import InputError
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.stream import covered, open_stream

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


@dataclass(frozen=True)
class CalibrationProblem:
    """What is to be estimated, from what.

    Attributes
    ----------
    parameters : ParameterSet
    reference : int
        Index of the reference camera.
    recording : Recording
        The log.
    scale : ScaleMeasurement or None
        A known baseline.
    counts : dict
        Of the log, as in ``report.json``.
    """

    parameters: ParameterSet
    reference: int
    recording: Recording
    scale: ScaleMeasurement | None
    counts: dict[str, int]

    def scans(self, most: int | None = None) -> Scans:
        """Return the events by the cameras of the prior mean, at most so many."""
        frames = None if most is None else tracked_frames(self.recording, most)
        return Scans.of(self.recording, self.parameters.cameras, frames)


def calibration_section(loaded: LoadedConfig) -> CalibrationConfig:
    """Return the ``calibration`` section.

    Raises
    ------
    InputError
        There is none.
    """
    section = loaded.config.calibration
    if section is None:
        raise InputError(f"{loaded.path}: calibration: expected a section with reference and priors, found none")
    return section


def build_parameters(loaded: LoadedConfig) -> tuple[ParameterSet, int]:
    """Return the unknowns that a configuration describes, and the index of the reference camera.

    Raises
    ------
    InputError
        No section, fewer than two cameras, a name that no camera has, or cameras that move.
    """
    section = calibration_section(loaded)
    cameras = loaded.build_cameras()
    names = [camera.name for camera in cameras]
    if len(cameras) < 2:
        raise InputError(f"{loaded.path}: cameras: expected two or more to calibrate, found {len(cameras)}")
    for key, name in [("reference", section.reference), *((f"priors.{n}", n) for n in section.priors)]:
        if name not in names:
            raise InputError(
                f"{loaded.path}: calibration.{key}: expected one of the cameras {', '.join(names)}, found {name}"
            )
    for camera in cameras:
        _check_priors(loaded, section, camera)
    parameters = [
        Parameter(component, camera.name, 0.0, std)
        for camera in cameras
        if camera.name in section.priors
        for quantity in quantities()
        for component, std in zip(quantity.components, prior_stds(section, camera.name, quantity), strict=True)
        if std > 0.0
    ]
    return ParameterSet(cameras, _shared(loaded, section, cameras, parameters)), names.index(section.reference)


def _shared(
    loaded: LoadedConfig, section: CalibrationConfig, cameras: tuple[Camera, ...], parameters: list[Parameter]
) -> tuple[Parameter, ...]:
    """Tie the intrinsics and lenses of cameras that share one: a parameter of the first stands for all of them."""
    by_name = {camera.name: camera for camera in cameras}
    places = {(p.camera, p.name): p for p in parameters}
    for number, group in enumerate(section.shared):
        place = f"{loaded.path}: calibration.shared.{number}"
        first, *others = group
        for name in group:
            if name not in by_name:
                raise InputError(f"{place}: expected cameras ({', '.join(by_name)}), found {name}")
        for quantity in quantities():
            if quantity.affects != IMAGES:
                continue
            for name in others:
                if quantity.entry(by_name[name]) != quantity.entry(by_name[first]):
                    raise InputError(
                        f"{place}: expected cameras of the same intrinsics and lens, found another {quantity.name} "
                        f"of {name} than of {first}"
                    )
            for component in quantity.components:
                stds = {places[name, component].std if (name, component) in places else 0.0 for name in group}
                if len(stds) > 1:
                    raise InputError(f"{place}: expected equal priors of {quantity.name}, found different ones")
                if (first, component) in places:
                    places[first, component] = replace(places[first, component], shared_with=tuple(others))
                    for name in others:
                        del places[name, component]
    return tuple(places[p.camera, p.name] for p in parameters if (p.camera, p.name) in places)


def _check_priors(loaded: LoadedConfig, section: CalibrationConfig, camera: Camera) -> None:
    """Refuse priors of what a camera does not have, or of what the methods cannot find."""
    if camera.name not in section.priors:
        return
    place = f"{loaded.path}: calibration.priors.{camera.name}"
    unknown = set()
    for quantity in quantities():
        for component, std in zip(quantity.components, prior_stds(section, camera.name, quantity), strict=True):
            if std > 0.0 and component not in quantity.available(camera):
                raise InputError(f"{place}.{quantity.prior}: {_unavailable(quantity, component, camera)}")
            if std > 0.0:
                unknown.add(quantity.name)
    if unknown & {"velocity", "rotation_rate"} and ("readout" in unknown or camera.readout_s != 0.0):
        raise InputError(f"{place}: expected no readout of a camera that moves, found one beside rates")


def _unavailable(quantity: Quantity, component: str, camera: Camera) -> str:
    """Say why a camera does not have a component."""
    if quantity.named:
        known = ", ".join(quantity.available(camera)) or "none"
        return f"expected coefficients of its lens model {camera.lens.model} ({known}), found {component}"
    if camera.pose.path is None:
        return "expected a camera that a body of known trajectory carries (pose.trajectory), found one without"
    return "expected no prior of the pose of a camera on a known trajectory (mount_center_std, mount_rotation_std_deg)"


def prior_stds(section: CalibrationConfig, camera: str, quantity: Quantity) -> tuple[float, ...]:
    """Prior standard deviations of the components of a quantity, in its unit; 0 where one is known."""
    spread = getattr(section.priors[camera], quantity.prior)
    if quantity.named:
        given = {} if spread is None else spread.model_dump()
        values: tuple[float, ...] = tuple(given.get(name, 0.0) for name in quantity.components)
    elif isinstance(spread, (int, float)):
        values = (float(spread),) * len(quantity.components)
    else:
        values = tuple(float(value) for value in spread)
    return tuple((np.array(values) * quantity.prior_unit).tolist())


def draw_guess(loaded: LoadedConfig, seed: np.random.SeedSequence) -> dict[str, CameraConfig]:
    """Draw prior means about which the configuration's cameras are a draw from the prior."""
    parameters, _ = build_parameters(loaded)
    guess = parameters.guess(parameters.sample(np.random.default_rng(seed), 1)[0])
    return with_quantities(loaded.cameras, guess)


def with_quantities(configs: Mapping[str, CameraConfig], cameras: Sequence[Camera]) -> dict[str, CameraConfig]:
    """Return the configurations of cameras with the quantities of others; what is the same stays as it was written."""
    out = {}
    for camera in cameras:
        config = configs[camera.name]
        before, values = config.build(camera.name), config.model_dump()
        changed = [quantity for quantity in quantities() if quantity.entry(before) != quantity.entry(camera)]
        for quantity in changed:
            _merge(values, quantity.entry(camera))
        if changed:
            config = CameraConfig.model_validate(values)
        out[camera.name] = config
    return out


def _merge(values: dict[str, Any], entry: Mapping[str, Any]) -> None:
    """Put a nested entry into nested values."""
    for key, value in entry.items():
        if isinstance(value, Mapping) and isinstance(values.get(key), dict):
            _merge(values[key], value)
        else:
            values[key] = value


def build_scale(loaded: LoadedConfig, parameters: ParameterSet) -> ScaleMeasurement | None:
    """Return a known baseline as a measurement; None for what is known otherwise, or not at all.

    Raises
    ------
    InputError
        A name that no camera has, or one camera twice.
    """
    scale = calibration_section(loaded).scale
    if not isinstance(scale, BaselineScale):
        return None
    names = [camera.name for camera in parameters.cameras]
    first, second = scale.cameras
    if first not in names or second not in names or first == second:
        raise InputError(
            f"{loaded.path}: calibration.scale.cameras: expected two of the cameras {', '.join(names)}, "
            f"found {first}, {second}"
        )
    return ScaleMeasurement("baseline", scale.distance, scale.std, (names.index(first), names.index(second)))


def read_problem(loaded: LoadedConfig, log_path: Path | str) -> CalibrationProblem:
    """Read a log, and check that it can constrain the unknown cameras.

    Raises
    ------
    InputError
        As `build_parameters`; the log is not usable; an unknown camera saw nothing, or not while another did.
    """
    parameters, reference = build_parameters(loaded)
    scale = build_scale(loaded, parameters)
    stream = open_stream(loaded.config, parameters.cameras, log_path)
    frames = covered(parameters.cameras, stream.frames, stream.source)
    recording = Recording.of(parameters.cameras, [(f.camera, f.time_s, f.pixels, f.sigma) for f in frames])
    _check_overlap(parameters, recording, log_path)
    counts = {**stream.counts, "not_invertible": recording.not_invertible(parameters.cameras)}
    _check_method(loaded, parameters)
    return CalibrationProblem(parameters, reference, recording, scale, counts)


def _check_method(loaded: LoadedConfig, parameters: ParameterSet) -> None:
    """Refuse a sampler for unknowns that its conditional filters share."""
    section = calibration_section(loaded)
    moving = parameters.has_rates or any(not camera.pose.is_static for camera in parameters.cameras)
    if (section.method == "sequential" or section.posterior == "smc") and (moving or not parameters.only_moves):
        found = "method: sequential" if section.method == "sequential" else "posterior: smc"
        names = ", ".join(quantity.name for quantity in parameters.quantities)
        raise InputError(
            f"{loaded.path}: calibration: expected method annealed with posterior laplace for cameras that move or "
            f"have unknowns beside their pose ({names}), found {found}"
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
    """Return every n-th frame of each camera, so that at most so many are left."""
    return recording.every(max(math.ceil(len(recording.cameras) / most), 1))


def pmb_filter(loaded: LoadedConfig, cameras: tuple[Camera, ...], threads: int = 1) -> PmbFilter:
    """Return the PMB filter of a configuration; of a PHD one, that of the same births and survival."""
    config = loaded.config
    settings = _filter_section(loaded)
    if not isinstance(settings, PmbSettings):
        settings = PmbSettings(survival_per_s=settings.survival_per_s, birth=settings.birth)
    built = build_filter(config.model_copy(update={"filter": settings}), cameras, loaded.path, threads)
    assert isinstance(built, PmbFilter)
    return built


def phd_filter(
    loaded: LoadedConfig, cameras: tuple[Camera, ...], samples: int | None = None, threads: int = 1
) -> PhdFilter:
    """Return the PHD filter of a configuration, with so many pseudo-random samples (default: the config's)."""
    config: Config = loaded.config
    settings = _filter_section(loaded)
    if not isinstance(settings, PhdSettings):
        settings = PhdSettings(survival_per_s=settings.survival_per_s, birth=settings.birth)
    update: dict[str, object] = {"filter": settings}
    if samples is not None:
        update["moments"] = MomentsSettings(method="particle", samples=samples)
    built = build_filter(config.model_copy(update=update), cameras, loaded.path, threads)
    assert isinstance(built, PhdFilter)
    return built


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
    """Return the stages in which unknowns are freed.

    Raises
    ------
    InputError
        A stage names what is no unknown.
    """
    stages = calibration_section(loaded).stages
    if stages == "auto":
        return default_stages(parameters)
    try:
        return stages_named(parameters, stages)
    except ValueError as error:
        raise InputError(f"{loaded.path}: calibration.stages: {error}") from None


def _filter_section(loaded: LoadedConfig) -> FilterSettings:
    if loaded.config.filter is None:
        raise InputError(f"{loaded.path}: filter: expected a filter section for calibrate, found none")
    if isinstance(loaded.config.filter, SingleSettings):
        raise InputError(
            f"{loaded.path}: filter.kind: expected phd or pmb for calibrate, found {loaded.config.filter.kind}"
        )
    return loaded.config.filter
