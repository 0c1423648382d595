"""Cramer-Rao bounds of a simulated calibration, as figures of a report."""

from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.bounds.calibration import TruePositions, calibration_bound
from stereophd.core.numerics.random_streams import RUN_OBJECTS
from stereophd.core.simulation.detections import Scene
from stereophd.errors import InputError
from stereophd.pipeline.calibration.configured_unknowns import build_parameters
from stereophd.pipeline.calibration.problem import build_scale
from stereophd.pipeline.calibration.report import pose_stds
from stereophd.pipeline.simulation import build_scene


def bound_figures(loaded: LoadedConfig) -> dict[str, Any]:
    """Cramer-Rao bound of the configuration's calibration in its own simulated scenario (run 0), its cameras the true.

    The errors are root mean squares. Raises InputError as `build_parameters` does, for priors of cameras that it does
    not have, and if the configuration has no section ``simulate``.
    """
    truth, reference = build_parameters(loaded)
    if loaded.config.simulate is None:
        raise InputError(f"{loaded.path}: simulate: expected the scenario of the bound, found none")
    scene = build_scene(loaded.config, truth.cameras, RUN_OBJECTS.seed(loaded.config.seed, 0))
    values, positions = np.zeros(truth.size), scene_positions(scene)
    covariance = calibration_bound(truth, values, reference, scene.motion, positions, build_scale(loaded, truth))
    cameras = pose_stds(truth, reference, values, covariance, "")
    std = np.sqrt(np.diag(covariance))
    return {"cameras": cameras, "parameters": dict(zip(truth.names, std.tolist(), strict=True))}


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
