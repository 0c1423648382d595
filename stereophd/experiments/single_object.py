"""Scenarios of one object: draw the truth and its detections, estimate, compare; errors and bounds as series.

The data of a run are drawn first and depend on the scenario and the generator alone: estimators that are
given generators of the same seed see the same detections.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.bounds import cramer_rao
from stereophd.core.disparity.events import Rig, make_rig
from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.metrics.errors import nees
from stereophd.core.metrics.truth.interpolation import last_event_of_each_time
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.random_streams import RUN_SINGLE_OBJECT
from stereophd.core.numerics.samples import MomentsSettings
from stereophd.core.simulation.objects import walk
from stereophd.core.single.base import SingleEstimate
from stereophd.core.single.build import build_estimator
from stereophd.core.single.settings import EstimatorChoice, SingleSettings
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series, method_clock
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.stream import EventStream

# Memory of an observation, bytes (measured).
OBSERVATION_BYTES = 5e3
# The estimate of an object that was not seen yet.
NOWHERE = SingleEstimate(np.full(6, np.nan), np.full(6, np.nan), np.full((6, 6), np.nan))


@dataclass(frozen=True)
class SingleObjectProblem:
    """An object observed by several cameras; one that stands still is detected in every event (paper VIII-A, B)."""

    rig: Rig
    start: Array  # (6,): State at the first event, in the world
    motion: Motion  # Motion of the object, and of the estimators' model
    prior: InitialPrior  # Prior of disparity in the camera that sees the object first, and of velocity
    times: Array  # (k,): Times of the events, s, not decreasing
    cameras: NDArray[np.int64]  # (k,) of int: Camera of each event


@dataclass(frozen=True)
class SingleObjectRun:
    """Errors (estimate minus truth) of a run, after the reported events."""

    times: Array  # (t,): Their times, s
    # `map_errors`, `mean_errors`: arrays (t, 6): Position and velocity, length and length/s, of the estimate of
    # greatest density, and of the mean; NaN where there is no estimate.
    map_errors: Array
    mean_errors: Array
    covariances: Array  # (t, 6, 6): Covariances that the estimator states


def run_single_object(
    scenario: SingleObjectProblem,
    settings: EstimatorChoice,
    moments: MomentsSettings,
    rng: np.random.Generator,
    clock: AbstractContextManager[None] | None = None,
) -> SingleObjectRun:
    """Draw a trajectory and its detections (where in view, with each detector's p_detect), and track it.

    The estimator, and not the drawing, works within `clock`. Raises ValueError if an object that stands still is not in
    view of a camera that should observe it.
    """
    states = draw_trajectory(scenario, rng)
    frames = []
    looks = zip(scenario.times.tolist(), scenario.cameras.tolist(), states[:, :3], strict=True)
    for number, (time_s, index, point) in enumerate(looks):
        camera = scenario.rig.cameras[index].at(time_s)
        noise, uniform = rng.standard_normal(2), rng.random()
        pixel = camera.project(point[None])
        seen = camera.contains(pixel) & (uniform < (camera.detector.p_detect if scenario.motion.moves else 1.0))
        if not (scenario.motion.moves or seen.any()):
            raise ValueError(f"expected the object in view of {camera.name}, found it out of view at {point}")
        frames.append(Frame(time_s, index, number, (pixel + camera.detector.sigma * noise)[seen]))
    events = list(EventStream(scenario.rig.cameras, frames))
    estimator = build_estimator(settings, moments, scenario.rig, scenario.motion, scenario.prior, rng)
    reported = last_event_of_each_time(scenario.times) if scenario.motion.moves else np.arange(len(scenario.times))
    wanted, estimates = set(reported.tolist()), []
    with clock or nullcontext():
        state = estimator.init()
        for number, event in enumerate(events):
            state, _ = estimator.step(state, event)
            if number in wanted:
                estimates.append(estimator.estimate(state) or NOWHERE)
    maps, means, covariances = (
        np.array([getattr(each, name) for each in estimates]) for name in ("map", "mean", "covariance")
    )
    return SingleObjectRun(scenario.times[reported], maps - states[reported], means - states[reported], covariances)


def localisation_bound(scenario: SingleObjectProblem, with_prior: bool) -> Array:
    """Cramer-Rao bound on the covariance of the position (k, 3, 3) of an object at rest after each event, length^2.

    Infinite where the observations so far (and the prior, if it is counted) do not determine the position.
    `stereophd.core.bounds.cramer_rao.mean_error_norm` gives the mean length of an error with such a covariance.
    """
    point = scenario.start[:3]
    cameras = [scenario.rig.cameras[camera].at(0.0) for camera in scenario.cameras.tolist()]
    information = [cramer_rao.detection_information(camera, point[None])[0] for camera in cameras]
    prior = None
    if with_prior:
        space = DisparitySpace(cameras[0], scenario.rig.baseline, scenario.rig.rectification)
        prior = cramer_rao.prior_information(space, point, scenario.prior.disparity_moments(space.packed())[1])
    return cramer_rao.localisation_bounds(information, prior)


def tracking_bound(scenario: SingleObjectProblem, rng: np.random.Generator, trajectories: int = 100) -> Array:
    """Bound (t, 6, 6) on the covariance of the state at each distinct time: the average over drawn trajectories.

    See `stereophd.core.bounds.cramer_rao.posterior_bounds`. The information of a detection is multiplied by its
    probability, which makes the bound lower than the exact one where detections are missed. The prior is that of the
    estimators.
    """
    states = np.array([draw_trajectory(scenario, rng) for _ in range(trajectories)])
    information = np.zeros((len(scenario.times), trajectories, 6, 6))
    for k, (time_s, index) in enumerate(zip(scenario.times.tolist(), scenario.cameras.tolist(), strict=True)):
        camera = scenario.rig.cameras[index].at(time_s)
        points = states[:, k, :3]
        seen = camera.in_view(points)
        information[k, seen, :3, :3] = camera.detector.p_detect * cramer_rao.detection_information(camera, points[seen])
    steps = scenario.motion.transition(np.diff(scenario.times))
    first = _state_prior_information(scenario) + information[0]
    bounds = cramer_rao.posterior_bounds(first, steps.matrix, steps.noise, information[1:])
    return np.asarray(bounds[last_event_of_each_time(scenario.times)].mean(axis=1))


def _state_prior_information(scenario: SingleObjectProblem) -> Array:
    """Information (6, 6) on the first state in the world in the prior on disparity and velocity.

    The camera that sees the object first is taken to be that of the first event.
    """
    rig, prior = scenario.rig, scenario.prior
    camera = rig.cameras[int(scenario.cameras[0])].at(float(scenario.times[0]))
    space = DisparitySpace(camera, rig.baseline, rig.rectification)
    to_disparity = cramer_rao.state_jacobian(space, scenario.start)
    precision = np.zeros(6)
    precision[2] = prior.disparity_moments(space.packed())[1] ** -2
    if prior.disparity_velocity_std_px_s is not None:
        precision[3:] = np.array(prior.disparity_velocity_std_px_s) ** -2
    information = to_disparity.T @ np.diag(precision) @ to_disparity
    if prior.disparity_velocity_std_px_s is None:
        information[3:, 3:] += np.eye(3) / prior.velocity_spread**2
    return np.asarray(information)


def draw_trajectory(scenario: SingleObjectProblem, rng: np.random.Generator) -> Array:
    """Draw the states (k, 6) of the object at the scenario's events."""
    if not scenario.motion.moves:
        return np.tile(scenario.start, (len(scenario.times), 1))
    start, intervals = np.array(scenario.start, dtype=float), np.diff(scenario.times)
    normal = rng.standard_normal((len(intervals), 2, 3))
    later = walk(start, scenario.motion.arrays(intervals), *scenario.motion.shocks(intervals, normal))
    return np.concatenate([start[None], later])


def single_config(loaded: LoadedConfig) -> SingleSettings:
    """Return the section ``filter``, or raise InputError if it is not of kind single."""
    settings = loaded.config.filter
    if not isinstance(settings, SingleSettings):
        found = "none" if settings is None else settings.kind
        raise InputError(f"{loaded.path}: filter: expected a filter of kind single for one object, found {found}")
    return settings


def rig_of(loaded: LoadedConfig) -> Rig:
    """Return the cameras with their disparity spaces."""
    config = loaded.config
    return make_rig(loaded.build_cameras(), config.disparity.baseline, config.disparity.rectification)


def _parts(loaded: LoadedConfig, moves: bool) -> Sequence[tuple[str, str, slice]]:
    """Return name, unit and columns of the state of what is compared: positions, and velocities if it moves."""
    unit = loaded.config.units.length
    return [("position", unit, slice(0, 3)), *([("velocity", f"{unit}/s", slice(3, 6))] if moves else ())]


def series_of_errors(
    loaded: LoadedConfig, number: int, scenario: SingleObjectProblem, times_s: Array | None = None
) -> list[Series]:
    """Do a run of this number; return the length of the errors of the reported estimate over time, and the NEES.

    The NEES are those about the mean. The times (t,) of the reported events can be others than those of the scenario.
    """
    rng = np.random.default_rng(RUN_SINGLE_OBJECT.seed(loaded.config.seed, number))
    settings = single_config(loaded)
    result = run_single_object(scenario, settings.estimator, loaded.config.moments, rng, method_clock())
    reported = result.map_errors if settings.point == "map" else result.mean_errors
    times_s = result.times if times_s is None else times_s
    series = []
    for name, unit, part in _parts(loaded, scenario.motion.moves):
        lengths = np.linalg.norm(reported[:, part], axis=1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # particles that (almost) sit in one place
            normalised = nees(result.mean_errors[:, part], result.covariances[:, part, part])
        series += [Series(f"{name}_error", unit, lengths, times_s), Series(f"{name}_nees", "1", normalised, times_s)]
    return series


def bounds_of(loaded: LoadedConfig, times_s: Array, covariances: Array) -> list[Series]:
    """Return the bounds of the mean and of the root mean square of errors whose least covariances are (k, d, d)."""
    series = []
    for name, unit, part in _parts(loaded, moves=covariances.shape[-1] > 3):
        means = np.array([cramer_rao.mean_error_norm(one) for one in covariances[:, part, part]])
        roots = np.sqrt(np.trace(covariances[:, part, part], axis1=1, axis2=2))
        series += [Series(f"{name}_error", unit, means, times_s), Series(f"{name}_rmse", unit, roots, times_s)]
    return series
