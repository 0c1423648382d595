"""Bundle adjustment: maximum a posteriori over camera parameters and all trajectories at once.

Minimised is half of

    sum_n w_n rho(e_n^T P_n e_n) + |(values - mean) / std|^2 + m(x) / s^2 + ((scale measured - h) / std)^2,

with the reprojection error e_n of every detection, its precision P_n and weight w_n, the priors of the camera
parameters, the motion model m(x) of the trajectories' knots x (positions and velocities have no prior), and the scale s
of the scene (`calibration.unknowns.scale`). The steps are those of Gauss and Newton on the normal equations

    [ A   C ] [dx]   [a]
    [ C^T B ] [dv] = [b],     A banded (knots), B small (cameras),

solved by the Schur complement B - C^T A^-1 C (W. Triggs et al., "Bundle adjustment - a modern synthesis", 2000),
whose inverse at the optimum is the covariance of the camera parameters, the trajectories integrated out.

Valleys are curved: where cameras move, points do not follow on straight lines. A step after which the cost has grown is
therefore judged once the knots have settled, and no step is longer than the valley allowed last. Damped steps
(Levenberg, Marquardt) crept along such valleys: of 200 every other one was rejected, and starts of one optimum ended
apart. Damping helps where matrices are nearly singular.
"""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.linearisation import (
    Linearisation,
    NormalEquations,
    Placement,
    Seen,
    factor_knots,
)
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.trajectories import STATED
from stereophd.core.calibration.time_limit import within

# Most steps of the knots at given values, and the fall of the cost that is left; most of them that follow a step. Steps
# that promise less than a standard deviation know the second derivatives of the pixels, which mislead from afar.
KNOT_STEPS, KNOTS_SETTLED, FOLLOWING_STEPS, KNOTS_NEAR = 15, 1e-8, 3, 1.0
# A step is halved, down to the least share of it, until the cost falls. The next one may be as long as what was taken,
# and longer by this factor where that was the whole.
LEAST_SHARE, LONGER = 1.0 / 64.0, 2.0
# Marquardt's damping of the first steps, and of equations that are singular: where it starts, its factor, and where it
# gives up.
FIRST_DAMPING, DAMPING_FACTOR, MOST_DAMPING = 1e-4, 8.0, 1e10
# Part of a diagonal of 1 that rounding makes, and least eigenvalue beside which that is nothing.
ROUNDED, REGULAR = 1e-12, 1e-10
# Part of the cost that is not worth a step; most steps that do not lower the cost: damping can grow from the first to
# the most, and a step be halved.
CONVERGED, STALLED_STEPS = 1e-7, 20


@dataclass(frozen=True)
class Adjustment:
    """Outcome of `adjust`, and of `marginal.marginal_optimum`."""

    values: Array  # (m,)
    states: Array  # (k, 2, 3): Knots
    covariance: Array  # (m, m): Covariance of the values, trajectories integrated out
    cost: float  # Twice the negative logarithm of the posterior density, without its constant
    distances: Array  # (n,): Squared Mahalanobis distances of the detections
    converged: bool
    # (6,): Unknowns of the noise of the motion (`trajectories.MotionNoise`), in units of the scene's scale
    motion_noise: Array = field(default_factory=lambda: STATED)


@dataclass(frozen=True)
class Eliminated:
    """Normal equations of the values alone, and how the knots follow: with A = L L^T, all by L^-1 [C, a]."""

    factor: Array  # (12, 6 k): L, lower banded
    whitened: Array  # (6 k, m + 1): L^-1 [C, a]
    schur: Array  # (m, m): B - C^T A^-1 C
    right: Array  # (m,): b - C^T A^-1 a

    @classmethod
    def of(cls, equations: NormalEquations, factor: Array) -> Self:
        """Eliminate the knots by the factor of their matrix."""
        coupling, vector = equations.coupling, equations.state_vector[:, None]
        moves: Booleans = np.asarray(coupling.any(axis=0))  # held values do not couple
        used = np.ascontiguousarray(np.hstack([coupling if moves.all() else coupling[:, moves], vector]))
        normal_equations.substitute_forward(factor.T, used)
        whitened = used
        if not moves.all():
            whitened = np.zeros((len(coupling), len(moves) + 1))
            whitened[:, np.append(moves, True)] = used
        products = whitened.T @ whitened
        return cls(factor, whitened, equations.matrix - products[:-1, :-1], equations.value_vector - products[:-1, -1])

    def knots_after(self, values: Array) -> Array:
        """Step (6 k,) of the knots beside a step (m,) of the values."""
        return self._solved(self.whitened[:, -1] - self.whitened[:, :-1] @ values)

    def followed(self, values: Array) -> Array:
        """Step (6 k,) that takes knots from their minimum to that after a step (m,) of the values, to first order."""
        return self._solved(-(self.whitened[:, :-1] @ values))

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


