"""Make the unknowns of a calibration from a configuration, and draw wrong cameras from their priors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from stereophd.config.calibration import CalibrationConfig
from stereophd.config.errors import describe
from stereophd.config.loading import LoadedConfig
from stereophd.config.yaml import Place, Tree
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, Quantity
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError, unknown_camera
from stereophd.io.cameras.models import CameraConfig


def calibration_section(loaded: LoadedConfig) -> CalibrationConfig:
    """Return the ``calibration`` section; raises InputError when there is none."""
    section = loaded.config.calibration
    if section is None:
        raise InputError(
            f"{loaded.path}: calibration: expected a section with a reference camera, and with priors of the cameras "
            "whose poses are known roughly, found none; `init` writes one, as a comment where the cameras agree"
        )
    return section


def build_parameters(loaded: LoadedConfig) -> tuple[ParameterSet, int]:
    """Return the unknowns that a configuration describes, and the index of the reference camera.

    Raises InputError for no section, fewer than two cameras, a name that no camera has, or cameras that move.
    """
    section = calibration_section(loaded)
    cameras = loaded.build_cameras(to_calibrate=True)
    if not section.priors:
        raise InputError(
            f"{loaded.path}: calibration.priors: expected priors of at least one camera, or cameras with "
            "`pose: unknown`, found none"
        )
    names = [camera.name for camera in cameras]
    if len(cameras) < 2:
        raise InputError(f"{loaded.path}: cameras: expected two or more to calibrate, found {len(cameras)}")
    for key, name in [("reference", section.reference), *((f"priors.{n}", n) for n in section.priors)]:
        if name not in names:
            raise InputError(f"{loaded.path}: calibration.{key}: {unknown_camera(name, names)}")
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
    """Tie the intrinsics and lenses of cameras that share them: a parameter of the first camera applies to all."""
    by_name = {camera.name: camera for camera in cameras}
    places = {(p.camera, p.name): p for p in parameters}
    for number, group in enumerate(section.shared):
        place = f"{loaded.path}: calibration.shared.{number}"
        first, *others = group
        for name in group:
            if name not in by_name:
                raise InputError(f"{place}: {unknown_camera(name, by_name)}")
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
    place, prior = f"{loaded.path}: calibration.priors.{camera.name}", section.priors.get(camera.name)
    if loaded.cameras[camera.name].intrinsics.unknown and not getattr(prior, "focal_std", 0.0):
        raise InputError(
            f"{place}.focal_std: expected a standard deviation for a focal length that is unknown (0.47: within a "
            "factor of 1.6), found none"
        )
    if prior is None:
        return
    for quantity in quantities():
        for component, std in zip(quantity.components, prior_stds(section, camera.name, quantity), strict=True):
            if std > 0.0 and component not in quantity.available(camera):
                raise InputError(f"{place}.{quantity.prior}: {_unavailable(quantity, component, camera)}")


def _unavailable(quantity: Quantity, component: str, camera: Camera) -> str:
    """Return the reason why a camera does not have a component."""
    if quantity.named:
        expected = f"expected coefficients of its lens model {camera.lens.model}"
        if known := ", ".join(quantity.available(camera)):
            return f"{expected} ({known}), found {component}"
        return f"{expected}, which has none, found {component}; give it one: distortion: {{model: radial, k1: 0.0}}"
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
    """Draw prior means about which the configuration's cameras are a draw from the prior.

    Raises InputError when the prior is so wide that a value drawn from it is none of a camera.
    """
    parameters, _ = build_parameters(loaded)
    guess = parameters.guess(parameters.sample(np.random.default_rng(seed), 1)[0])
    return with_quantities(loaded.cameras, guess, f"{loaded.path}: calibration.priors: a value drawn from a prior")


def with_quantities(
    configs: Mapping[str, CameraConfig], cameras: Sequence[Camera], source: str = "a calibrated value"
) -> dict[str, CameraConfig]:
    """Return the configurations of cameras with the quantities and the noise of others; what is the same stays as is.

    Raises InputError when a value is beyond the bounds of its key; the message begins with `source`, its origin.
    """
    out = {}
    for camera in cameras:
        config = configs[camera.name]
        before, values = config.build(camera.name), config.model_dump()
        changed = [quantity for quantity in quantities() if quantity.entry(before) != quantity.entry(camera)]
        for quantity in changed:
            _merge(values, quantity.entry(camera))
        if (camera.fx, camera.fy) != (before.fx, before.fy):
            values["intrinsics"]["unknown"] = False
        if noise := camera.detector.sigma.tolist() != before.detector.sigma.tolist():
            values["detector"]["sigma_px"] = tuple(camera.detector.sigma.tolist())
        if changed or noise:
            try:
                config = CameraConfig.model_validate(values)
            except ValidationError as error:
                tree = Tree({camera.name: values}, {(): Place(source)})
                details = [{**one, "loc": (camera.name, *one["loc"])} for one in error.errors(include_url=False)]
                raise InputError(describe(details, tree, {})) from None
        out[camera.name] = config
    return out


def _merge(values: dict[str, Any], entry: Mapping[str, Any]) -> None:
    for key, value in entry.items():
        if isinstance(value, Mapping) and isinstance(values.get(key), dict):
            _merge(values[key], value)
        else:
            values[key] = value
