"""One Monte Carlo run of a single-object experiment: draw the truth and its detections, estimate, compare.

The data of a run are drawn first and depend on the scenario and the generator alone: estimators that are
given generators of the same seed see the same detections.
"""

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.bounds.cramer_rao import (
    detection_information,
    localisation_bounds,
    posterior_bounds,
    prior_information,
    state_jacobian,
)
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.base import Motion
from stereophd.core.motion.static import Static
from stereophd.core.simulation.objects import walk
from stereophd.core.single.base import AnyEstimator
from stereophd.core.single.build import build_estimator
from stereophd.core.single.settings import EstimatorSettings
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.stream import EventStream


@dataclass(frozen=True)
class LocalisationProblem:
    """A static object observed by one camera after another (paper VIII-A)."""

    rig: Rig
    position: Array  # (3,): The object, in the world
    prior: InitialPrior  # Prior of the disparity in the camera that sees the object first
    sequence: tuple[int, ...]  # Camera (index in the rig) of each observation


@dataclass(frozen=True)
class LocalisationRun:
    """Errors (estimate minus truth) after each observation of a run, length."""

    # `map_errors`, `mean_errors`: arrays (k, 3): Errors of the estimate of greatest density, and of the mean; NaN
    # where there is none.
    map_errors: Array
    mean_errors: Array
    covariances: Array  # (k, 3, 3): Covariances that the estimator states


def localisation_run(
    scenario: LocalisationProblem,
    settings: EstimatorSettings,
    rng: np.random.Generator,
    clock: AbstractContextManager[None] | None = None,
) -> LocalisationRun:
    """Draw one observation for each entry of the sequence, estimate, and compare after each.

    The estimator, and not the drawing, works within `clock`. Raises ValueError if the object is not in view of a camera
    that should observe it.
    """
    frames = []
    for number, camera in enumerate(scenario.sequence):
        frame = _draw_frame(scenario.rig, camera, number, 0.0, scenario.position, 1.0, rng)
        if len(frame.pixels) == 0:
            name = scenario.rig.cameras[camera].name
            raise ValueError(f"expected the object in view of {name}, found it out of view at {scenario.position}")
        frames.append(frame)
    events = list(EventStream(scenario.rig.cameras, frames))
    estimator = build_estimator(settings, scenario.rig, Static(), scenario.prior, rng)
    with clock or nullcontext():
        maps, means, covariances = _run(estimator, events, range(len(events)))
    return LocalisationRun(maps[:, :3] - scenario.position, means[:, :3] - scenario.position, covariances[:, :3, :3])


def localisation_bound(scenario: LocalisationProblem, with_prior: bool) -> Array:
    """Cramer-Rao bound on the covariance of the position (k, 3, 3) after each observation, length^2.

    Infinite where the observations so far (and the prior, if it is counted) do not determine the position.
    `stereophd.core.bounds.cramer_rao.mean_error_norm` gives the mean length of an error with such a covariance.
    """
    point = scenario.position
    cameras = [scenario.rig.cameras[camera].at(0.0) for camera in scenario.sequence]
    information = [detection_information(camera, point[None])[0] for camera in cameras]
    prior = None
    if with_prior:
        space = DisparitySpace(cameras[0], scenario.rig.baseline, scenario.rig.rectification)
        prior = prior_information(space, point, scenario.prior.disparity_moments(space.packed())[1])
    return localisation_bounds(information, prior)


@dataclass(frozen=True)
class TrackingProblem:
    """A moving object observed by several cameras (paper VIII-B)."""

    rig: Rig
    start: Array  # (6,): State at the first event, in the world
    motion: Motion  # Motion of the object, and of the estimators' model
    prior: InitialPrior  # Prior of disparity in the camera that sees the object first, and of velocity
    times: Array  # (k,): Times of the events, s, not decreasing
    cameras: NDArray[np.int64]  # (k,) of int: Camera of each event


@dataclass(frozen=True)
class SingleObjectRun:
    """Errors (estimate minus truth) of a run, after the last event of each distinct time."""

    times: Array  # (t,): Distinct times, s
    # `map_errors`, `mean_errors`: arrays (t, 6): Position and velocity, length and length/s; NaN where there is no
    # estimate.
    map_errors: Array
    mean_errors: Array
    covariances: Array  # (t, 6, 6): Covariances that the estimator states


def tracking_run(
    scenario: TrackingProblem,
    settings: EstimatorSettings,
    rng: np.random.Generator,
    clock: AbstractContextManager[None] | None = None,
) -> SingleObjectRun:
    """Draw a trajectory and its detections (where in view, with each detector's p_detect), and track it.

    The estimator, and not the drawing, works within `clock`.
    """
    states = draw_trajectory(scenario, rng)
    frames = []
    looks = zip(scenario.times.tolist(), scenario.cameras.tolist(), states, strict=True)
    for number, (time_s, camera, state) in enumerate(looks):
        p_detect = scenario.rig.cameras[camera].detector.p_detect
        frames.append(_draw_frame(scenario.rig, camera, number, time_s, state[:3], p_detect, rng))
    events = list(EventStream(scenario.rig.cameras, frames))
    estimator = build_estimator(settings, scenario.rig, scenario.motion, scenario.prior, rng)
    last = last_events(scenario.times)
    with clock or nullcontext():
        maps, means, covariances = _run(estimator, events, last.tolist())
    return SingleObjectRun(scenario.times[last], maps - states[last], means - states[last], covariances)


