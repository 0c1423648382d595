"""Speeds or a length of the scene that are known: its scale, once the trajectories are fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.fits import adjusted_to
from stereophd.core.calibration.scale import ScaleMeasurement, log_scale
from stereophd.core.calibration.task import Fit, Task
from stereophd.core.calibration.trajectories import interpolation, positions

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Steps in which the length of a path is measured, and times at which distances are.
SPEED_STEPS, DISTANCE_TIMES = 200, 1000
# Two objects keep their distance if its standard deviation is below this part of it, over as many times at least, while
# they move by this part of it: objects that hardly move keep any distance.
RIGID, LEAST_TIMES, LEAST_TRAVEL = 0.02, 8, 0.5
# Width of a peak of the logarithms of distances, and reach of the prior of the scale in standard deviations.
PEAK_WIDTH, PRIOR_REACH = 0.02, 3.0


def measured_scale(task: Task, fit: Fit, kind: str, value: float, std: float) -> ScaleMeasurement | None:
    """Measure the scale by the known speed of all objects, or by the known distance of two.

    Speeds and distances in units of the scene's scale do not depend on it, so each of them measures its logarithm as
    log s + log(known / found). The speeds of k objects are independent measurements.

    Parameters
    ----------
    task, fit : Task, Fit
    kind : str
        ``speed`` (mean speed of every object) or ``length`` (distance that two or more keep).
    value, std : float
        What is known.

    Returns
    -------
    ScaleMeasurement or None
        None if no two objects keep their distance.
    """
    logarithm, gradient = log_scale(task.parameters, task.reference, fit.adjustment.values)
    if kind == "speed":
        found = mean_speeds(fit)
        target = logarithm + float(np.log(value / found).mean())
        return ScaleMeasurement("log_scale", target, std / value / np.sqrt(len(found)))
    distances, spreads, _ = rigid_pairs(fit)
    if not len(distances):
        return None
    spread = float(np.sqrt((gradient**2 * task.parameters.prior_std**2).sum()))
    ratio, error = known_distance(distances, spreads, value, -logarithm, spread)
    return ScaleMeasurement("log_scale", logarithm + ratio, float(np.hypot(std / value, error)))


def rescaled(task: Task, fit: Fit, measurement: ScaleMeasurement) -> Fit:
    """Adjust again, with the scale measured."""
    return adjusted_to(task, fit, fit.observations, fit.observations.trajectories, fit.detections, measurement)


def mean_speeds(fit: Fit) -> Array:
    """Mean speed of every trajectory, length/s."""
    out = []
    for j, (start, end) in enumerate(fit.knots.spans):
        times = np.linspace(start, end, SPEED_STEPS + 1)
        path = positions(fit.adjustment.states, *interpolation(fit.knots, np.full(len(times), j), times))
        out.append(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) / max(end - start, 1e-300))
    return np.array(out)


def rigid_pairs(fit: Fit, within: float = RIGID) -> tuple[Array, Array, Integers]:
    """Pairs of trajectories that keep their distance while they move: mean distances, their relative deviations, pairs.

    Each pair is asked only while both are seen, which may be for seconds. The relative deviation is below `within`.
    """
    spans = fit.knots.spans
    times = np.linspace(spans[:, 0].min(), spans[:, 1].max(), DISTANCE_TIMES)
    paths = np.full((fit.knots.count, len(times), 3), np.nan)
    for j, (start, end) in enumerate(spans):
        seen = np.flatnonzero((times >= start) & (times <= end))
        numbers = np.full(len(seen), j)
        paths[j, seen] = positions(fit.adjustment.states, *interpolation(fit.knots, numbers, times[seen]))
    means, spreads = [np.empty(0)], [np.empty(0)]
    members = [np.empty((0, 2), dtype=np.int64)]
    for j in range(1, len(paths)):
        between = paths[:j] - paths[j]
        distances = np.linalg.norm(between, axis=2)
        both = np.isfinite(distances)
        count = both.sum(axis=1)
        mean = np.where(both, distances, 0.0).sum(axis=1) / np.maximum(count, 1)
        deviation = np.where(both, distances - mean[:, None], 0.0)
        spread = np.sqrt((deviation**2).sum(axis=1) / np.maximum(count, 1))
        middle = np.where(both[:, :, None], 0.5 * (paths[:j] + paths[j]), np.nan)
        rigid = (count >= LEAST_TIMES) & (spread < within * mean)
        for i in np.flatnonzero(rigid):
            travel = float(np.linalg.norm(np.ptp(middle[i][both[i]], axis=0)))
            rigid[i] = travel > LEAST_TRAVEL * mean[i]
        means.append(mean[rigid])
        spreads.append(spread[rigid] / mean[rigid])
        first = np.flatnonzero(rigid)
        members.append(np.column_stack([first, np.full(len(first), j)]))
    return np.concatenate(means), np.concatenate(spreads), np.concatenate(members)


def known_distance(
    distances: Array, spreads: Array, length: float, expected: float, prior_std: float
) -> tuple[float, float]:
    """Find which of the distances (p,) of pairs is the known length; return log(length / distance) and its error.

    Many neighbouring corners of a board are the known length apart, and other pairs are not. The peak of the logarithms
    of the distances is therefore taken, among those that the prior of the scale allows. If it allows none, the pair
    that keeps its distance best is taken.

    Parameters
    ----------
    distances, spreads : arrays (p,)
        Mean distances, and their deviations in parts of them.
    length : float
    expected, prior_std : float
        Prior of the result.
    """
    ratios = np.log(length / distances)
    allowed = np.flatnonzero(np.abs(ratios - expected) <= PRIOR_REACH * prior_std)
    if not len(allowed):
        best = int(spreads.argmin())
        return float(ratios[best]), float(spreads[best])
    ratios, weights = ratios[allowed], 1.0 / (1.0 + (spreads[allowed] / PEAK_WIDTH) ** 2)
    support = np.exp(-0.5 * ((ratios - ratios[:, None]) / PEAK_WIDTH) ** 2) @ weights
    peak = np.flatnonzero(np.abs(ratios - ratios[support.argmax()]) <= 2.0 * PEAK_WIDTH)
    mean = float(np.average(ratios[peak], weights=weights[peak]))
    scatter = float(np.average((ratios[peak] - mean) ** 2, weights=weights[peak]))
    error = np.sqrt(max(scatter, float((spreads[allowed][peak] ** 2).min())) / len(peak))
    return mean, float(error)
