"""Check whether a configuration holds what a command needs, before there is a log."""

from collections.abc import Callable, Mapping

from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError


def check_config(loaded: LoadedConfig, command: str | None = None) -> None:
    """Check a configuration for one of `COMMANDS`; without one, only its section ``experiment``, if there is one.

    Raises InputError if something that the command needs is missing, or does not fit the rest of the configuration.
    """
    if command is not None:
        COMMANDS[command](loaded)
    elif loaded.config.experiment is not None:
        _check_experiment(loaded)


def _check_track(loaded: LoadedConfig) -> None:
    from stereophd.config.loading import variant
    from stereophd.core.motion.settings import ESTIMATE
    from stereophd.pipeline.tracking.run import build_tracking

    if getattr(loaded.config.motion, "acceleration_std", None) == ESTIMATE:
        loaded = variant(loaded, [("", {"motion.acceleration_std": 1.0})])  # any number: the log will give it
    build_tracking(loaded)


def _check_calibrate(loaded: LoadedConfig) -> None:
    from stereophd.pipeline.calibration.problem import build_scale, pmb_filter
    from stereophd.pipeline.calibration.unknowns import build_parameters

    parameters, _ = build_parameters(loaded)
    build_scale(loaded, parameters)
    pmb_filter(loaded, parameters.cameras)


def _check_simulate(loaded: LoadedConfig) -> None:
    from stereophd.commands.simulate import check_simulation
    from stereophd.core.numerics.random_streams import RUN_OBJECTS
    from stereophd.pipeline.simulation import build_scene

    check_simulation(loaded)
    build_scene(loaded.config, loaded.build_cameras(), RUN_OBJECTS.seed(loaded.config.seed, 0))


def _check_experiment(loaded: LoadedConfig) -> None:
    from stereophd.experiments.engine.work import check_experiment

    if loaded.config.experiment is None:
        raise InputError(f"{loaded.path}: experiment: expected a section `experiment`, found none")
    check_experiment(loaded)


# Needs of each command. The commands themselves check the same, and then the log.
COMMANDS: Mapping[str, Callable[[LoadedConfig], None]] = {
    "track": _check_track,
    "calibrate": _check_calibrate,
    "simulate": _check_simulate,
    "experiment": _check_experiment,
}
