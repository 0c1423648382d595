"""Speeds or a length of the scene that are known: its scale, once the trajectories are fitted.

Not every object has the known speed, and not every pair that keeps its distance is the known one. Both are therefore
mixtures (ours). Of speeds a part `ODD_SPEEDS` may be anything. Of two objects that keep their distance d over their
common time T to a deviation of s, the rate sqrt(12) s / T is compared with those of all pairs of the log: the share of
pairs with so small a rate, times the number of pairs of about that distance, is the number E of pairs that chance makes
as rigid as this one. The odds that a pair is rigid are then 1 / E, or the number of pairs of the known length over E.
Many objects that move alike make E large, and the distances of their pairs count little.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.fits import adjusted_to
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, log_scale

# Steps in which the length of a path is measured, and times at which distances are.
SPEED_STEPS, DISTANCE_TIMES = 200, 1000
# Two objects keep their distance if its standard deviation is below this part of it, over as many times at least, while
# they move by this part of it: objects that hardly move keep any distance.
RIGID, LEAST_TIMES, LEAST_TRAVEL = 0.02, 8, 0.5
# Width of a peak of the logarithms of distances, and reach of the prior of the scale in standard deviations.
PEAK_WIDTH, PRIOR_REACH = 0.02, 3.0
# Part of the objects that may have any speed, and the range of its logarithm.
ODD_SPEEDS, SPEED_RANGE = 0.2, float(np.log(1e4))
# Median of the absolute deviations of a normal distribution in standard deviations, largest relative width of the
# speeds of objects of one speed, and the part of all objects that must have it.
NORMAL_MIDDLE, WIDEST_SPEEDS, CLEAR_MAJORITY = 0.6745, 0.3, 0.55
# A peak counts if it holds this share of the probability; rounds in which the number of its members is found.
LEAST_SHARE, ROUNDS = 0.9, 20
# A rigid body has pairs of many lengths. None other may have more pairs than this part of the n pairs of the chosen
# length, or than n - sqrt(n), if that is more: a board has 17 neighbours and 12 diagonals.
LARGEST_RIVAL = 0.5
# Of all pairs, those of the smallest rates from which the rates of chance are extrapolated to zero.
SLOW_PAIRS = 20


@dataclass(frozen=True)
class ObjectPairs:
    """All pairs of trajectories that are seen together for a while."""

    distances: Array  # (p,): Mean distances over the common times
    spreads: Array  # (p,): Standard deviations of the distances in parts of them
    travels: Array  # (p,): How far the middle of the pair moves in the common time, length
    seconds: Array  # (p,): The common time, s
    members: Integers  # (p, 2) of int: The trajectories

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Whether the pairs (p,) move far enough for a constant distance to mean something."""
        return np.asarray(self.travels > LEAST_TRAVEL * self.distances)

    def rigid(self, within: float = RIGID) -> Integers:
        """Return the places of moving pairs whose relative deviation is below a limit."""
        return np.flatnonzero(self.moving & (self.spreads < within))

    def by_chance(self, near: NDArray[np.bool_]) -> Array:
        """Return how many of the pairs `near` (p,) a distance chance makes as rigid as each pair (p,).

        Where there are few pairs, independent objects of the speed of these take the place of others.
        """
        near = near & self.moving
        rates = np.sqrt(12.0) * self.spreads * self.distances / self.seconds
        if not near.any():
            return np.zeros(len(rates))
        others = rates[self.travels > LEAST_TRAVEL * float(np.median(self.distances[near]))]
        speed = float(np.median((self.travels / self.seconds)[near]))
        ordered = np.sort(np.concatenate([others, np.full(max(SLOW_PAIRS - len(others), 0), speed)]))
        # chance makes small rates evenly: the share below the least ones is extrapolated from a few more
        share = np.searchsorted(ordered, rates, side="right") / len(ordered)
        slow = float(ordered[SLOW_PAIRS - 1])
        linear = SLOW_PAIRS / len(ordered) * rates / max(slow, 1e-300)
        return np.asarray(near.sum() * np.where(rates < slow, linear, share))


def measured_scale(task: Task, fit: Fit, known: ScaleMeasurement) -> ScaleMeasurement | None:
    """Measure the scale, which is free, by a known speed or length.

    The kind is ``speed`` (mean speed of most objects) or ``length`` (the most probable distance that two or more keep).
    Speeds and distances in units of the scene's scale do not depend on it, so each of them measures its logarithm as
    log s + log(known / found). The speeds of k objects are independent measurements.

    None if no two objects keep their distance, or if neither distances nor speeds agree on a scale.
    """
    logarithm, gradient = log_scale(task.parameters, task.reference, fit.adjustment.values)
    if known.kind == "speed":
        found = known_speed(mean_speeds(fit), known.value, known.std)
        return None if found is None else ScaleMeasurement("log_scale", logarithm + found[0], found[1])
    spread = float(np.sqrt((gradient**2 * task.parameters.prior_std**2).sum()))
    found = known_distance(object_pairs(fit), known.value, -logarithm, spread)
    if found is None:
        return None
    return ScaleMeasurement("log_scale", logarithm + found[0], float(np.hypot(known.std / known.value, found[1])))


