"""A Gaussian carried from one disparity space to another, against a very large sample (Figures 4 and 7).

The "bound" of a mean or covariance is its value in the reference.
"""

from functools import lru_cache

import numpy as np

from stereophd.config.experiment import MoveScenario
from stereophd.config.loading import LoadedConfig
from stereophd.config.model import Config
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.numerics.random_streams import MOVE_REFERENCE, RUN_SINGLE_OBJECT
from stereophd.errors import InputError, unknown_camera
from stereophd.experiments.engine.base import Kind, Series, scenario_of
from stereophd.experiments.single_object.move_comparison import (
    MoveCase,
    MoveMoments,
    OutOfViewError,
    compare_move,
    gaussian_of_object,
    reference_moments,
)
from stereophd.io.outputs.provenance import canonical_json
from stereophd.pipeline.build import build_motion

AXES = ("u", "v", "d")

# Parts of the configuration that may differ between methods, and do not change what is carried over.
NOT_IN_REFERENCE = ("moments", "filter")


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless the cameras are there, and the motion is stated."""
    build_motion(loaded.config, loaded.path)
    names = [camera.name for camera in loaded.build_cameras()]
    for key in ("home", "destination"):
        name = getattr(scenario_of(loaded.config, MoveScenario), key)
        if name not in names:
            raise InputError(f"{loaded.path}: experiment.scenario.{key}: {unknown_camera(name, names)}")


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the divergence of the reference from the Gaussian of the method, and that Gaussian's moments."""
    case, reference = _case(loaded)
    moments = loaded.config.moments
    rng = np.random.default_rng(RUN_SINGLE_OBJECT.seed(loaded.config.seed, number))
    comparison = compare_move(case, moments.method, moments.samples, reference, rng)
    return [Series("divergence", "nat", np.array([comparison.divergence])), *_moments(comparison)]


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the moments of the reference."""
    return _moments(_case(loaded)[1])


def _case(loaded: LoadedConfig) -> tuple[MoveCase, MoveMoments]:
    """Return what is carried over, and the reference: the same for all methods and runs, and made once a process."""
    case_settings = {key: value for key, value in loaded.resolved.items() if key not in NOT_IN_REFERENCE}
    try:
        return _reference(canonical_json(case_settings))
    except OutOfViewError as error:
        raise InputError(f"{loaded.path}: experiment.scenario: {error}") from None


@lru_cache(maxsize=8)
def _reference(text: str) -> tuple[MoveCase, MoveMoments]:
    config = Config.model_validate_json(text)
    settings = scenario_of(config, MoveScenario)
    assert isinstance(config.cameras, dict)
    cameras = {name: camera.build(name) for name, camera in config.cameras.items()}
    home, destination = (
        DisparitySpace(cameras[name], config.disparity.baseline, config.disparity.rectification)
        for name in (settings.home, settings.destination)
    )
    rng = np.random.default_rng(MOVE_REFERENCE.seed(config.seed))
    mean, covariance = gaussian_of_object(
        home,
        np.array(settings.point_px),
        np.array(settings.std_px),
        np.array(settings.velocity),
        settings.velocity_std,
        rng,
    )
    case = MoveCase(home, destination, mean, covariance, settings.interval_s, config.motion.build())
    return case, reference_moments(case, rng, settings.reference_samples)


def _moments(moments: MoveMoments) -> list[Series]:
    """Return the mean and covariance of (u, v, d), and the share in view."""
    series = [Series("share_in_view", "1", np.array([moments.fraction]))]
    series += [Series(f"mean_{axis}", "px", moments.mean[i : i + 1]) for i, axis in enumerate(AXES)]
    pairs = [(i, j) for i in range(len(AXES)) for j in range(i, len(AXES))]
    series += [Series(f"covariance_{AXES[i]}{AXES[j]}", "px^2", moments.covariance[i, j : j + 1]) for i, j in pairs]
    return series


KIND = Kind(run, bounds, check)
