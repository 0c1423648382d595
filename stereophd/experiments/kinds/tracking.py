"""A moving object seen by all cameras at the same times (paper VIII-B, Figure 11)."""

import numpy as np

from stereophd.config.experiment import TrackingScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.numerics.random_streams import BOUND_TRAJECTORIES, RUN_SINGLE_OBJECT
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Kind, Series, method_clock, scenario_of
from stereophd.experiments.single_object.runs import TrackingProblem, tracking_bound, tracking_run
from stereophd.experiments.single_object.series import (
    OBSERVATION_BYTES,
    bounds_of,
    rig_of,
    series_of_errors,
    single_config,
)
from stereophd.pipeline.build import build_motion
from stereophd.pipeline.tracking.single import estimator_settings


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless there is an estimator and a prior of its velocity."""
    prior = single_config(loaded).prior
    if not build_motion(loaded.config, loaded.path).moves:
        raise InputError(f"{loaded.path}: motion.model: expected the motion of a moving object, found static")
    if prior.velocity_std is None and prior.disparity_velocity_std_px_s is None:
        raise InputError(
            f"{loaded.path}: filter.prior: expected velocity_std or disparity_velocity_std_px_s, found none"
        )
    _scenario(loaded)


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the errors of position and velocity over time."""
    rng = np.random.default_rng(RUN_SINGLE_OBJECT.seed(loaded.config.seed, number))
    result = tracking_run(_scenario(loaded), estimator_settings(loaded.config), rng, method_clock())
    reported = result.map_errors if single_config(loaded).point == "map" else result.mean_errors
    series = []
    for name, unit, part in _parts(loaded):
        stated = result.covariances[:, part, part]
        series += series_of_errors(name, unit, result.times, reported[:, part], stated, result.mean_errors[:, part])
    return series


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the posterior Cramer-Rao bound of position and velocity over time."""
    settings, scenario = scenario_of(loaded.config, TrackingScenario), _scenario(loaded)
    seed = BOUND_TRAJECTORIES.seed(loaded.config.seed)
    covariances = tracking_bound(scenario, np.random.default_rng(seed), settings.bound_trajectories)
    times = np.unique(scenario.times)
    return [
        series
        for name, unit, part in _parts(loaded)
        for series in bounds_of(name, unit, times, covariances[:, part, part])
    ]


def _parts(loaded: LoadedConfig) -> list[tuple[str, str, slice]]:
    unit = loaded.config.units.length
    return [("position", unit, slice(0, 3)), ("velocity", f"{unit}/s", slice(3, 6))]


def _scenario(loaded: LoadedConfig) -> TrackingProblem:
    settings = scenario_of(loaded.config, TrackingScenario)
    rig = rig_of(loaded)
    count = len(rig.cameras)
    times = np.repeat(settings.interval_s * np.arange(settings.steps), count)
    return TrackingProblem(
        rig,
        np.array([*settings.position, *settings.velocity]),
        build_motion(loaded.config, loaded.path),
        single_config(loaded).prior,
        times,
        np.tile(np.arange(count), settings.steps),
    )


def memory(loaded: LoadedConfig) -> float:
    """Estimate the memory of the observations."""
    return scenario_of(loaded.config, TrackingScenario).steps * len(loaded.cameras) * OBSERVATION_BYTES


KIND = Kind(run, bounds, check, memory)