def rescaled(task: Task, fit: Fit, measurement: ScaleMeasurement) -> Fit:
    """Adjust again, with the scale measured."""
    # in the task, for all adjustments that this one may need
    task = replace(task, scale=measurement)
    return adjusted_to(task, fit, fit.observations, fit.detections)


def mean_speeds(fit: Fit) -> Array:
    """Mean speed of every trajectory, length/s."""
    out = []
    for j, (start, end) in enumerate(fit.knots.spans):
        times = np.linspace(start, end, SPEED_STEPS + 1)
        path = positions(fit.adjustment.states, *interpolation(fit.knots, np.full(len(times), j), times))
        out.append(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) / max(end - start, 1e-300))
    return np.array(out)


def known_speed(speeds: Array, speed: float, std: float) -> tuple[float, float] | None:
    """Find log(speed / found) of most objects, and its error; None if the objects do not agree on one.

    Of the mean speeds (k,) some may be of other objects, or of what is none; `std` is the standard deviation of the
    known speed from object to object. The speeds are a normal density on a floor of others (a mixture, fitted by
    expectation and maximisation). Its width begins with that of the densest third of the logarithms, so that it does
    not span several groups.
    """
    ratios = np.log(speed / np.maximum(speeds, 1e-300))
    # trajectories have errors of their own, which the shortest interval that holds a third of them shows
    ordered, least = np.sort(ratios), std / speed
    count = (len(ordered) + 2) // 3
    shortest = float((ordered[count - 1 :] - ordered[: len(ordered) - count + 1]).min())
    width = float(np.clip(0.5 * shortest / NORMAL_MIDDLE, least, max(WIDEST_SPEEDS, least)))

    def members(center: Array) -> Array:
        near = (1.0 - ODD_SPEEDS) * _normal(ratios - center, width)
        return np.asarray(near / (near + ODD_SPEEDS / SPEED_RANGE))

    def log_likelihood(center: Array) -> Array:
        density = (1.0 - ODD_SPEEDS) * _normal(ratios - center, width) + ODD_SPEEDS / SPEED_RANGE
        return np.asarray(np.log(density).sum(axis=1))

    center = float(ordered[log_likelihood(ordered[:, None]).argmax()])
    for _ in range(ROUNDS):
        weights = members(np.array(center))
        center = float(np.average(ratios, weights=weights))
        scatter = float(np.sqrt(np.average((ratios - center) ** 2, weights=weights)))
        width = float(np.clip(scatter, least, max(WIDEST_SPEEDS, least)))
    apart = np.abs(ordered - center) > 4.0 * width
    if apart.any():
        rival = float(log_likelihood(ordered[apart, None]).max())
        here = float(log_likelihood(np.array([[center]]))[0])
        if rival > here + np.log(1.0 - LEAST_SHARE):
            return None
    weights = members(np.array(center))
    if weights.sum() < CLEAR_MAJORITY * len(ratios):
        return None
    variance = float(np.average((ratios - center) ** 2, weights=weights))
    return center, float(np.sqrt(max(width**2, variance) / weights.sum()))


def object_pairs(fit: Fit) -> ObjectPairs:
    """Pairs of trajectories that are seen together, which may be for seconds only, while they move."""
    spans = fit.knots.spans
    times = np.linspace(spans[:, 0].min(), spans[:, 1].max(), DISTANCE_TIMES)
    paths = np.full((fit.knots.count, len(times), 3), np.nan)
    for j, (start, end) in enumerate(spans):
        seen = np.flatnonzero((times >= start) & (times <= end))
        numbers = np.full(len(seen), j)
        paths[j, seen] = positions(fit.adjustment.states, *interpolation(fit.knots, numbers, times[seen]))
    columns = [np.empty((0, 6))]
    for j in range(1, len(paths)):
        distances = np.linalg.norm(paths[:j] - paths[j], axis=2)
        both = np.isfinite(distances)
        count = both.sum(axis=1)
        mean = np.where(both, distances, 0.0).sum(axis=1) / np.maximum(count, 1)
        deviation = np.where(both, distances - mean[:, None], 0.0)
        spread = np.sqrt((deviation**2).sum(axis=1) / np.maximum(count, 1))
        middle = 0.5 * (paths[:j] + paths[j])
        together = np.flatnonzero((count >= LEAST_TIMES) & (mean > 0.0))
        travels = np.array([float(np.linalg.norm(np.ptp(middle[i][both[i]], axis=0))) for i in together])
        mean, seconds = mean[together], count[together] * (times[1] - times[0])
        second = np.full(len(together), float(j))
        columns.append(np.column_stack([mean, spread[together] / mean, travels, seconds, together, second]))
    found = np.concatenate(columns)
    means, spreads, travels, seconds = found[:, :4].T
    return ObjectPairs(means, spreads, travels, seconds, found[:, 4:].astype(np.int64))


