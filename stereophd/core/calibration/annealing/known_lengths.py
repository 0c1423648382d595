"""Known lengths as measurements at all times: corners of a board, or the ends of a wand, keep their distance.

The scale needs one number of them (`calibration.annealing.known_scale`). But two objects whose distance is known
at all times also measure depth at all times, and with it focal lengths and lenses. The distances couple trajectories,
which the normal equations of an adjustment keep apart. They are therefore added as an iterated Kalman update of cameras
and trajectories together: with N the matrix of the normal equations, G the derivative of the distances d by the knots
and R the covariance of the known lengths,

    step = step_0 + N^-1 G^T (R + G N^-1 G^T)^-1 (length - d - G step_0).

A pair that keeps about the known length by chance would pull everything. Which pairs are taken is therefore decided by
their odds (`calibration.annealing.known_scale`) and by the distances over the whole common time: y = length - d -
G step_0 has the covariance S = R + G N^-1 G^T of a rigid pair of that length, or S + B B^T, where a distance of chance
deviates by a constant and a steady change (the columns of B) of up to the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations, factor_knots
from stereophd.core.calibration.adjustment.solver import Eliminated
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.fits import problem_of
from stereophd.core.calibration.annealing.known_scale import (
    PEAK_WIDTH,
    PRIOR_REACH,
    RIGID,
    candidate_pairs,
    object_pairs,
)
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.unknowns.scale import log_scale

# Relative deviation of a distance that may be the known length.
WITHIN = 2.0 * RIGID
# Largest relative deviation of a pair's mean distance from the known length with which the pair is considered.
LARGEST_MEAN_DEVIATION = 2.0 * PEAK_WIDTH
# Median of chi-squared of two degrees of freedom.
MEDIAN_OF_TWO = 2.0 * float(np.log(2.0))
# Rounds in which pairs are chosen, steps of each, and damping of the normal equations.
ROUNDS, STEPS, DAMPING = 3, 5, 1e-9
# Most distances that are used, and most numbers in their derivatives. The odds of a pair need three times at least: a
# constant and a steady change take two.
MOST_DISTANCES, MOST_NUMBERS, LEAST_TIMES_FOR_ODDS = 400, 20_000_000, 3
# The known lengths are taken as long as they cost less than this a distance, in squared standard deviations.
MOST_COST = 2.0


def with_lengths(task: Task, fit: Fit, length: float, std: float) -> tuple[Fit, int]:
    """Adjust cameras and trajectories to pairs of objects that keep a known distance, and count the pairs.

    Each distance may deviate by `std`, and all of them together by as much. The scale of the fit is known already.
    Returns the fit given, and 0, if no pair keeps that distance or the detections contradict it.
    """
    # the scale is what the lengths measure
    linearisation = Linearisation.of(replace(problem_of(task, fit), scale=None))
    before = linearisation.at(fit.adjustment.values, fit.adjustment.states).cost
    _, gradient = log_scale(task.parameters, task.reference, fit.adjustment.values)
    reach = PRIOR_REACH * float(np.sqrt((gradient**2 * task.parameters.prior_std**2).sum()))
    best, count = fit, 0
    for _ in range(ROUNDS):
        pairs, odds = _candidates(best, length, reach)
        if len(pairs) > count:
            pairs = pairs[_odds_of_lengths(linearisation, best, pairs, length, std) + odds > 0.0]
        if len(pairs) <= count:
            break  # with the lengths of some pairs others keep theirs, too
        found = _updated(linearisation, best, pairs, length, std, before)
        if found is None:
            break
        best, count = found, len(pairs)
    return best, count


def _candidates(fit: Fit, length: float, reach: float) -> tuple[Integers, Array]:
    """Pairs (p, 2) that may have the known length, and the logarithms of their odds by their mean distances alone.

    A distance of chance is anywhere within the reach of the prior, and seldom within `LARGEST_MEAN_DEVIATION`.
    """
    every = object_pairs(fit)
    peaks, places = candidate_pairs(every, every.rigid(WITHIN), length, 0.0, max(reach, LARGEST_MEAN_DEVIATION))
    near = np.abs(peaks.ratios) <= LARGEST_MEAN_DEVIATION
    rarity = np.log(peaks.range / (2.0 * LARGEST_MEAN_DEVIATION))
    expected = max(float(peaks.probabilities(0.0).sum()), 1.0)
    return every.members[places[near]], np.log(expected * peaks.odds[near]) + rarity


def _odds_of_lengths(linearisation: Linearisation, fit: Fit, pairs: Integers, length: float, std: float) -> Array:
    """Logarithms of the odds (p,) that pairs (p, 2) have the length at all common times, rather than by chance.

    Errors that no covariance contains, such as those of lenses, are taken as large as the better half of the pairs
    shows them. Zeros where the equations have no solution: the distances then say nothing.
    """
    try:
        information, along = _deviations(linearisation, fit, pairs, length, std)
        squared = np.einsum("pi,pi->p", along, np.linalg.solve(information, along[:, :, None])[:, :, 0])
    except LinAlgError:
        return np.zeros(len(pairs))
    typical = float(np.sort(squared)[(len(squared) - 1) // 2])
    factor = max(typical / MEDIAN_OF_TWO, 1.0)
    whole = np.eye(2) + information / factor
    pulled = np.einsum("pi,pi->p", along, np.linalg.solve(whole, along[:, :, None])[:, :, 0]) / factor**2
    return np.asarray(0.5 * np.linalg.slogdet(whole)[1] - 0.5 * pulled)


def _deviations(
    linearisation: Linearisation, fit: Fit, pairs: Integers, length: float, std: float
) -> tuple[Array, Array]:
    """Constant and steady deviation of each pair: information (p, 2, 2), and information times estimate (p, 2).

    In units of the tolerance. The pairs are solved one by one, which bounds the memory.
    """
    states = fit.adjustment.states
    pair, times = _sampled(fit, pairs, states.size, LEAST_TIMES_FOR_ODDS)
    factors = _Factors.of(linearisation.at(fit.adjustment.values, states))
    count = len(times) // len(pairs)
    steady = np.linspace(-np.sqrt(3.0), np.sqrt(3.0), count)
    basis = LARGEST_MEAN_DEVIATION * length * np.column_stack([np.ones(count), steady])
    information, along = np.empty((len(pairs), 2, 2)), np.empty((len(pairs), 2))
    for number in range(len(pairs)):
        rows = slice(number * count, (number + 1) * count)
        found, slopes = _distances(fit, states, pairs[pair[rows]], times[rows])
        missing = length - found - slopes @ factors.state_step
        spread = std**2 * (np.eye(count) + 1.0) + slopes @ factors.gains(slopes)[1]
        solved = basis.T @ np.linalg.solve(spread, np.column_stack([basis, missing]))
        information[number], along[number] = solved[:, :2], solved[:, 2]
    return information, along


def _updated(
    linearisation: Linearisation, fit: Fit, pairs: Integers, length: float, std: float, before: float
) -> Fit | None:
    """Adjust to the lengths of pairs (p, 2); None where they contradict the detections, whose cost was `before`."""
    values, states, covariance = fit.adjustment.values, fit.adjustment.states, fit.adjustment.covariance
    pair, times = _sampled(fit, pairs, states.size)
    try:
        for _ in range(STEPS):
            found, slopes = _distances(fit, states, pairs[pair], times)
            value_step, state_step, covariance = _step(linearisation.at(values, states), slopes, length - found, std)
            values, states = values + value_step, states + state_step.reshape(states.shape)
    except LinAlgError:
        return None
    equations = linearisation.at(values, states)
    left = length - _distances(fit, states, pairs[pair], times)[0]
    if not equations.cost - before + float(((left - left.mean()) ** 2).sum()) / std**2 <= MOST_COST * len(left):
        return None
    adjustment = replace(
        fit.adjustment, values=values, states=states, covariance=covariance, cost=equations.cost,
        distances=equations.distances,
    )  # fmt: skip
    return replace(fit, adjustment=adjustment)


def _sampled(fit: Fit, pairs: Integers, size: int, least: int = 1) -> tuple[Integers, Array]:
    """Pair (k,) and time (k,) of every distance: evenly over the time in which both objects are seen.

    Every pair has the same number of times, and `least` at least.
    """
    count = max(min(MOST_DISTANCES, MOST_NUMBERS // max(size, 1)) // len(pairs), least)
    spans = fit.knots.spans[pairs]
    since, until = spans[:, :, 0].max(axis=1), spans[:, :, 1].min(axis=1)
    part = (np.arange(count) + 0.5) / count
    return np.repeat(np.arange(len(pairs)), count), (since[:, None] + part * (until - since)[:, None]).ravel()


def _distances(fit: Fit, states: Array, pairs: Integers, times: Array) -> tuple[Array, Array]:
    """Distances (k,) of pairs (k, 2) at times, and their derivatives (k, size) by the knots."""
    ends = [interpolation(fit.knots, pairs[:, side], times) for side in (0, 1)]
    between = positions(states, *ends[0]) - positions(states, *ends[1])
    distances = np.linalg.norm(between, axis=1)
    directions = between / np.maximum(distances, 1e-300)[:, None]
    slopes = np.zeros((len(times), states.size))
    for sign, end in zip((1.0, -1.0), ends, strict=True):
        for weight in range(4):
            for axis in range(3):
                column = 6 * end.knot + 3 * weight + axis
                used = np.flatnonzero((column < states.size) & (end.weights[:, weight] != 0.0))
                value = sign * end.weights[used, weight] * directions[used, axis]
                np.add.at(slopes, (used, column[used]), value)
    return distances, slopes


@dataclass(frozen=True)
class _Factors:
    """Factored normal equations: steps of values (m,) and knots (size,) without the lengths, and covariance (m, m)."""

    value_step: Array
    state_step: Array
    covariance: Array
    coupling: Array
    eliminated: Eliminated
    of_schur: tuple[Array, bool]

    @staticmethod
    def of(equations: NormalEquations) -> _Factors:
        eliminated = Eliminated.of(equations, factor_knots(equations.bands, DAMPING))
        of_schur = cho_factor(eliminated.schur)
        value_step = cho_solve(of_schur, eliminated.right)
        covariance = cho_solve(of_schur, np.eye(len(value_step)))
        state_step = eliminated.knots_after(value_step)
        return _Factors(value_step, state_step, covariance, equations.coupling, eliminated, of_schur)

    def gains(self, slopes: Array) -> tuple[Array, Array]:
        """N^-1 G^T by values (m, k) and knots (size, k), with G the slopes (k, size)."""
        across = self.eliminated.of_knots(slopes.T)
        of_values = -cho_solve(self.of_schur, self.coupling.T @ across)
        return of_values, across + self.eliminated.followed(of_values)


def _step(equations: NormalEquations, slopes: Array, missing: Array, std: float) -> tuple[Array, Array, Array]:
    """Steps of values (m,) and knots (size,) with distances that miss the length by `missing` (k,); covariance."""
    factors = _Factors.of(equations)
    of_values, of_states = factors.gains(slopes)
    spread = std**2 * (np.eye(len(missing)) + 1.0) + slopes @ of_states
    weights = np.linalg.solve(spread, np.column_stack([missing - slopes @ factors.state_step, of_values.T]))
    covariance = factors.covariance - of_values @ weights[:, 1:]
    covariance = 0.5 * (covariance + covariance.T)
    return factors.value_step + of_values @ weights[:, 0], factors.state_step + of_states @ weights[:, 0], covariance
