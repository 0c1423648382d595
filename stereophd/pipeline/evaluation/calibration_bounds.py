"""Cramer-Rao bounds of a simulated calibration, as figures of a report."""

import math
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.bounds.calibration import TruePositions, calibration_bound
from stereophd.core.calibration.unknowns.observability import PoseSpread, pose_spread, posed_cameras
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.numerics.random_streams import RUN_OBJECTS
from stereophd.core.simulation.detections import Scene
from stereophd.errors import InputError
from stereophd.io.outputs.json_text import finite_or_none
from stereophd.pipeline.calibration.problem import build_scale
from stereophd.pipeline.calibration.unknowns import build_parameters
from stereophd.pipeline.simulation import build_scene


def bound_figures(loaded: LoadedConfig) -> dict[str, Any]:
    """Cramer-Rao bound of the configuration's calibration in its own simulated scenario (run 0), its cameras the true.

    Raises InputError as `build_parameters` does, for priors of cameras that it does not have.
    """
    parameters, reference = build_parameters(loaded)
    covariance = scenario_bound(loaded, parameters, reference)
    names = posed_cameras(parameters)
    values = np.zeros(parameters.size)
    spreads = {name: pose_spread(parameters, reference, values, covariance, name) for name in names}
    std = np.sqrt(np.diag(covariance))
    return {
        "cameras": {name: spread_figures(spread) for name, spread in spreads.items()},
        "parameters": dict(zip(parameters.names, std.tolist(), strict=True)),
    }


def spread_figures(spread: PoseSpread) -> dict[str, Any]:
    """Root mean square errors of a `PoseSpread`, as the errors are named."""
    return {
        "rotation_deg": finite_or_none(math.degrees(spread.rotation)),
        "direction_deg": finite_or_none(math.degrees(spread.direction)),
        "scale": finite_or_none(spread.scale),
        "center": finite_or_none(spread.center),
    }


def scenario_bound(loaded: LoadedConfig, truth: ParameterSet, reference: int) -> Array:
    """Bound on the covariance (m, m) of a calibration of the first simulated run of a configuration.

    It has ``simulate`` and ``calibration``; `truth` has the true cameras: their values are zero.
    """
    settings = loaded.config.simulate
    if settings is None:
        raise InputError(f"{loaded.path}: simulate: expected the scenario of the bound, found none")
    scene = build_scene(loaded.config, truth.cameras, RUN_OBJECTS.seed(loaded.config.seed, 0))
    positions = scene_positions(scene)
    return calibration_bound(
        truth, np.zeros(truth.size), reference, scene.motion, positions, build_scale(loaded, truth)
    )


def scene_positions(scene: Scene) -> TruePositions:
    """True position of every object at every frame of every camera."""
    objects, cameras, times, positions = [], [], [], []
    for window in scene.windows():
        for number, schedule in enumerate(scene.grid.frames):
            _, instants = schedule.window(window.lower_s, window.upper_s)
            states = window.states[:, np.searchsorted(window.times_s, instants)]
            row, instant = np.nonzero(~np.isnan(states[:, :, 0]))
            objects.append(window.object_id[row])
            cameras.append(np.full(len(row), number))
            times.append(instants[instant])
            positions.append(states[row, instant, :3])
    return TruePositions(*map(np.concatenate, (objects, cameras, times, positions)))
