"""Check whether a log fits cameras and settings, and whether a configuration holds what a command needs."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from stereophd.config.loading import LoadedConfig
from stereophd.io.outputs.json_text import REPORT_VERSION
from stereophd.io.outputs.provenance import provenance
from stereophd.pipeline.batch.names import expand
from stereophd.pipeline.checks.check_log import check_log
from stereophd.pipeline.checks.finding import warnings_of


def check(loaded: LoadedConfig, log_path: Path | str) -> dict[str, Any]:
    """Check a log, or a folder that holds one, against a configuration with cameras; nothing is written.

    Returns ``report_version``, ``warnings`` (their number), ``checks`` (the fields of
    `stereophd.pipeline.checks.finding.Finding`, one entry a check) and ``provenance``. Raises InputError if the
    configuration has no cameras, or the log is not usable.
    """
    [log_path] = expand([log_path])
    findings = check_log(loaded, log_path)
    return {
        "report_version": REPORT_VERSION,
        "warnings": len(warnings_of(findings)),
        "checks": [finding.as_dict() for finding in findings],
        "provenance": provenance("check", loaded.record, inputs={"detections": log_path}),
    }


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
    from stereophd.pipeline.tracking.tracking_run import build_tracking

    if getattr(loaded.config.motion, "acceleration_std", None) == ESTIMATE:
        loaded = variant(loaded, [("", {"motion.acceleration_std": 1.0})])  # any number: the log will give it
    build_tracking(loaded)


def _check_calibrate(loaded: LoadedConfig) -> None:
    from stereophd.pipeline.calibration.configured_unknowns import build_parameters
    from stereophd.pipeline.calibration.problem import build_scale, pmb_filter

    if any(camera.must_be_found for camera in loaded.cameras.values()):
        from stereophd.pipeline.calibration.found_cameras import refuse_search

        refuse_search(loaded)
        return
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
    from stereophd.experiments.engine.work import experiment_section, plan_parts

    plan_parts(loaded, experiment_section(loaded))


# Needs of each command. The commands themselves check the same, and then the log.
COMMANDS: Mapping[str, Callable[[LoadedConfig], None]] = {
    "track": _check_track,
    "calibrate": _check_calibrate,
    "simulate": _check_simulate,
    "experiment": _check_experiment,
}
