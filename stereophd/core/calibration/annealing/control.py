"""Control: a track of one of the objects, or points of known place, fix the scale and the frame of a fit.

Points meet the cameras alone: they observe the values v and the world g (`alignment.to_points`), and the trajectories
follow. A control track fixes the clock, too. The answer states N(v, C) for the values of the cameras, the trajectories
integrated out. What the places y of a track say beside it, of the values and of the world, is the likelihood
p(y | v, g, detections). Its logarithm is the difference of two minima over the knots x, with and without the control,

    Phi(v, g) = min_x [J(v, x) + J_control(x, g)] - min_x J(v, x),

so that gradient and curvature are differences of two eliminations of the knots. The prior and the bias of the joint
optimum that integrating out removes (`adjustment.marginal`) cancel.
"""

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.alignment.to_points import ControlPoints, adjust_to_points, align_to_points
from stereophd.core.alignment.to_track import align_to_track
from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.linearisation import Linearisation, factor_knots
from stereophd.core.calibration.adjustment.solver import Eliminated, settled_knots
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.controlled_linearisation import WORLD, ControlledLinearisation
from stereophd.core.calibration.annealing.fits import FITTED_LOSS, at_values, problem_of
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.unknowns.scale import can_be_enlarged, enlarged, scale_is_free
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import MEDIAN_DISTANCE, MOST_ESTIMATES, Alignment, Freedom, TrackedPlaces

# The world is known beforehand to this many deviations of the alignment, at most as well as the least ones: rad,
# length and log scale as parts, s, 1. A scale that is not free is held.
WIDER, HELD = 30.0, 1e-9
# Rounds in which the control's noise is found.
ROUNDS = 3
# Steps at most, and the squared length, in standard deviations, of the last one.
MOST_STEPS, SETTLED = 20, 1e-4


@dataclass(frozen=True)
class WorldControl:
    """What is known of places in the world."""

    known: Truth | ControlPoints
    std: float | None  # Standard deviation of the places of a track along each axis, if it is stated
    any_scale: bool  # Whether the cameras have no length, so that their unit and the control's differ
    length_unit: str  # Of its places


@dataclass(frozen=True)
class World:
    """Where the frame of a calibration lies in the world of its control."""

    alignment: Alignment  # After the adjustment
    covariance: Array  # (m + 9, m + 9): Of the values of the cameras and of the world
    std: float  # Standard deviation of a place that was used


def with_control(task: Task, fit: Fit, control: WorldControl) -> tuple[Fit, World]:
    """Adjust the values of a fit, and its trajectories, to a control too.

    The alignment of the fit determines which object the track belongs to, and where the world is. Raises ValueError
    where the control does not determine the world.
    """
    cameras = task.parameters.build(fit.adjustment.values)
    resized = not control.any_scale and scale_is_free(task.parameters) and can_be_enlarged(cameras, task.reference)
    if isinstance(control.known, ControlPoints):
        ratio = align_to_points(cameras, control.known, True).registration.scale if resized else 1.0
        return _adjusted_to_points(task, fit, _enlarged(task, fit, ratio), control.known, control.any_scale)
    track = control.known
    moved, found = fit, _aligned(fit, track, True)
    if not control.any_scale:
        moved = _enlarged(task, fit, found.registration.scale if resized else 1.0)
        found = _aligned(moved, track, False)
    std = max(control.std or 0.0, _noise(found.distances))
    for _ in range(ROUNDS):
        moved, world = _adjusted(task, fit, moved, replace(control, std=std), found)
        again = max(control.std or std, _noise(world.alignment.distances))
        if again > 0.8 * std:
            break
        std = again
    return moved, world


def _noise(distances: Array) -> float:
    return float(np.median(distances)) / MEDIAN_DISTANCE


def _enlarged(task: Task, fit: Fit, ratio: float) -> Fit:
    """Return a fit at another scale, which no detection shows."""
    if ratio == 1.0:
        return fit
    cameras = task.parameters.build(fit.adjustment.values)
    values = task.parameters.difference(enlarged(cameras, task.reference, ratio))
    origin, states = cameras[task.reference].pose.center, ratio * fit.adjustment.states
    states[:, 0] += (1.0 - ratio) * origin
    return replace(fit, adjustment=replace(fit.adjustment, values=values, states=states))