def solve(equations: NormalEquations, damping: float) -> tuple[Array, Array, float]:
    """Steps of values (m,) and knots (6 k,) by damped normal equations; LinAlgError if not positive definite.

    The last is the length of the step of the values, in posterior standard deviations.
    """
    eliminated = Eliminated.of(equations, factor_knots(equations.bands, damping))
    damped = eliminated.schur + damping * np.diag(np.diag(equations.matrix))
    values = cho_solve(cho_factor(damped), eliminated.right)
    return values, eliminated.knots_after(values), float(np.sqrt(max(values @ eliminated.right, 0.0)))


def settled_knots(
    linearisation: Linearisation,
    values: Array,
    states: Array,
    noise: Array = STATED,
    most: int = KNOT_STEPS,
    settled: float = KNOTS_SETTLED,
    placement: Placement | None = None,
) -> tuple[Array, float, Seen, Array | None]:
    """Minimise the cost by the knots (k, 2, 3) alone, until it would fall by no more than `settled`; no loss counts.

    Also returns by how much the last step looked at would lower it, `settled` at most where the minimum was found; what
    is seen there, without derivatives by values; and the Cholesky factor (12, 6 k) of the matrix of the knots there,
    None after the most steps.
    Raises LinAlgError when the matrix of the knots is not positive definite, or the cost is not finite.
    """
    placement = placement or linearisation.placed(values, by_values=False)
    cost, bands, vector, seen = linearisation.of_knots(values, states, noise, placement)
    promised, factor = np.inf, None
    for _ in range(most):
        if not np.isfinite(cost):
            raise LinAlgError("the cost is not finite")
        factor = factor_knots(bands)
        step = cho_solve_banded((factor, True), vector, check_finite=False)
        if (promised := float(vector @ step)) <= settled:
            break
        if promised <= KNOTS_NEAR:
            step = cho_solve_banded((linearisation.factor_of_knots(seen, bands), True), vector)
        share = 1.0
        while share >= LEAST_SHARE:
            moved = states + share * step.reshape(states.shape)
            tried = linearisation.of_knots(values, moved, noise, placement)
            if tried[0] <= cost:
                break
            share *= 0.5
        else:
            break
        states, (cost, bands, vector, seen) = moved, tried
    else:
        factor = None
    return states, promised, seen, factor


