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

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky_banded

from stereophd.core.calibration.adjustment import Adjustment, damped_bands, eliminate, posterior_covariance, solve
from stereophd.core.calibration.linearisation import Linearisation, NormalEquations
from stereophd.core.calibration.problem import Problem
from stereophd.core.calibration.scale import log_scale

Array = NDArray[np.float64]

# Rounds of gradient and minimisation, Newton steps of each, and the step of the gradient in posterior deviations.
ROUNDS, STEPS, STEP = 2, 3, 0.02
# Damping of the Newton steps, and the longest move in prior standard deviations that is believed.
DAMPING, LONGEST_MOVE = 1e-8, 5.0


def marginal_optimum(problem: Problem, found: Adjustment) -> Adjustment:
    """Move an adjustment to the maximum of the marginal posterior of the values.

    Parameters
    ----------
    problem : Problem
    found : Adjustment
        Of that problem.

    Returns
    -------
    Adjustment
        The one given where the move fails, is longer than `LONGEST_MOVE` prior standard deviations, or does not
        increase the marginal posterior: the Newton steps are neither damped nor searched along.
    """
    linearisation = Linearisation.of(problem)
    values, states, covariance = found.values, found.states, found.covariance
    prior = problem.parameters.prior_std
    try:
        for _ in range(ROUNDS):
            tilt = volume_gradient(linearisation, values, states, np.sqrt(np.diag(covariance)))
            for _ in range(STEPS):
                equations = linearisation.at(values, states)
                tilted = replace(equations, value_vector=equations.value_vector - tilt)
                value_step, state_step = solve(tilted, DAMPING)
                values, states = values + value_step, states + state_step.reshape(states.shape)
            equations = linearisation.at(values, states)
            covariance = posterior_covariance(equations, prior)
    except LinAlgError:
        return found
    moved = np.abs(values - found.values) / prior
    if not (np.isfinite(equations.cost) and (moved < LONGEST_MOVE).all()):
        return found
    try:
        before, after = (
            one.cost + 2.0 * volume(linearisation, at, one)
            for at, one in ((found.values, linearisation.at(found.values, found.states)), (values, equations))
        )
    except LinAlgError:
        return found
    if not after <= before:
        return found
    return replace(
        found, values=values, states=states, covariance=covariance, cost=equations.cost, distances=equations.distances
    )


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
