"""The marginal posterior of the cameras: the trajectories integrated out instead of optimised.

The adjustment finds the joint maximum J(v) = min_x cost(v, x) of values v and knots x. Where trajectories have many
unknowns that the detections constrain weakly (objects that manoeuvre), the joint maximum is biased in the quantities
that stretch the scene, above all in focal lengths. Integrating out the knots (Laplace's method) adds a term,

    -2 log p(v | detections) = J(v) + log det A(v) + 12 k log s(v) + constant,

with the matrix A of the knots in the normal equations, the number k of knots and the scale s of the scene; the last
term is the volume of the knots in units of the scale. With it, the part of the data stays flat along the scale. The
gradient of the added terms changes slowly: it is computed at the optimum, and the cost tilted by it is minimised.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky_banded

from stereophd.core.calibration.adjustment import Adjustment, damped_bands, eliminate, posterior_covariance, solve
from stereophd.core.calibration.linearisation import Linearisation, NormalEquations
from stereophd.core.calibration.problem import Problem
from stereophd.core.calibration.scale import log_scale

Array = NDArray[np.float64]

# Fewest rounds of gradient and minimisation, and most while a round moves a value by more than `SETTLED` posterior
# deviations; Newton steps of each; and the step of the gradient in posterior deviations.
ROUNDS, MOST_ROUNDS, SETTLED, STEPS, STEP = 2, 12, 0.2, 3, 0.02
# Damping of the Newton steps, and the longest move in prior standard deviations that is believed.
DAMPING, LONGEST_MOVE = 1e-8, 5.0
# A step is halved until it raises the objective by at most this, but not below the least share of it.
TOLERANCE, LEAST_SHARE = 0.5, 1.0 / 64.0


def marginal_optimum(problem: Problem, found: Adjustment) -> Adjustment:
    """Move an adjustment to the maximum of the marginal posterior of the values.

    Parameters
    ----------
    problem : Problem
    found : Adjustment
        Solution of that problem.

    Returns
    -------
    Adjustment
        The one given where the move fails, is longer than `LONGEST_MOVE` prior standard deviations, or does not
        increase the marginal posterior.
    """
    linearisation = Linearisation.of(problem)
    prior = problem.parameters.prior_std
    try:
        first = at = _Point.at(linearisation, found.values, found.states)
        covariance = found.covariance
        for number in range(MOST_ROUNDS):
            tilt = volume_gradient(linearisation, at.values, at.states, np.sqrt(np.diag(covariance)))
            before = at.values
            for _ in range(STEPS):
                moved = _step(linearisation, at, tilt)
                if moved is None:
                    break
                at = moved
            covariance = posterior_covariance(at.equations, prior)
            if number + 1 >= ROUNDS and (np.abs(at.values - before) <= SETTLED * np.sqrt(np.diag(covariance))).all():
                break
    except LinAlgError:
        return found
    if not ((np.abs(at.values - found.values) / prior < LONGEST_MOVE).all() and at.objective <= first.objective):
        return found
    return replace(
        found, values=at.values, states=at.states, covariance=covariance, cost=at.equations.cost,
        distances=at.equations.distances,
    )  # fmt: skip


@dataclass(frozen=True)
class _Point:
    """Values and knots, their normal equations, and twice the negative logarithm of the marginal posterior there."""

    values: Array
    states: Array
    equations: NormalEquations
    objective: float

    @staticmethod
    def at(linearisation: Linearisation, values: Array, states: Array) -> _Point:
        """Return a point; `LinAlgError` where the normal equations are not positive definite."""
        equations = linearisation.at(values, states)
        if not np.isfinite(equations.cost):
            raise LinAlgError("the cost is not finite")
        return _Point(values, states, equations, equations.cost + 2.0 * volume(linearisation, values, equations))


def _step(linearisation: Linearisation, at: _Point, tilt: Array) -> _Point | None:
    """Return the point after a Newton step, shortened where it is too long; None if no share of it is good."""
    tilted = replace(at.equations, value_vector=at.equations.value_vector - tilt)
    value_step, state_step = solve(tilted, DAMPING)
    share = 1.0
    while share >= LEAST_SHARE:
        try:
            values, states = at.values + share * value_step, at.states + share * state_step.reshape(at.states.shape)
            moved = _Point.at(linearisation, values, states)
        except LinAlgError:
            share *= 0.5
            continue
        if moved.objective <= at.objective + TOLERANCE:
            return moved
        share *= 0.5
    return None


def volume_gradient(linearisation: Linearisation, values: Array, states: Array, spread: Array) -> Array:
    """Gradient (m,) of half of the added terms, the knots following the values to first order.

    Parameters
    ----------
    linearisation : Linearisation
    values, states : arrays (m,), (k, 2, 3)
    spread : array (m,)
        Standard deviations of the values: the numerical derivative takes steps of `STEP` of them.
    """
    eliminated, _ = eliminate(linearisation.at(values, states), 0.0)

    def moved(k: int, step: float) -> float:
        there = values.copy()
        there[k] += step
        equations = linearisation.at(there, states - (step * eliminated[:, k]).reshape(states.shape))
        return volume(linearisation, there, equations)

    return np.array(
        [(moved(k, STEP * s) - moved(k, -STEP * s)) / (2.0 * STEP * s) for k, s in enumerate(spread.tolist())]
    )


def volume(linearisation: Linearisation, values: Array, equations: NormalEquations) -> float:
    """Half of the terms that integrating out the knots adds, with the normal equations at values (m,)."""
    problem = linearisation.problem
    scale = log_scale(problem.parameters, problem.reference, values)[0]
    return 0.5 * log_determinant(equations) + 6.0 * len(problem.knots.times) * scale


def log_determinant(equations: NormalEquations) -> float:
    """Logarithm of the determinant of the knots' matrix."""
    return float(2.0 * np.log(cholesky_banded(damped_bands(equations, 0.0), lower=True)[0]).sum())
