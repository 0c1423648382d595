"""Cameras calibrated from moving objects: errors over time (paper VIII-D, Figure 13).

Run k is the scene of run k of several runs of ``simulate``; the calibration begins with cameras about which the true
ones are a draw from its prior, those of ``guess.yaml``. Errors are those of the estimate given the data up to a time.
"""

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereophd.config.experiment import CalibrationScenario
from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.bounds.calibration import TruePositions, calibration_bound
from stereophd.core.bounds.cramer_rao import mean_error_norm
from stereophd.core.calibration.adjustment.recording import Recording
from stereophd.core.calibration.annealing.fits import HistoryRow
from stereophd.core.calibration.unknowns.observability import UNDETERMINED, observability, pose_spread, posed_cameras
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.metrics.calibration import normalised_error_squared, pose_errors
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_GUESS, RUN_METHOD, RUN_OBJECTS
from stereophd.core.numerics.times import SAME_TIME_S
from stereophd.core.simulation.detections import Scene, simulate_frames
from stereophd.experiments.engine.base import Kind, Series, frames_in_order, method_clock, scenario_of
from stereophd.pipeline.build import build_motion
from stereophd.pipeline.calibration.annealed import annealed_outcome
from stereophd.pipeline.calibration.configured_unknowns import build_parameters, calibration_section, draw_guess
from stereophd.pipeline.calibration.problem import (
    CalibrationProblem,
    CalibrationRun,
    build_scale,
    pmb_filter,
    size_of_calibration,
)
from stereophd.pipeline.calibration.report import status_of
from stereophd.pipeline.calibration.sampled import sequential_outcome
from stereophd.pipeline.evaluation.calibration_bounds import scene_positions
from stereophd.pipeline.runs.sizes import counts_of_scene
from stereophd.pipeline.runs.unfinished import UnfinishedRun
from stereophd.pipeline.simulation import build_scene, simulate_section
from stereophd.wording import shown_unit

# Half of the interval that holds 90 % of a Gaussian, in standard deviations.
INTERVAL_90 = 1.6448536269514722


# Memory of the bound at a time, bytes (measured).
TIME_BYTES = 5e3


def check(loaded: LoadedConfig) -> None:
    """Raise `InputError` unless there are cameras, a filter, a scene and a calibration."""
    simulate_section(loaded)
    parameters, _ = build_parameters(loaded)
    pmb_filter(loaded, parameters.cameras)  # the configuration must name births


def run(loaded: LoadedConfig, number: int) -> list[Series]:
    """Return the errors of the cameras over time, the spread that the calibration states, and its NEES."""
    section = calibration_section(loaded)
    scene, guessed, parameters, reference, true = _setting(loaded, number)
    frame_seed = RUN_FRAMES.seed(loaded.config.seed, number)
    frames = frames_in_order(parameters.cameras, simulate_frames(scene, frame_seed))
    recording = Recording.of(parameters.cameras, [(f.camera, f.time_s, f.pixels, f.sigma) for f in frames])
    problem = CalibrationProblem(parameters, reference, recording, build_scale(guessed, parameters), {})
    method = annealed_outcome if section.method == "annealed" else sequential_outcome
    with tempfile.TemporaryDirectory() as folder, method_clock():
        run = CalibrationRun(guessed, problem, UnfinishedRun(Path(folder), ""), history_times=_times(loaded))
        outcome = method(run)
    found = Series("found", "1", np.array([float(status_of(problem, outcome)[0] != UNDETERMINED)]))
    limits = _scene_bounds(loaded, number)
    return [found, *_errors(loaded, parameters, reference, true, outcome.history, limits)]


def bounds(loaded: LoadedConfig) -> list[Series]:
    """Return the Cramer-Rao bound over time, its variances averaged over scenes."""
    _, _, parameters, reference, true = _setting(loaded, 0)
    scenes = range(scenario_of(loaded.config, CalibrationScenario).bound_scenes)
    covariances = np.mean([_scene_bounds(loaded, number) for number in scenes], axis=0)
    return _bound_series(loaded, parameters, reference, true, covariances)


def _scene_bounds(loaded: LoadedConfig, number: int) -> Array:
    """Bounds on the covariance (t, m, m) of the parameters at the times of the scenario, for the scene of a run."""
    scene, guessed, parameters, reference, true = _setting(loaded, number)
    motion, scale = build_motion(loaded.config, loaded.path), build_scale(guessed, parameters)
    truth = scene_positions(scene)
    bounds = []
    for time_s in _times(loaded).tolist():
        past = TruePositions(*(values[truth.times <= time_s + SAME_TIME_S] for values in truth))
        bounds.append(calibration_bound(parameters, true, reference, motion, past, scale))
    return np.array(bounds)


def _times(loaded: LoadedConfig) -> Array:
    """Times at which the estimate is scored: multiples of the interval within the run."""
    every_s, scene = scenario_of(loaded.config, CalibrationScenario).every_s, simulate_section(loaded)
    count = math.ceil(scene.duration_s / every_s - SAME_TIME_S) - 1
    return scene.start_s + every_s * np.arange(1.0, count + 1.0)