def _aligned(fit: Fit, track: Truth, any_scale: bool) -> Alignment:
    """Align the fitted trajectories with the control."""
    spans = fit.knots.spans
    step = max(0.5 * track.step_s, float(np.ptp(spans, axis=1).sum()) / MOST_ESTIMATES)
    times = [np.arange(start, end, step) for start, end in spans]
    ids = np.repeat(np.arange(len(spans)), [len(one) for one in times])
    every = np.concatenate(times)
    places = positions(fit.adjustment.states, *interpolation(fit.knots, ids, every))
    alike = np.tile(np.eye(3), (len(every), 1, 1))
    trajectories = TrackedPlaces(every, places, alike, ids).take(np.argsort(every, kind="stable"))
    return align_to_track(trajectories, track, Freedom(True, any_scale, True))


def _adjusted(task: Task, answer: Fit, fit: Fit, control: WorldControl, found: Alignment) -> tuple[Fit, World]:
    """Adjust to a track of a known noise, from a fit near it; what the detections say is the answer."""
    track, std = control.known, control.std
    assert isinstance(track, Truth)
    assert std is not None
    times = found.registration.track_times(track.time_s)
    member = np.full(len(times), -1, dtype=np.int64)
    for number in found.members:
        start, end = fit.knots.spans[number]
        member[(times >= start) & (times <= end)] = number
    rows = np.flatnonzero(member >= 0)
    world_std = np.maximum(WIDER * found.std, 1e-6)
    world_std[6] = world_std[6] if control.any_scale else HELD
    problem = problem_of(task, fit)
    alone = Linearisation.of(problem.weighted(problem.weights(answer.adjustment.distances)))
    both = ControlledLinearisation(
        alone, track.time_s[rows], track.position[rows], member[rows], std, found.registration,
        found.center, world_std, FITTED_LOSS,
    )  # fmt: skip
    count = task.parameters.size
    values, states = np.append(fit.adjustment.values, np.zeros(WORLD)), [fit.adjustment.states] * 2
    precision = np.linalg.inv(answer.adjustment.covariance)
    for _ in range(MOST_STEPS):
        matrix, vector, followed = np.zeros((len(values),) * 2), np.zeros(len(values)), []
        matrix[:count, :count] = precision
        vector[:count] = -precision @ (values[:count] - answer.adjustment.values)
        for sign, equations in ((1.0, both.at(values, states[0])), (-1.0, alone.at(values[:count], states[1]))):
            eliminated = Eliminated.of(equations, factor_knots(equations.bands))
            size = len(eliminated.right)
            matrix[:size, :size] += sign * eliminated.schur
            vector[:size] += sign * eliminated.right
            followed.append(eliminated)
        step = np.asarray(np.linalg.solve(matrix, vector), dtype=np.float64)
        values = values + step
        states = [
            state + eliminated.knots_after(step[: len(eliminated.right)]).reshape(state.shape)
            for state, eliminated in zip(states, followed, strict=True)
        ]
        if step @ matrix @ step < SETTLED:
            break
    covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    errors, _, registration, _ = both.residuals(values, states[0])
    alignment = replace(
        found, registration=registration, covariance=covariance[count:, count:],
        distances=np.linalg.norm(errors, axis=1),
    )  # fmt: skip
    moved = at_values(task, fit, values[:count], states[0], covariance[:count, :count])
    return moved, World(alignment, covariance, std)


def _adjusted_to_points(task: Task, answer: Fit, fit: Fit, points: ControlPoints, any_scale: bool) -> tuple[Fit, World]:
    """Adjust the values to points, from a fit near them, and let the trajectories follow."""
    precision: Array = np.asarray(np.linalg.inv(answer.adjustment.covariance), dtype=np.float64)
    means = answer.adjustment.values
    values, alignment, covariance = adjust_to_points(
        points, task.parameters.build, fit.adjustment.values, means, precision, any_scale
    )
    problem = problem_of(task, fit)
    alone = Linearisation.of(problem.weighted(problem.weights(answer.adjustment.distances)))
    states, *_ = settled_knots(alone, values, fit.adjustment.states)
    std = float(np.median(points.precisions[points.precisions > 0.0]) ** -0.5)
    of_values = covariance[: len(values), : len(values)]
    return at_values(task, fit, values, states, of_values), World(alignment, covariance, std)