@dataclass(frozen=True)
class Peaks:
    """Rigid pairs whose distance may be the known length: within the reach of the prior."""

    # `ratios`, `widths`: arrays (k,): Logarithms of the length over the distances, and their uncertainty.
    ratios: Array
    widths: Array
    # (k,): Odds that a pair keeps its distance because it is rigid, not by chance, if one rigid pair is expected.
    odds: Array
    range: float  # Width of the interval in which the logarithms lie: twice the reach

    def densities(self, center: Array) -> Array:
        """Odds times densities (n, k) of the ratios at centers (n,), in units of those of chance."""
        return np.asarray(self.odds * self.range * _normal(self.ratios - center[:, None], self.widths))

    def logarithms(self, center: Array) -> Array:
        """Log-likelihoods (n,) of centers (n,), up to a constant."""
        return np.asarray(np.log(1.0 + self.densities(center)).sum(axis=1))

    def probabilities(self, center: float) -> Array:
        """Probabilities (k,) that the pairs have the known length, if the logarithm of its ratio is `center`.

        The expected number of pairs of that length, which the odds need, is found by iteration.
        """
        density, known = self.densities(np.array([center]))[0], 1.0
        shares = density
        for _ in range(ROUNDS):
            shares = known * density / (1.0 + known * density)
            known = max(float(shares.sum()), 1.0)
        return np.asarray(shares)

    def largest_rival(self, center: float) -> float:
        """Return the largest expected number of pairs of another length, `4 PEAK_WIDTH` from a center or more."""
        apart = np.abs(self.ratios - center) > 4.0 * PEAK_WIDTH
        return max((float(self.probabilities(float(other)).sum()) for other in self.ratios[apart]), default=0.0)


def _normal(errors: Array, std: Array | float) -> Array:
    return np.asarray(np.exp(-0.5 * (errors / std) ** 2) / (np.sqrt(2.0 * np.pi) * std))


def candidate_pairs(
    pairs: ObjectPairs, rigid: Integers, length: float, center: float, reach: float
) -> tuple[Peaks, Integers]:
    """Rigid pairs that may have the known length: those whose log(length / distance) is within `reach` of `center`.

    `rigid` (r,) has the places of rigid pairs. Returns the candidates and their odds, and their places (k,) in `pairs`.
    """
    every = np.log(length / pairs.distances)
    near = np.abs(every - center) <= reach
    rigid = rigid[near[rigid]]
    widths = np.hypot(pairs.spreads[rigid], 0.5 * PEAK_WIDTH)
    odds = 1.0 / np.maximum(pairs.by_chance(near)[rigid], 1e-9)
    return Peaks(every[rigid], widths, odds, 2.0 * reach), rigid


def known_distance(pairs: ObjectPairs, length: float, expected: float, prior_std: float) -> tuple[float, float] | None:
    """Find which of the distances of rigid pairs is the known length; return log(length / distance) and its error.

    Many neighbouring corners of a board are the known length apart, and other pairs are not. The ratio of the greatest
    probability is taken, among those that the prior of the result, `expected` with `prior_std`, allows. If the prior
    allows no rigid pair, the pair that keeps its distance best is taken.

    None if no pair is rigid, if several distances are about as probable or chance may have made them, if another
    distance has nearly as many pairs (`LARGEST_RIVAL`), and where the prior leaves nothing free.
    """
    rigid = pairs.rigid()
    if not len(rigid) or prior_std <= 0.0:
        return None
    peaks, places = candidate_pairs(pairs, rigid, length, expected, PRIOR_REACH * prior_std)
    if not len(places):
        best = rigid[pairs.spreads[rigid].argmin()]
        chances = pairs.by_chance(pairs.moving)[best]
        if chances > (1.0 - LEAST_SHARE) / LEAST_SHARE:
            return None
        return float(np.log(length / pairs.distances[best])), float(pairs.spreads[best])
    centers = np.linspace(-1.0, 1.0, 2001) * PRIOR_REACH * prior_std + expected
    logarithms = peaks.logarithms(centers) - 0.5 * ((centers - expected) / prior_std) ** 2
    probabilities = np.exp(logarithms - logarithms.max())
    here = np.abs(centers - centers[logarithms.argmax()]) <= 2.0 * PEAK_WIDTH
    if probabilities[here].sum() < LEAST_SHARE * probabilities.sum():
        return None
    weights = peaks.probabilities(float(centers[logarithms.argmax()]))
    mean, count = float(np.average(peaks.ratios, weights=weights)), float(weights.sum())
    if peaks.largest_rival(mean) > max(LARGEST_RIVAL * count, count - np.sqrt(count)):
        return None
    scatter = float(np.average((peaks.ratios - mean) ** 2, weights=weights))
    least = float((pairs.spreads[places][weights > 0.5] ** 2).min(initial=PEAK_WIDTH**2))
    return mean, float(np.sqrt(max(scatter, least) / max(count, 1.0)))