def _setting(loaded: LoadedConfig, number: int) -> tuple[Scene, LoadedConfig, ParameterSet, int, Array]:
    """Return the scene of a run, the configuration with guessed cameras, its unknowns, and their true values."""
    config = loaded.config
    true_cameras = loaded.build_cameras()
    scene = build_scene(config, true_cameras, RUN_OBJECTS.seed(config.seed, number))
    guess = draw_guess(loaded, RUN_GUESS.seed(config.seed, number))
    run_seed = RUN_METHOD.seed(config.seed, number).generate_state(1)
    guessed = replace(loaded, config=config.model_copy(update={"seed": int(run_seed[0]), "cameras": guess}))
    parameters, reference = build_parameters(guessed)
    return scene, guessed, parameters, reference, parameters.difference(true_cameras)


def _errors(
    loaded: LoadedConfig,
    parameters: ParameterSet,
    reference: int,
    true: Array,
    history: Sequence[HistoryRow],
    limits: Array,
) -> list[Series]:
    """Return errors at the times of the scenario, each by the last estimate up to then; NaN before the first."""
    times, unit = _times(loaded), loaded.config.units.length
    known = np.array([row.time_s for row in history])
    truth = [camera.pose for camera in parameters.build(true)]
    values: dict[str, Array] = {}
    for k, time_s in enumerate(times.tolist()):
        last = int(np.searchsorted(known, time_s + SAME_TIME_S, side="right")) - 1
        if last < 0:
            continue
        mean, covariance = history[last].mean, history[last].covariance
        errors = pose_errors([camera.pose for camera in parameters.build(mean)], truth, reference)
        limit = _spreads(parameters, reference, true, limits[k])
        figures = {
            "rotation_error": math.degrees(_root(errors.rotation)),
            "direction_error": math.degrees(_root(errors.direction)),
            "center_error": _root(errors.center),
            **_spreads(parameters, reference, mean, covariance),
            "nees": normalised_error_squared(mean - true, covariance),
            "coverage_90": float((np.abs(mean - true) <= INTERVAL_90 * np.sqrt(np.diag(covariance))).mean()),
            "scale_std_ratio": observability(parameters, reference, mean, covariance).scale_ratio,
        }
        for name in ("rotation", "direction"):
            figures[f"{name}_error_ratio"] = figures[f"{name}_error"] / limit[f"{name}_std"]
        for j, (name, _, factor) in enumerate(_unknowns(parameters, unit)):
            figures[f"{name}_error"] = abs(mean[j] - true[j]) * factor
        for name, value in figures.items():
            values.setdefault(name, np.full(len(times), np.nan))[k] = value
    units = _units(parameters, unit)
    return [Series(name, units.get(name, "1"), series, times) for name, series in values.items()]


def _bound_series(
    loaded: LoadedConfig, parameters: ParameterSet, reference: int, true: Array, covariances: Array
) -> list[Series]:
    """Return the bounds of the root mean squares (and of one unknown, of the mean) from covariances (t, m, m)."""
    times, length = _times(loaded), loaded.config.units.length
    units = _units(parameters, length)
    spreads = [_spreads(parameters, reference, true, covariance) for covariance in covariances]
    series = [
        Series(f"{name}_rmse", units[f"{name}_error"], np.array([spread[f"{name}_std"] for spread in spreads]), times)
        for name in ("rotation", "direction", "center")
    ]
    for j, (name, unit, factor) in enumerate(_unknowns(parameters, length)):
        roots = np.sqrt(covariances[:, j, j]) * factor
        means = np.array([mean_error_norm(np.array([[root**2]])) for root in roots])
        series += [Series(f"{name}_rmse", unit, roots, times), Series(f"{name}_error", unit, means, times)]
    return series


def _spreads(parameters: ParameterSet, reference: int, values: Array, covariance: Array) -> dict[str, float]:
    """Return standard deviations of rotation and direction, degrees, and of the centre; of several cameras their root
    mean square."""
    cameras = posed_cameras(parameters)
    spreads = [pose_spread(parameters, reference, values, covariance, camera) for camera in cameras]
    return {
        "rotation_std": math.degrees(_root(np.array([spread.rotation for spread in spreads]))),
        "direction_std": math.degrees(_root(np.array([spread.direction for spread in spreads]))),
        "center_std": _root(np.array([spread.center for spread in spreads])),
    }


def _unknowns(parameters: ParameterSet, length: str) -> list[tuple[str, str, float]]:
    """Return name and unit of every unknown, angles in degrees, and the factor to that unit."""
    shown = (shown_unit(parameter.unit, length)[::-1] for parameter in parameters.parameters)
    return [(name.replace(".", "_"), *unit) for name, unit in zip(parameters.names, shown, strict=True)]


def _units(parameters: ParameterSet, length: str) -> dict[str, str]:
    units = {f"{name}_error": unit for name, unit, _ in _unknowns(parameters, length)}
    for kind in ("error", "std"):
        units |= {f"rotation_{kind}": "deg", f"direction_{kind}": "deg", f"center_{kind}": length}
    return units


def _root(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


def memory(loaded: LoadedConfig) -> float:
    """Estimate the memory of the calibration, and of the bounds, which are computed at every time of the scenario."""
    settings, scene = scenario_of(loaded.config, CalibrationScenario), counts_of_scene(loaded)
    times = simulate_section(loaded).duration_s / settings.every_s
    size = size_of_calibration(calibration_section(loaded), scene.frames, scene.detections)
    return times * TIME_BYTES + size.memory_bytes


KIND = Kind(run, bounds, check, memory)