def tracking_bound(
    scenario: TrackingProblem,
    rng: np.random.Generator,
    trajectories: int = 100,
    kind: Literal["conditional", "posterior"] = "conditional",
) -> Array:
    """Bound (t, 6, 6) on the covariance of the state at each distinct time, over trajectories drawn from `rng`.

    It is the average of the bounds along each trajectory (conditional); or the bound of the average information
    (posterior: Tichavsky, Muravchik and Nehorai 1998), which is lower. See
    `stereophd.core.bounds.cramer_rao.posterior_bounds`. The information of a detection is multiplied by its
    probability, which makes the bound lower than the exact one where detections are missed. The prior is that of the
    estimators.
    """
    states = np.array([draw_trajectory(scenario, rng) for _ in range(trajectories)])
    information = np.zeros((len(scenario.times), trajectories, 6, 6))
    for k, (time_s, index) in enumerate(zip(scenario.times.tolist(), scenario.cameras.tolist(), strict=True)):
        camera = scenario.rig.cameras[index].at(time_s)
        points = states[:, k, :3]
        seen = camera.in_view(points)
        information[k, seen, :3, :3] = camera.detector.p_detect * detection_information(camera, points[seen])
    if kind == "posterior":
        information = information.mean(axis=1, keepdims=True)
    steps = [scenario.motion.transition(dt) for dt in np.diff(scenario.times).tolist()]
    transitions, noises = np.array([step.matrix for step in steps]), np.array([step.noise for step in steps])
    bounds = posterior_bounds(_state_prior_information(scenario) + information[0], transitions, noises, information[1:])
    return np.asarray(bounds[last_events(scenario.times)].mean(axis=1))


def _state_prior_information(scenario: TrackingProblem) -> Array:
    """Information (6, 6) on the first state in the world in the prior on disparity and velocity.

    The camera that sees the object first is taken to be that of the first event.
    """
    rig, prior = scenario.rig, scenario.prior
    camera = rig.cameras[int(scenario.cameras[0])].at(float(scenario.times[0]))
    space = DisparitySpace(camera, rig.baseline, rig.rectification)
    to_disparity = state_jacobian(space, scenario.start)
    precision = np.zeros(6)
    precision[2] = prior.disparity_moments(space.packed())[1] ** -2
    if prior.disparity_velocity_std_px_s is not None:
        precision[3:] = np.array(prior.disparity_velocity_std_px_s) ** -2
    information = to_disparity.T @ np.diag(precision) @ to_disparity
    if prior.disparity_velocity_std_px_s is None:
        information[3:, 3:] += np.eye(3) / prior.velocity_spread**2
    return np.asarray(information)


def draw_trajectory(scenario: TrackingProblem, rng: np.random.Generator) -> Array:
    """Draw the states (k, 6) of the object at the scenario's events."""
    start, intervals = np.array(scenario.start, dtype=float), np.diff(scenario.times)
    normal = rng.standard_normal((len(intervals), 2, 3))
    later = walk(start, scenario.motion.arrays(intervals), *scenario.motion.shocks(intervals, normal))
    return np.concatenate([start[None], later])


def last_events(times: Array) -> NDArray[np.intp]:
    """Indices (t,) of the last event of each distinct time."""
    return np.flatnonzero(np.append(np.diff(times) > 0.0, True))


def _draw_frame(
    rig: Rig, index: int, number: int, time_s: float, point: Array, p_detect: float, rng: np.random.Generator
) -> Frame:
    """Draw the frame of one camera that sees a point (3,) of the world, if it is in view and detected."""
    camera = rig.cameras[index].at(time_s)
    noise, uniform = rng.standard_normal(2), rng.random()
    pixel = camera.project(point[None])
    seen = camera.contains(pixel) & (uniform < p_detect)
    return Frame(time_s, index, number, (pixel + camera.detector.sigma * noise)[seen])


def _run(estimator: AnyEstimator, events: list[Event], report: Iterable[int]) -> tuple[Array, Array, Array]:
    """Modes (k, 6), means (k, 6) and covariances (k, 6, 6) after the events with these numbers."""
    state = estimator.init()
    wanted = set(report)
    maps, means, covariances = [], [], []
    for number, event in enumerate(events):
        state, _ = estimator.step(state, event)
        if number not in wanted:
            continue
        estimate = estimator.estimate(state)
        maps.append(np.full(6, np.nan) if estimate is None else estimate.map)
        means.append(np.full(6, np.nan) if estimate is None else estimate.mean)
        covariances.append(np.full((6, 6), np.nan) if estimate is None else estimate.covariance)
    return np.array(maps), np.array(means), np.array(covariances)
