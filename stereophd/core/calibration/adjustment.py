"""Bundle adjustment: maximum a posteriori over camera parameters and all trajectories at once.

Minimised is half of

    sum_n w_n rho(e_n^T P_n e_n) + |(values - mean) / std|^2 + m(x) / s^2 + ((scale measured - h) / std)^2,

with the reprojection error e_n of every detection, its precision P_n and weight w_n, the priors of the camera
parameters, the motion model m(x) of the trajectories' knots x (positions and velocities have no prior), and the scale s
of the scene (`calibration.scale`). The steps are those of Levenberg and Marquardt on the normal equations

    [ A   C ] [dx]   [a]
    [ C^T B ] [dv] = [b],     A banded (knots), B small (cameras),

solved by the Schur complement B - C^T A^-1 C (W. Triggs et al., "Bundle adjustment - a modern synthesis", 2000),
whose inverse at the optimum is the covariance of the camera parameters, the trajectories integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded

from stereophd.core.calibration import normal_equations
from stereophd.core.calibration.parameters import ParameterSet, taken
from stereophd.core.calibration.quantities.base import TIMES
from stereophd.core.calibration.quantities.looking import look
from stereophd.core.calibration.scale import ScaleMeasurement, log_scale, predicted
from stereophd.core.calibration.trajectories import (
    Interpolation,
    Knots,
    MotionPrior,
    banded_product,
    interpolation,
    motion_prior,
    positions,
    slopes,
)
from stereophd.core.geometry.camera import Camera

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Marquardt's damping: where it starts, its factor, and where it gives up.
FIRST_DAMPING, DAMPING_FACTOR, MOST_DAMPING = 1e-4, 8.0, 1e10
# Relative weight on the diagonal that keeps the factorisation of nearly singular knots from failing.
ROUNDING = 1e-13


@dataclass(frozen=True)
class Observations:
    """Detections that belong to trajectories.

    Attributes
    ----------
    trajectories, cameras : arrays (n,) of int
    times : array (n,)
        True times by the clocks and readouts of the prior mean, s.
    points, precisions : arrays (n, 2), (n, 2, 2)
        Raw pixels and their inverse covariances.
    log_times : array (n,)
        Times of the frames on the cameras' own clocks, s.
    rows : array (n,)
        Row of each detection over the height of the image.
    weights : array (n,), optional
        What each detection counts, in measurements of its precision (`calibration.shared_errors`); default 1.
    """

    trajectories: Integers
    cameras: Integers
    times: Array
    points: Array
    precisions: Array
    log_times: Array
    rows: Array
    weights: Array | None = None

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True)
class Loss:
    """Robust loss: ``squared``, ``cauchy`` (scale in sigmas) or ``floor`` (height beside a peak of 1)."""

    kind: int
    scale: float


SQUARED = Loss(normal_equations.SQUARED, 1.0)


@dataclass(frozen=True)
class Problem:
    """What is adjusted.

    Attributes
    ----------
    parameters : ParameterSet
    reference : int
        Index of the reference camera.
    knots : Knots
    observations : Observations
    loss : Loss
    scale : ScaleMeasurement or None
    held : array (m,) of bool, optional
        Values that stay where the adjustment starts; default none.
    """

    parameters: ParameterSet
    reference: int
    knots: Knots
    observations: Observations
    loss: Loss
    scale: ScaleMeasurement | None = None
    held: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class NormalEquations:
    """Linearisation of a problem; see the head of this file."""

    cost: float
    bands: Array
    coupling: Array
    matrix: Array
    state_vector: Array
    value_vector: Array
    distances: Array


@dataclass(frozen=True)
class Adjustment:
    """Outcome of `adjust`.

    Attributes
    ----------
    values : array (m,)
    states : array (k, 2, 3)
        Knots.
    covariance : array (m, m)
        Of the values, trajectories integrated out.
    cost : float
        Twice the negative logarithm of the posterior density, without its constant.
    distances : array (n,)
        Squared Mahalanobis distances of the detections.
    iterations : int
    converged : bool
    """

    values: Array
    states: Array
    covariance: Array
    cost: float
    distances: Array
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Linearisation:
    """What of a problem does not change from step to step.

    Attributes
    ----------
    problem : Problem
    members : tuple of arrays of int
        Observations of each camera.
    path, rates : Interpolation
        Of positions and velocities at the times of the prior mean.
    motion : MotionPrior
    columns : array (c, q)
        Places of the unknown values of each camera, filled up with -1.
    """

    problem: Problem
    members: tuple[Integers, ...]
    path: Interpolation
    rates: Interpolation
    motion: MotionPrior
    columns: Integers

    @staticmethod
    def of(problem: Problem) -> Linearisation:
        """Prepare a problem."""
        observations, parameters = problem.observations, problem.parameters
        path = interpolation(problem.knots, observations.trajectories, observations.times)
        rates = slopes(problem.knots, observations.trajectories, observations.times)
        members = tuple(np.flatnonzero(observations.cameras == k) for k in range(len(parameters.cameras)))
        places = [
            np.concatenate([np.empty(0, dtype=np.int64), *(index for _, index in parameters.unknown(c.name))])
            for c in parameters.cameras
        ]
        columns = np.full((len(places), max(len(index) for index in places)), -1, dtype=np.int64)
        for row, index in zip(columns, places, strict=True):
            row[: len(index)] = index
        return Linearisation(problem, members, path, rates, motion_prior(problem.knots), columns)

    def at(self, values: Array, states: Array) -> NormalEquations:
        """Return the normal equations at values (m,) and knots (k, 2, 3)."""
        problem, parameters = self.problem, self.problem.parameters
        size, count = problem.knots.size, parameters.size
        bands, coupling, matrix = np.zeros((12, size)), np.zeros((size, count)), np.zeros((count, count))
        state_vector, value_vector = np.zeros(size), np.zeros(count)
        observations = problem.observations
        distances = np.zeros(len(observations))
        path, errors, visible, by_point, by_value = self.residuals(values, states)
        counted = np.ones(len(observations)) if observations.weights is None else observations.weights
        cost = normal_equations.accumulate(
            observations.cameras, errors, visible, observations.precisions, counted, by_point, by_value, path.knot,
            path.weights, self.columns, problem.loss.kind, problem.loss.scale,
            bands, coupling, matrix, state_vector, value_vector, distances,
        )  # fmt: skip
        # motion model, its noise in units of the scene's scale
        logarithm, gradient = log_scale(parameters, problem.reference, values)
        density = np.exp(-2.0 * logarithm)
        x, motion = states.ravel(), self.motion
        product = density * banded_product(motion.bands, x)
        pull = product - density * motion.pull
        energy = float(x @ product) + density * (motion.energy - 2.0 * float(x @ motion.pull))
        bands += density * motion.bands
        state_vector -= pull
        coupling -= np.outer(pull, gradient)
        matrix += energy * np.outer(gradient, gradient)
        value_vector += energy * gradient
        # priors
        scaled = (values - parameters.prior_mean) / parameters.prior_std
        matrix += np.diag(parameters.prior_std**-2)
        value_vector -= scaled / parameters.prior_std
        cost += energy + float(scaled @ scaled)
        if problem.scale is not None:
            expected, slope = predicted(parameters, problem.reference, problem.scale, values)
            residual = (problem.scale.value - expected) / problem.scale.std
            matrix += np.outer(slope, slope) / problem.scale.std**2
            value_vector += slope * residual / problem.scale.std
            cost += residual**2
        if problem.held is not None:
            held = problem.held
            coupling[:, held], value_vector[held] = 0.0, 0.0
            matrix[held], matrix[:, held] = 0.0, 0.0
            matrix[held, held] = parameters.prior_std[held] ** -2
        return NormalEquations(cost, bands, coupling, matrix, state_vector, value_vector, distances)

    def residuals(self, values: Array, states: Array) -> tuple[Interpolation, Array, NDArray[np.bool_], Array, Array]:
        """Interpolation at the times of the values, residuals, visibility, and derivatives by points and values."""
        observations, parameters = self.problem.observations, self.problem.parameters
        cameras = parameters.build(values)
        times, path, rates = observations.times, self.path, self.rates
        if any(quantity.affects == TIMES for quantity in parameters.quantities):
            times = true_times(cameras, observations)
            path = interpolation(self.problem.knots, observations.trajectories, times)
            rates = slopes(self.problem.knots, observations.trajectories, times)
        world, velocities = positions(states, *path), positions(states, *rates)
        count = len(observations)
        errors, visible = np.empty((count, 2)), np.empty(count, dtype=np.bool_)
        by_point, by_value = np.empty((count, 2, 3)), np.zeros((count, 2, self.columns.shape[1]))
        for camera, here in zip(cameras, self.members, strict=True):
            view = look(
                camera, world[here], velocities[here], times[here], observations.log_times[here],
                observations.rows[here],
            )  # fmt: skip
            errors[here], visible[here] = observations.points[here] - view.pixels, view.visible
            by_point[here] = view.by_world
            column = 0
            for quantity, index in parameters.unknown(camera.name):
                by_value[here, :, column : column + len(index)] = quantity.derivative(view, taken(values, index))
                column += len(index)
        return path, errors, visible, by_point, by_value


def true_times(cameras: Sequence[Camera], observations: Observations) -> Array:
    """True times (n,) of detections by the clocks and readouts of cameras, s."""
    times = np.empty(len(observations))
    for number, camera in enumerate(cameras):
        here = observations.cameras == number
        times[here] = camera.clock.to_true(observations.log_times[here]) + camera.readout_s * observations.rows[here]
    return times


def damped_bands(equations: NormalEquations, damping: float) -> Array:
    """Matrix of the knots in lower banded form (12, 6 k), its diagonal damped; unknowns without any weight are held."""
    bands = equations.bands.copy()
    bands[0] = np.where(bands[0] > 0.0, bands[0] * (1.0 + damping + ROUNDING), 1.0)
    return bands


def eliminate(equations: NormalEquations, damping: float) -> tuple[Array, Array]:
    """Eliminate the knots: A^-1 [C, a] (6 k, m + 1) and the Schur complement B - C^T A^-1 C (m, m).

    Raises
    ------
    numpy.linalg.LinAlgError
        The damped matrix of the knots is not positive definite.
    """
    factor = (cholesky_banded(damped_bands(equations, damping), lower=True, check_finite=False), True)
    both = np.column_stack([equations.coupling, equations.state_vector])
    eliminated = cho_solve_banded(factor, both, check_finite=False)
    return eliminated, equations.matrix - equations.coupling.T @ eliminated[:, :-1]


def solve(equations: NormalEquations, damping: float) -> tuple[Array, Array]:
    """Solve damped normal equations: steps of values (m,) and knots (6 k,).

    Raises
    ------
    numpy.linalg.LinAlgError
        The damped matrix is not positive definite.
    """
    eliminated, schur = eliminate(equations, damping)
    damped = schur + damping * np.diag(np.diag(equations.matrix))
    right = equations.value_vector - equations.coupling.T @ eliminated[:, -1]
    values = cho_solve(cho_factor(damped), right)
    return values, eliminated[:, -1] - eliminated[:, :-1] @ values


def adjust(
    problem: Problem, values: Array, states: Array, max_iterations: int = 200, tolerance: float = 1e-7
) -> Adjustment:
    """Minimise from values (m,) and knots (k, 2, 3).

    Parameters
    ----------
    problem : Problem
    values, states : arrays
        Where to start.
    max_iterations : int
        Steps tried.
    tolerance : float
        Converged when a step lowers the cost by less than this part of it.

    Returns
    -------
    Adjustment
        Its covariance is that of the undamped equations; held values keep that of the prior.
    """
    linearisation = Linearisation.of(problem)
    current = linearisation.at(values, states)
    damping, converged, iteration = FIRST_DAMPING, False, 0
    while iteration < max_iterations and not converged and damping < MOST_DAMPING:
        iteration += 1
        try:
            value_step, state_step = solve(current, damping)
        except LinAlgError:
            damping *= DAMPING_FACTOR
            continue
        new_values, new_states = values + value_step, states + state_step.reshape(states.shape)
        new = linearisation.at(new_values, new_states)
        if np.isfinite(new.cost) and new.cost <= current.cost:
            converged = current.cost - new.cost <= tolerance * max(current.cost, 1.0)
            values, states, current = new_values, new_states, new
            damping = max(damping / DAMPING_FACTOR, 1e-12)
        else:
            converged = damping > 1e4 and abs(new.cost - current.cost) <= tolerance * max(current.cost, 1.0)
            damping *= DAMPING_FACTOR
    covariance = posterior_covariance(current, problem.parameters.prior_std)
    return Adjustment(values, states, covariance, current.cost, current.distances, iteration, bool(converged))


def posterior_covariance(equations: NormalEquations, prior_std: Array) -> Array:
    """Covariance (m, m) of the values, the trajectories integrated out: the inverse Schur complement.

    The posterior is never wider than the prior: in units of `prior_std` (m,) the eigenvalues of the Schur complement
    are at least 1. Where rounding makes one smaller (objects far away), it is set to 1.
    """
    _, schur = eliminate(equations, 0.0)
    whitened = schur * np.outer(prior_std, prior_std)
    eigenvalues, vectors = np.linalg.eigh((whitened + whitened.T) / 2.0)
    covariance = (vectors / np.maximum(eigenvalues, 1.0)) @ vectors.T * np.outer(prior_std, prior_std)
    return np.asarray((covariance + covariance.T) / 2.0)
