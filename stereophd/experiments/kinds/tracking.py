"""A moving object seen by all cameras at the same times (paper VIII-B, Figure 11)."""

import numpy as np

from stereophd.config.experiment import TrackingScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.numerics.random_streams import BOUND_TRAJECTORIES
from stereophd.errors import InputError
from stereophd.experiments import single_object
from stereophd.experiments.engine.base import Kind, Series, scenario_of
from stereophd.pipeline.build import build_motion


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless there is an estimator and a prior of its velocity."""
    prior = single_object.single_config(loaded).prior
    if not build_motion(loaded.config, loaded.path).moves:
        raise InputError(f"{loaded.path}: motion.model: expected the motion of a moving object, found static")
    if prior.velocity_std is None and prior.disparity_velocity_std_px_s is None:
        raise InputError(
            f"{loaded.path}: filter.prior: expected velocity_std or disparity_velocity_std_px_s, found none"
        )
    _scenario(loaded)


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the errors of position and velocity over time."""
    return single_object.series_of_errors(loaded, number, _scenario(loaded))


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the posterior Cramer-Rao bound of position and velocity over time."""
    settings, scenario = scenario_of(loaded.config, TrackingScenario), _scenario(loaded)
    rng = np.random.default_rng(BOUND_TRAJECTORIES.seed(loaded.config.seed))
    return single_object.bounds_of(
        loaded, np.unique(scenario.times), single_object.tracking_bound(scenario, rng, settings.bound_trajectories)
    )


def _scenario(loaded: LoadedConfig) -> single_object.SingleObjectProblem:
    settings = scenario_of(loaded.config, TrackingScenario)
    rig = single_object.rig_of(loaded)
    count = len(rig.cameras)
    times = np.repeat(settings.interval_s * np.arange(settings.steps), count)
    return single_object.SingleObjectProblem(
        rig,
        np.array([*settings.position, *settings.velocity]),
        build_motion(loaded.config, loaded.path),
        single_object.single_config(loaded).prior,
        times,
        np.tile(np.arange(count), settings.steps),
    )


def memory(loaded: LoadedConfig) -> float:
    """Estimate the memory of the observations."""
    return scenario_of(loaded.config, TrackingScenario).steps * len(loaded.cameras) * single_object.OBSERVATION_BYTES


KIND = Kind(run, bounds, check, memory)
