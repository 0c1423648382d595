"""A static object observed by one camera after another (paper VIII-A, Table II and Figure 10)."""

import numpy as np

from stereophd.config.experiment import LocalisationScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.numerics.random_streams import RUN_SINGLE_OBJECT
from stereophd.errors import InputError, unknown_camera
from stereophd.experiments.engine.base import Kind, Series, method_clock, scenario_of
from stereophd.experiments.single_object.runs import LocalisationProblem, localisation_bound, localisation_run
from stereophd.experiments.single_object.series import (
    OBSERVATION_BYTES,
    bounds_of,
    last_of,
    rig_of,
    series_of_errors,
    single_config,
)
from stereophd.pipeline.tracking.single import estimator_settings


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless the object is in view of the cameras that observe it, and there is an estimator."""
    single_config(loaded)
    scenario = _scenario(loaded)
    rig = scenario.rig
    for name, index in zip(scenario_of(loaded.config, LocalisationScenario).sequence, scenario.sequence, strict=False):
        if not rig.cameras[index].in_view(scenario.position[None])[0]:
            raise InputError(
                f"{loaded.path}: experiment.scenario.position: expected an object in view of {name}, found it out of "
                f"view at {scenario.position.tolist()}"
            )


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the error of the position after each observation, and after the last one."""
    scenario = _scenario(loaded)
    rng = np.random.default_rng(RUN_SINGLE_OBJECT.seed(loaded.config.seed, number))
    result = localisation_run(scenario, estimator_settings(loaded.config), rng, method_clock())
    reported = result.map_errors if single_config(loaded).point == "map" else result.mean_errors
    unit = loaded.config.units.length
    series = series_of_errors("position", unit, _times(loaded), reported, result.covariances, result.mean_errors)
    return [*series, *(last_of(one, f"final_{one.quantity}") for one in series)]


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the Cramer-Rao bound after each observation."""
    settings = scenario_of(loaded.config, LocalisationScenario)
    covariances = localisation_bound(_scenario(loaded), settings.bound_with_prior)
    series = bounds_of("position", loaded.config.units.length, _times(loaded), covariances)
    return [*series, *(last_of(one, f"final_{one.quantity}") for one in series)]


def _times(loaded: LoadedConfig) -> Array:
    settings = scenario_of(loaded.config, LocalisationScenario)
    return settings.interval_s * np.arange(len(settings.sequence) * settings.rounds, dtype=np.float64)


def _scenario(loaded: LoadedConfig) -> LocalisationProblem:
    settings = scenario_of(loaded.config, LocalisationScenario)
    rig = rig_of(loaded)
    names = [camera.name for camera in rig.cameras]
    for name in settings.sequence:
        if name not in names:
            raise InputError(f"{loaded.path}: experiment.scenario.sequence: {unknown_camera(name, names)}")
    sequence = tuple(names.index(name) for name in settings.sequence) * settings.rounds
    return LocalisationProblem(rig, np.array(settings.position), single_config(loaded).prior, sequence)


def memory(loaded: LoadedConfig) -> float:
    """Estimate the memory of the observations."""
    settings = scenario_of(loaded.config, LocalisationScenario)
    return len(settings.sequence) * settings.rounds * OBSERVATION_BYTES


KIND = Kind(run, bounds, check, memory)
