"""A static object observed by one camera after another (paper VIII-A, Table II and Figure 10)."""

import numpy as np

from stereophd.config.experiment import LocalisationScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.motion.static import Static
from stereophd.errors import InputError, unknown_camera
from stereophd.experiments import single_object
from stereophd.experiments.engine.base import Kind, Series, scenario_of


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless the object is in view of the cameras that observe it, and there is an estimator."""
    single_object.single_config(loaded)
    scenario, once = _scenario(loaded), len(scenario_of(loaded.config, LocalisationScenario).sequence)
    for index in dict.fromkeys(scenario.cameras[:once].tolist()):
        camera, position = scenario.rig.cameras[index], scenario.start[:3]
        if not camera.in_view(position[None])[0]:
            raise InputError(
                f"{loaded.path}: experiment.scenario.position: expected an object in view of {camera.name}, found it "
                f"out of view at {position.tolist()}"
            )


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the error of the position after each observation, and after the last one."""
    return _with_last(single_object.series_of_errors(loaded, number, _scenario(loaded), _times(loaded)))


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the Cramer-Rao bound after each observation."""
    settings = scenario_of(loaded.config, LocalisationScenario)
    covariances = single_object.localisation_bound(_scenario(loaded), settings.bound_with_prior)
    return _with_last(single_object.bounds_of(loaded, _times(loaded), covariances))


def _with_last(series: list[Series]) -> list[Series]:
    """Add the last value of each series as one of the whole run."""
    return [*series, *(Series(f"final_{one.quantity}", one.unit, one.values[-1:]) for one in series)]


def _times(loaded: LoadedConfig) -> Array:
    settings = scenario_of(loaded.config, LocalisationScenario)
    return settings.interval_s * np.arange(len(settings.sequence) * settings.rounds, dtype=np.float64)


def _scenario(loaded: LoadedConfig) -> single_object.SingleObjectProblem:
    settings = scenario_of(loaded.config, LocalisationScenario)
    rig = single_object.rig_of(loaded)
    names = [camera.name for camera in rig.cameras]
    for name in settings.sequence:
        if name not in names:
            raise InputError(f"{loaded.path}: experiment.scenario.sequence: {unknown_camera(name, names)}")
    cameras = np.tile([names.index(name) for name in settings.sequence], settings.rounds)
    start = np.array([*settings.position, 0.0, 0.0, 0.0])
    return single_object.SingleObjectProblem(
        rig, start, Static(), single_object.single_config(loaded).prior, np.zeros(len(cameras)), cameras
    )


def memory(loaded: LoadedConfig) -> float:
    """Estimate the memory of the observations."""
    settings = scenario_of(loaded.config, LocalisationScenario)
    return len(settings.sequence) * settings.rounds * single_object.OBSERVATION_BYTES


KIND = Kind(run, bounds, check, memory)
