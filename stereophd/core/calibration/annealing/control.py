"""A control track of one of the objects: it fixes the scale, the frame and the clock of a fit.

The answer states N(v, C) for the values of the cameras, the trajectories integrated out. What the places y of the
control say beside it, of the values and of the world g, is the likelihood p(y | v, g, detections). Its logarithm is the
difference of two minima over the knots x, with and without the control,

    Phi(v, g) = min_x [J(v, x) + J_control(x, g)] - min_x J(v, x),

so that gradient and curvature are differences of two eliminations of the knots. The prior and the bias of the joint
optimum that integrating out removes (`adjustment.marginal`) cancel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.alignment.to_track import Alignment, align_to_track
from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.problem import true_times
from stereophd.core.calibration.adjustment.solver import eliminate
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.controlled_linearisation import WORLD, ControlledLinearisation
from stereophd.core.calibration.annealing.fits import FITTED_LOSS, problem_of
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.unknowns.scale import can_be_enlarged, enlarged, scale_is_free
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import MOST_ESTIMATES, Freedom

# The world is known beforehand to this many deviations of the alignment, at most as well as the least ones: rad,
# length and log scale as parts, s, 1. A scale that is not free is held.
WIDER, HELD = 30.0, 1e-9
# Median distance of normal errors of unit variance along three axes; rounds in which the control's noise is found.
MEDIAN_DISTANCE, ROUNDS = 1.538, 3
# Steps at most, and the squared length, in standard deviations, of the last one.
MOST_STEPS, SETTLED = 20, 1e-4


@dataclass(frozen=True)
class ControlTrack:
    """What is known of the control."""

    track: Truth
    std: float | None  # Standard deviation of its places along each axis, if it is stated
    any_scale: bool  # Whether the cameras have no length, so that their unit and the control's differ
    length_unit: str  # Of its places


@dataclass(frozen=True)
class World:
    """Where the frame of a calibration lies in the world of its control."""

    alignment: Alignment  # After the adjustment
    covariance: Array  # (m + 9, m + 9): Of the values of the cameras and of the world
    std: float  # Standard deviation of a place that was used


def with_control(task: Task, fit: Fit, control: ControlTrack) -> tuple[Fit, World]:
    """Adjust the values of a fit, and its trajectories, to a control track of one of the objects too.

    The alignment of the fitted trajectories says which of them it is, and where the world is. Raises ValueError where
    the motion does not determine the world.
    """
    cameras = task.parameters.build(fit.adjustment.values)
    moved, found = fit, _aligned(fit, control, True)
    if not control.any_scale:
        if scale_is_free(task.parameters) and can_be_enlarged(cameras, task.reference):
            moved = _enlarged(task, fit, found.registration.scale)
        found = _aligned(moved, control, False)
    std = max(control.std or 0.0, _noise(found.distances))
    for _ in range(ROUNDS):
        moved, world = _adjusted(task, fit, moved, control, found, std)
        again = max(control.std or std, _noise(world.alignment.distances))
        if again > 0.8 * std:
            break
        std = again
    return moved, world


def _noise(distances: Array) -> float:
    return float(np.median(distances)) / MEDIAN_DISTANCE


def _enlarged(task: Task, fit: Fit, ratio: float) -> Fit:
    """Return a fit at another scale, which no detection shows."""
    cameras = task.parameters.build(fit.adjustment.values)
    values = task.parameters.difference(enlarged(cameras, task.reference, ratio))
    origin, states = cameras[task.reference].pose.center, ratio * fit.adjustment.states
    states[:, 0] += (1.0 - ratio) * origin
    return replace(fit, adjustment=replace(fit.adjustment, values=values, states=states))


def _aligned(fit: Fit, control: ControlTrack, any_scale: bool) -> Alignment:
    """Align the fitted trajectories with the control."""
    spans = fit.knots.spans
    step = max(0.5 * control.track.step_s, float(np.ptp(spans, axis=1).sum()) / MOST_ESTIMATES)
    times = [np.arange(start, end, step) for start, end in spans]
    ids = np.repeat(np.arange(len(spans)), [len(one) for one in times])
    every = np.concatenate(times)
    places = positions(fit.adjustment.states, *interpolation(fit.knots, ids, every))
    order = np.argsort(every, kind="stable")
    return align_to_track(every[order], places[order], ids[order], control.track, Freedom(True, any_scale, True))


def _adjusted(
    task: Task, answer: Fit, fit: Fit, control: ControlTrack, found: Alignment, std: float
) -> tuple[Fit, World]:
    """Adjust to the control with a noise, from a fit near it; what the detections say is the answer."""
    times = found.registration.track_times(control.track.time_s)
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
        alone, control.track.time_s[rows], control.track.position[rows], member[rows], std, found.registration,
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
            eliminated, schur = eliminate(equations, 0.0)
            size = len(schur)
            matrix[:size, :size] += sign * schur
            vector[:size] += sign * (equations.value_vector - equations.coupling.T @ eliminated[:, -1])
            followed.append(eliminated)
        step = np.linalg.solve(matrix, vector)
        values = values + step
        states = [
            state + (one[:, -1] - one[:, :-1] @ step[: one.shape[1] - 1]).reshape(state.shape)
            for state, one in zip(states, followed, strict=True)
        ]
        if step @ matrix @ step < SETTLED:
            break
    covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    errors, _, registration, _ = both.residuals(values, states[0])
    adjustment = replace(
        fit.adjustment, values=values[:count], states=states[0], covariance=covariance[:count, :count],
        distances=alone.at(values[:count], states[0]).distances,
    )  # fmt: skip
    seen = replace(fit.observations, times=true_times(task.parameters.build(values[:count]), fit.observations))
    alignment = replace(
        found, registration=registration, covariance=covariance[count:, count:],
        distances=np.linalg.norm(errors, axis=1),
    )  # fmt: skip
    return replace(fit, adjustment=adjustment, observations=seen, held=None), World(alignment, covariance, std)
