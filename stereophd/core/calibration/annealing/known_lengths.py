"""Known lengths as measurements at all times: corners of a board, or the ends of a wand, keep their distance.

The scale needs one number of them (`calibration.annealing.known_scale`). But two objects whose distance is known
at all times also measure depth at all times, and with it focal lengths and lenses. The answer states N(v, C) for the
values of the cameras, the trajectories integrated out, and trajectories follow values: x = x(v) + A^-1/2 noise, with A
the matrix of the knots in the normal equations and F = dx/dv. Beside it the distances d are measurements, of the
derivative G by the knots and the covariance R of the known lengths, in an iterated Kalman update:

    N = [[C, C F^T], [F C, A^-1 + F C F^T]],    step = step_0 + N G^T (R + G N G^T)^-1 (length - d - G step_0),

with step_0 back to the answer. It keeps what it was widened by, and the bias of the joint optimum does not come back
(`adjustment.marginal`). Its scale was measured by the same distances, and counts as known by the prior alone.

A pair that keeps about the known length by chance would pull everything. Which pairs are taken is therefore decided by
their odds (`calibration.annealing.known_scale`) and by the distances over the whole common time: y = length - d -
G step_0 has the covariance S = R + G N G^T of a rigid pair of that length, or S + B B^T, where a distance of chance
deviates by a constant and a steady change (the columns of B) of up to the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation, factor_knots
from stereophd.core.calibration.adjustment.solver import Eliminated
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.fits import at_values, problem_of
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
    problem, parameters, values = problem_of(task, fit), task.parameters, fit.adjustment.values
    _, gradient = log_scale(parameters, task.reference, values)
    spread = float(np.sqrt((gradient**2 * parameters.prior_std**2).sum()))
    linearisation = Linearisation.of(problem.weighted(problem.weights(fit.adjustment.distances)))
    answer = _Answer(linearisation, values, with_free_scale(fit.adjustment.covariance, gradient, spread))
    best, count = fit, 0
    for _ in range(ROUNDS):
        pairs, odds = _candidates(best, length, PRIOR_REACH * spread)
        if len(pairs) > count:
            pairs = pairs[_odds_of_lengths(answer, best, pairs, length, std) + odds > 0.0]
        if len(pairs) <= count:
            break  # with the lengths of some pairs others keep theirs, too
        found = _updated(task, answer, best, pairs, length, std)
        if found is None:
            break
        best, count = found, len(pairs)
    return best, count


def with_free_scale(covariance: Array, gradient: Array, std: float) -> Array:
    """Return a covariance (m, m) in which the log scale, of a gradient (m,), is known to std; the rest is as before."""
    with_scale = covariance @ gradient
    variance = float(gradient @ with_scale)
    more = max(std**2 - variance, 0.0) / max(variance, 1e-300) ** 2
    return np.asarray(covariance + more * np.outer(with_scale, with_scale))


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


def _odds_of_lengths(answer: _Answer, fit: Fit, pairs: Integers, length: float, std: float) -> Array:
    """Logarithms of the odds (p,) that pairs (p, 2) have the length at all common times, rather than by chance.

    Errors that no covariance contains, such as those of lenses, are taken as large as the better half of the pairs
    shows them. Zeros where the equations have no solution: the distances then say nothing.
    """
    try:
        information, along = _deviations(answer, fit, pairs, length, std)
        squared = np.einsum("pi,pi->p", along, np.linalg.solve(information, along[:, :, None])[:, :, 0])
    except LinAlgError:
        return np.zeros(len(pairs))
    typical = float(np.sort(squared)[(len(squared) - 1) // 2])
    factor = max(typical / MEDIAN_OF_TWO, 1.0)
    whole = np.eye(2) + information / factor
    pulled = np.einsum("pi,pi->p", along, np.linalg.solve(whole, along[:, :, None])[:, :, 0]) / factor**2
    return np.asarray(0.5 * np.linalg.slogdet(whole)[1] - 0.5 * pulled)


def _deviations(answer: _Answer, fit: Fit, pairs: Integers, length: float, std: float) -> tuple[Array, Array]:
    """Constant and steady deviation of each pair: information (p, 2, 2), and information times estimate (p, 2).

    In units of the tolerance. The pairs are solved one by one, which bounds the memory.
    """
    states = fit.adjustment.states
    pair, times = _sampled(fit, pairs, states.size, LEAST_TIMES_FOR_ODDS)
    factors = answer.factors(fit.adjustment.values, states)
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


def _updated(task: Task, answer: _Answer, fit: Fit, pairs: Integers, length: float, std: float) -> Fit | None:
    """Adjust a fit to the lengths of pairs (p, 2); None where these contradict the answer."""
    values, states, covariance = fit.adjustment.values, fit.adjustment.states, fit.adjustment.covariance
    (pair, times), cost = _sampled(fit, pairs, states.size), np.inf
    try:
        for _ in range(STEPS):
            found, slopes = _distances(fit, states, pairs[pair], times)
            step, covariance, cost = _step(answer.factors(values, states), slopes, length - found, std)
            values, states = values + step[: len(values)], states + step[len(values) :].reshape(states.shape)
    except LinAlgError:
        return None
    return at_values(task, fit, values, states, covariance) if cost <= MOST_COST * len(times) else None


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
class _Answer:
    """What detections and priors say: values (m,), their covariance (m, m), and how trajectories follow them."""

    linearisation: Linearisation
    values: Array
    covariance: Array

    def factors(self, values: Array, states: Array) -> _Factors:
        """Return it as seen from values (m,) and knots (k, 2, 3)."""
        equations, step = self.linearisation.at(values, states), self.values - values
        eliminated = Eliminated.of(equations, factor_knots(equations.bands, DAMPING))
        return _Factors(step, eliminated.knots_after(step), self.covariance, equations.coupling, eliminated)


@dataclass(frozen=True)
class _Factors:
    """Steps of values (m,) and knots (size,) to the answer, its covariance (m, m), and how knots follow values."""

    value_step: Array
    state_step: Array
    covariance: Array
    coupling: Array
    eliminated: Eliminated

    def gains(self, slopes: Array) -> tuple[Array, Array]:
        """N G^T by values (m, k) and knots (size, k), with G the slopes (k, size)."""
        across = self.eliminated.of_knots(slopes.T)
        of_values = -self.covariance @ (self.coupling.T @ across)
        return of_values, across + self.eliminated.followed(of_values)


def _step(factors: _Factors, slopes: Array, missing: Array, std: float) -> tuple[Array, Array, float]:
    """Step of values and knots (m + size,) with distances that miss the length by `missing` (k,); covariance; cost."""
    of_values, of_states = factors.gains(slopes)
    spread = std**2 * (np.eye(len(missing)) + 1.0) + slopes @ of_states
    missing = missing - slopes @ factors.state_step
    weights = np.linalg.solve(spread, np.column_stack([missing, of_values.T]))
    covariance = factors.covariance - of_values @ weights[:, 1:]
    steps = np.append(factors.value_step, factors.state_step) + np.concatenate([of_values, of_states]) @ weights[:, 0]
    return steps, 0.5 * (covariance + covariance.T), float(missing @ weights[:, 0])