def adjust(
    problem: Problem, values: Array, states: Array, max_iterations: int = 200, settled: float = 0.0,
    within_prior_only: bool = False,
) -> Adjustment:  # fmt: skip
    """Minimise from values (m,) and knots (k, 2, 3), trying about `max_iterations` steps at most.

    Converged when a step without damping promises to lower the cost by less than the part `CONVERGED` of it, and after
    one that moves the values by less than `settled` posterior standard deviations, whatever a stretch does that no
    other camera holds. Ends, too, where so many steps (`STALLED_STEPS`) do not lower it: at the edge of a lens the
    slope promises what is not there; and, `within_prior_only`, where a step leaves the prior. The covariance is that of
    the undamped equations; held values keep that of the prior.
    """
    linearisation = Linearisation.of(problem)
    current = linearisation.at(values, states)
    damping, longest, converged, iteration = FIRST_DAMPING, np.inf, False, 0
    lowest, lowered = current.cost, 0
    while iteration < max_iterations and damping < MOST_DAMPING and iteration - lowered < STALLED_STEPS:
        within(f"cameras and trajectories are adjusted, step {iteration + 1}")
        try:
            value_step, state_step, moved_by = solve(current, damping)
        except LinAlgError:
            damping, iteration = max(DAMPING_FACTOR * damping, FIRST_DAMPING), iteration + 1
            continue
        promised = float(value_step @ current.value_vector + state_step @ current.state_vector)
        if promised <= CONVERGED * max(current.cost, 1.0):
            if converged := damping == 0.0:
                break
            damping = 0.0
            continue
        length = float(np.linalg.norm(value_step / problem.parameters.prior_std))
        whole = share = longest / length if length > longest else 1.0
        is_last = damping <= FIRST_DAMPING and moved_by < settled
        while True:
            moved = states + share * state_step.reshape(states.shape)
            tried = _followed(linearisation, current, values + share * value_step, moved)
            iteration += 1
            if (is_lower := bool(tried[2].cost <= current.cost)) or share <= LEAST_SHARE * whole or is_last:
                break
            share *= 0.5
        if is_lower:
            longest = (LONGER if share == whole else 1.0) * share * length
            (values, states, current), damping = tried, damping / DAMPING_FACTOR
            if within_prior_only and problem.parameters.prior_disagreement(values) is not None:
                break
        else:
            damping = max(DAMPING_FACTOR * damping, FIRST_DAMPING)
        if converged := is_last:
            break
        if current.cost < lowest - CONVERGED * max(lowest, 1.0):
            lowest, lowered = current.cost, iteration
    covariance = gauss_newton_covariance(current, problem.parameters.prior_std)
    return Adjustment(values, states, covariance, current.cost, current.distances, converged)


def _followed(
    linearisation: Linearisation, before: NormalEquations, values: Array, states: Array
) -> tuple[Array, Array, NormalEquations]:
    """Return values and knots after a step, and the equations there; where the cost has grown, the knots settle first.

    Detections keep the weights from before the step: the loss would leave out at once what is far from knots that do
    not follow yet.
    """
    after = linearisation.at(values, states)
    if after.cost <= before.cost:
        return values, states, after
    problem = linearisation.problem.weighted(linearisation.problem.weights(before.distances))
    weighted, settled = replace(linearisation, problem=problem), CONVERGED * max(before.cost, 1.0)
    try:
        states, *_ = settled_knots(weighted, values, states, STATED, FOLLOWING_STEPS, settled)
    except LinAlgError:
        return values, states, after
    return values, states, linearisation.at(values, states)


def gauss_newton_covariance(equations: NormalEquations, prior_std: Array) -> Array:
    """Covariance (m, m) of the values, the trajectories integrated out: the inverse Schur complement."""
    return within_prior(Eliminated.of(equations, factor_knots(equations.bands)).schur, prior_std)


def within_prior(precision: Array, prior_std: Array) -> Array:
    """Invert a precision (m, m); the covariance is never wider than the prior.

    A clock may be known to 1e-17 of its prior, so that rounding in units of `prior_std` (m,) would hide all else. Where
    the precision, scaled to a diagonal of 1, is regular, and no less than that of the prior, that is the scale.
    Elsewhere, in units of the prior, its eigenvalues are at least 1 (second derivatives, objects far away).
    """
    for scale in (1.0 / np.sqrt(np.maximum(np.diag(precision), prior_std**-2)), prior_std):
        scaled = precision * np.outer(scale, scale)
        scaled, of_prior = (scaled + scaled.T) / 2.0, (scale / prior_std) ** 2
        is_regular = np.linalg.eigvalsh(scaled)[0] >= REGULAR
        if is_regular and np.linalg.eigvalsh(scaled - np.diag(of_prior))[0] >= -ROUNDED:
            break
    eigenvalues, vectors = np.linalg.eigh(scaled)
    covariance = (vectors / np.maximum(eigenvalues, of_prior @ vectors**2)) @ vectors.T * np.outer(scale, scale)
    return np.asarray((covariance + covariance.T) / 2.0)
