"""A first guess of the cameras: one-camera tracks paired across cameras by their epipolar distance.

What one camera sees of an object can be tracked without knowing where any other camera is. Whether the tracks a and
b of two cameras may be one object depends on the cameras alone: at every common time the two rays must meet
(`stereophd.core.calibration.epipolar`). Cameras are drawn from the prior, tracks paired at the greatest total gain, the
cameras moved to where the paired tracks meet (Gauss-Newton with the prior), with a tolerance that falls. The best of
the draws is where the annealed alternation starts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from stereophd.core.calibration.epipolar import epipolar_distances, slopes_of
from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.track_pairs import LEAST_TIMES, TrackPairs
from stereophd.core.calibration.track_rays import Rays, rays_of

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

# Tolerances in units of the noise of the distance, step by step; a time counts for a pair within 3 of it.
TOLERANCES = (20.0, 10.0, 5.0, 2.5)
GAIN_LIMIT = 9.0
# What stays at its prior mean while tracks are paired moves the rays by less than this, in units of the noise.
LATER_TOLERANCE = 8.0
# Draws of a start, those refined, and Gauss-Newton steps at each tolerance.
DRAWS, REFINED, STEPS = 256, 8, 4
# Two draws that come so near each other, in prior standard deviations, end at the same cameras.
SAME = 0.05


def choose_pairs(pairs: TrackPairs, distances: Array, tolerance: float) -> tuple[Integers, float]:
    """Pair tracks one to one for each two cameras, at the greatest gain; return the pairs and the gain.

    The gain of a pair is the sum over its times of ``GAIN_LIMIT - (distance / tolerance)^2``: a pair that is further
    apart than three tolerances on average is no gain.
    """
    gain = GAIN_LIMIT - np.minimum((distances / tolerance) ** 2, 4.0 * GAIN_LIMIT)
    if pairs.raw is not None:
        known = np.isfinite(distances)
        enough = np.bincount(pairs.pair, weights=known, minlength=len(pairs.cameras)) >= LEAST_TIMES
        gain = np.where(known & enough[pairs.pair], gain, 0.0)
    gains = np.bincount(pairs.pair, weights=gain, minlength=len(pairs.cameras))
    chosen, total = [], 0.0
    for i, j in sorted(set(map(tuple, pairs.cameras.tolist()))):
        here = np.flatnonzero((pairs.cameras == (i, j)).all(axis=1))
        firsts, row = np.unique(pairs.tracks[here, 0], return_inverse=True)
        seconds, column = np.unique(pairs.tracks[here, 1], return_inverse=True)
        table = np.zeros((len(firsts), len(seconds)))
        number = np.full(table.shape, -1)
        table[row, column] = np.maximum(gains[here], 0.0)
        number[row, column] = here
        for r, c in zip(*linear_sum_assignment(-table), strict=True):
            if table[r, c] > 0.0:
                chosen.append(number[r, c])
                total += float(table[r, c])
    return np.array(chosen, dtype=np.int64), total


def refine(
    parameters: ParameterSet, pairs: TrackPairs, values: Array, rows: Integers, tolerance: float, columns: Integers
) -> Array:
    """Move the cameras to where the rows meet: Gauss-Newton over some values with the prior and Cauchy weights."""
    std = parameters.prior_std[columns]
    for _ in range(STEPS):
        distances, jacobian = slopes_of(parameters, pairs, values, rows, columns)
        usable = np.isfinite(distances) & np.isfinite(jacobian).all(axis=1)
        distances = np.where(usable, distances, 0.0) / tolerance
        jacobian = np.where(usable[:, None], jacobian, 0.0) / tolerance
        weights = 1.0 / (1.0 + distances**2)
        matrix = jacobian.T @ (weights[:, None] * jacobian) + np.eye(len(columns))
        offset = (values[columns] - parameters.prior_mean[columns]) / std
        values = values.copy()
        values[columns] -= std * np.linalg.solve(matrix, jacobian.T @ (weights * distances) + offset)
    return values


def coarse_columns(parameters: ParameterSet, pairs: TrackPairs, first: Booleans) -> Integers:
    """Values that matter for pairing, by how far one prior standard deviation moves the rays.

    Of the values that the first stage frees, those that move them by more than the last tolerance; of the others,
    those that move them by more than `LATER_TOLERANCE`.
    """
    every = np.arange(parameters.size)
    if pairs.raw is None:
        return every
    _, jacobian = slopes_of(parameters, pairs, parameters.prior_mean, np.arange(len(pairs.pair)), every)
    moved = np.sqrt(np.nanmean(np.concatenate([jacobian, np.zeros((1, parameters.size))]) ** 2, axis=0))
    return np.flatnonzero(moved > np.where(first, TOLERANCES[-1], LATER_TOLERANCE))


@dataclass(frozen=True)
class Pairing:
    """Cameras and the pairs of tracks that meet under them.

    Attributes
    ----------
    values : array (m,)
    chosen : array (c,) of int
        Indices of the pairs.
    """

    values: Array
    chosen: Integers


def best_pairing(parameters: ParameterSet, pairs: TrackPairs, draws: Array, first: Booleans) -> Pairing | None:
    """Find the cameras that pair the tracks best; None if nothing pairs.

    Parameters
    ----------
    parameters : ParameterSet
    pairs : TrackPairs
    draws : array (k, m)
        Draws of the prior.
    first : array (m,) of bool
        Values that are free from the first stage on.
    """
    if not len(pairs.cameras):
        return None
    rows = np.arange(len(pairs.pair))

    def gain(values: Array, tolerance: float) -> tuple[Integers, float]:
        chosen, total = choose_pairs(pairs, epipolar_distances(parameters.build(values), pairs, rows), tolerance)
        offset = (values - parameters.prior_mean) / parameters.prior_std
        return chosen, total - float(offset @ offset)

    columns = coarse_columns(parameters, pairs, first)
    fixed = np.setdiff1d(np.arange(parameters.size), columns)
    draws[1:, fixed] = parameters.prior_mean[fixed]
    gains = np.array([gain(values, TOLERANCES[0])[1] for values in draws])
    best, most = None, 0.0
    passed: dict[float, list[Array]] = {tolerance: [] for tolerance in TOLERANCES}
    for k in np.argsort(-gains, kind="stable")[:REFINED]:
        values = draws[k]
        for tolerance in TOLERANCES:
            chosen, _ = gain(values, tolerance)
            if not len(chosen):
                break
            values = refine(parameters, pairs, values, np.flatnonzero(np.isin(pairs.pair, chosen)), tolerance, columns)
            if _near_any(values, passed[tolerance], parameters.prior_std):
                break  # an earlier draw went on from here, and ended better than this one would
            passed[tolerance].append(values)
        chosen, reached = gain(values, TOLERANCES[-1])
        if reached > most:
            best, most = Pairing(values, chosen), reached
    return best


def _near_any(values: Array, others: list[Array], std: Array) -> bool:
    """Whether values (m,) come near any of some others."""
    return any(float((np.abs(values - other) / std).max()) < SAME for other in others)


def paired_objects(pairs: TrackPairs, pairing: Pairing, tracks: int) -> Integers:
    """Object of every track (tracks,), numbered from 0; -1 of those that are not paired."""
    leader = np.arange(tracks)
    for a, b in pairs.tracks[pairing.chosen].tolist():
        leader[leader == leader[b]] = leader[a]
    paired = np.isin(np.arange(tracks), pairs.tracks[pairing.chosen])
    objects = np.full(tracks, -1)
    objects[paired] = np.unique(leader[paired], return_inverse=True)[1]
    return objects


def meeting_points(parameters: ParameterSet, pairs: TrackPairs, pairing: Pairing) -> tuple[Integers, Array, Array]:
    """Rows of the chosen pairs, their times (r,) and the points (r, 3) where their rays come nearest.

    Depths are kept positive: rays that meet behind a camera are taken where they are far apart from it instead.
    """
    cameras = parameters.build(pairing.values)
    rows = np.flatnonzero(np.isin(pairs.pair, pairing.chosen))
    if pairs.raw is None:
        index = pairs.cameras[pairs.pair[rows]]
        found = Rays(
            pairs.rays[rows],
            pairs.times[rows],
            np.stack([c.pose.rotation for c in cameras])[index],
            np.stack([c.pose.center for c in cameras])[index],
            np.ones(len(rows), dtype=np.bool_),
        )
    else:
        found = rays_of(cameras, pairs.raw, pairs.entries[rows], pairs.others[rows])
    centers = found.centers
    rays = np.einsum("nkij,nki->nkj", found.rotations, found.rays)
    between = centers[:, 1] - centers[:, 0]
    aa, bb = (rays[:, 0] ** 2).sum(axis=1), (rays[:, 1] ** 2).sum(axis=1)
    ab = (rays[:, 0] * rays[:, 1]).sum(axis=1)
    da, db = (rays[:, 0] * between).sum(axis=1), (rays[:, 1] * between).sum(axis=1)
    determinant = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    distance = np.linalg.norm(between, axis=1)
    depth_a = np.clip((da * bb - db * ab) / determinant, 0.5 * distance, 100.0 * distance)
    depth_b = np.clip((da * ab - db * aa) / determinant, 0.5 * distance, 100.0 * distance)
    points = centers + np.stack([depth_a, depth_b], axis=1)[:, :, None] * rays
    return rows[found.seen], found.times[found.seen], np.asarray(points.mean(axis=1))[found.seen]
