"""Bundle adjustment: maximum a posteriori over camera parameters and all trajectories at once.

Minimised is half of

    sum_n w_n rho(e_n^T P_n e_n) + |(values - mean) / std|^2 + m(x) / s^2 + ((scale measured - h) / std)^2,

with the reprojection error e_n of every detection, its precision P_n and weight w_n, the priors of the camera
parameters, the motion model m(x) of the trajectories' knots x (positions and velocities have no prior), and the scale s
of the scene (`calibration.unknowns.scale`). The steps are those of Levenberg and Marquardt on the normal equations

    [ A   C ] [dx]   [a]
    [ C^T B ] [dv] = [b],     A banded (knots), B small (cameras),

solved by the Schur complement B - C^T A^-1 C (W. Triggs et al., "Bundle adjustment - a modern synthesis", 2000),
whose inverse at the optimum is the covariance of the camera parameters, the trajectories integrated out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky_banded

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations
from stereophd.core.calibration.adjustment.problem import Problem

# Marquardt's damping: where it starts, its factor, and where it gives up.
FIRST_DAMPING, DAMPING_FACTOR, MOST_DAMPING = 1e-4, 8.0, 1e10
# Relative weight on the diagonal that keeps the factorisation of nearly singular knots from failing.
ROUNDING = 1e-13
# Knots of less information are held: far from all their detections, the weights of a robust loss underflow.
LEAST_INFORMATION = 1e-200


@dataclass(frozen=True)
class Adjustment:
    """Outcome of `adjust`."""

    values: Array  # (m,)
    states: Array  # (k, 2, 3): Knots
    covariance: Array  # (m, m): Covariance of the values, trajectories integrated out
    cost: float  # Twice the negative logarithm of the posterior density, without its constant
    distances: Array  # (n,): Squared Mahalanobis distances of the detections
    iterations: int
    converged: bool


def factor_knots(bands: Array, damping: float = 0.0) -> Array:
    """Cholesky factor of the matrix of the knots, both lower banded (12, 6 k), its diagonal damped.

    Unknowns without any weight are held. Raises LinAlgError when the damped matrix is not positive definite.
    """
    bands = bands.copy()
    bands[0] = np.where(bands[0] > LEAST_INFORMATION, bands[0] * (1.0 + damping + ROUNDING), 1.0)
    return np.asarray(cholesky_banded(bands, overwrite_ab=True, lower=True, check_finite=False))


@dataclass(frozen=True)
class Eliminated:
    """Normal equations of the values alone, and how the knots follow: with A = L L^T, all by L^-1 [C, a]."""

    factor: Array  # (12, 6 k): L, lower banded
    whitened: Array  # (6 k, m + 1): L^-1 [C, a]
    schur: Array  # (m, m): B - C^T A^-1 C
    right: Array  # (m,): b - C^T A^-1 a

    @staticmethod
    def of(equations: NormalEquations, factor: Array) -> Eliminated:
        """Eliminate the knots by the factor of their matrix."""
        coupling, vector = equations.coupling, equations.state_vector[:, None]
        moves: Booleans = np.asarray(coupling.any(axis=0))  # held values do not couple
        used = np.hstack([coupling if moves.all() else coupling[:, moves], vector])
        normal_equations.substitute_forward(factor.T, used)
        whitened = used
        if not moves.all():
            whitened = np.zeros((len(coupling), len(moves) + 1))
            whitened[:, np.append(moves, True)] = used
        products = whitened.T @ whitened
        return Eliminated(
            factor, whitened, equations.matrix - products[:-1, :-1], equations.value_vector - products[:-1, -1]
        )

    def knots_after(self, values: Array) -> Array:
        """Step (6 k,) of the knots beside a step (m,) of the values."""
        return self._solved(self.whitened[:, -1] - self.whitened[:, :-1] @ values)

    def followed(self, values: Array) -> Array:
        """Step (6 k,) that takes knots from their minimum to that after a step (m,) of the values, to first order."""
        return self._solved(-self.whitened[:, :-1] @ values)

    def following(self) -> Array:
        """Derivatives (6 k, m) of the knots, at their minimum, by the values: -A^-1 C."""
        return self._solved(-self.whitened[:, :-1])

    def of_knots(self, right: Array) -> Array:
        """Return A^-1 times right sides (6 k, r), without the values."""
        right = np.array(right, order="C")
        normal_equations.substitute_forward(self.factor.T, right)
        return self._solved(right)

    def _solved(self, right: Array) -> Array:
        """Return L^-T times right sides, which it overwrites."""
        normal_equations.substitute_back(self.factor.T, right.reshape(len(right), -1))
        return right


def solve(equations: NormalEquations, damping: float) -> tuple[Array, Array]:
    """Steps of values (m,) and knots (6 k,) by damped normal equations; LinAlgError if not positive definite."""
    eliminated = Eliminated.of(equations, factor_knots(equations.bands, damping))
    damped = eliminated.schur + damping * np.diag(np.diag(equations.matrix))
    values = cho_solve(cho_factor(damped), eliminated.right)
    return values, eliminated.knots_after(values)


def adjust(
    problem: Problem, values: Array, states: Array, max_iterations: int = 200, tolerance: float = 1e-7
) -> Adjustment:
    """Minimise from values (m,) and knots (k, 2, 3), trying at most `max_iterations` steps.

    Converged when a step lowers the cost by less than the part `tolerance` of it. The covariance is that of the
    undamped equations; held values keep that of the prior.
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
    """Covariance (m, m) of the values, the trajectories integrated out: the inverse Schur complement."""
    return within_prior(Eliminated.of(equations, factor_knots(equations.bands)).schur, prior_std)


def within_prior(precision: Array, prior_std: Array) -> Array:
    """Invert a precision (m, m); the covariance is never wider than the prior.

    In units of `prior_std` (m,) the eigenvalues of the precision are at least 1. Where rounding makes one smaller
    (objects far away), it is set to 1.
    """
    whitened = precision * np.outer(prior_std, prior_std)
    eigenvalues, vectors = np.linalg.eigh((whitened + whitened.T) / 2.0)
    covariance = (vectors / np.maximum(eigenvalues, 1.0)) @ vectors.T * np.outer(prior_std, prior_std)
    return np.asarray((covariance + covariance.T) / 2.0)
