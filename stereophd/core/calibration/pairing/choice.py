"""A first guess of the cameras: one-camera tracks paired across cameras by their epipolar distance.

What one camera sees of an object can be tracked without knowing where any other camera is. Whether the tracks a and
b of two cameras may be one object depends on the cameras alone: at every common time the two rays must meet
(`stereophd.core.two_views.epipolar`). Cameras are drawn from the prior, tracks paired at the greatest total gain, the
cameras moved to where the paired tracks meet (Gauss-Newton with the prior), with a tolerance that falls
(`stereophd.core.calibration.pairing.search`). The best of the draws is where the annealed alternation starts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.pairing.track_pairs import LEAST_TIMES, TrackPairs
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.two_views.epipolar import slopes_of

# Tolerances in units of the noise of the distance, step by step; a time counts for a pair within 3 of it.
TOLERANCES = (20.0, 10.0, 5.0, 2.5)
GAIN_LIMIT = 9.0
# Gauss-Newton steps at each tolerance.
STEPS = 4


@dataclass(frozen=True)
class Pairing:
    """Cameras and the pairs of tracks that meet under them."""

    values: Array  # (m,)
    chosen: Integers  # (c,) of int: Indices of the pairs
    # Gain of the pairs, less the squared distance of the values from the prior mean in its standard deviations.
    gain: float


def pair_gains(pairs: TrackPairs, distances: Array, tolerance: float) -> Array:
    """Gain (p,) of every pair: the sum over its times of ``GAIN_LIMIT - (distance / tolerance)^2``.

    A pair that is further apart than three tolerances on average is no gain.
    """
    gain = GAIN_LIMIT - np.minimum((distances / tolerance) ** 2, 4.0 * GAIN_LIMIT)
    if pairs.raw is not None:
        known = np.isfinite(distances)
        enough = np.bincount(pairs.pair, weights=known, minlength=len(pairs.cameras)) >= LEAST_TIMES
        gain = np.where(known & enough[pairs.pair], gain, 0.0)
    return np.asarray(np.bincount(pairs.pair, weights=gain, minlength=len(pairs.cameras)), dtype=np.float64)


def choose_pairs(pairs: TrackPairs, gains: Array) -> tuple[Integers, float]:
    """Pair tracks one to one for each two cameras, at the greatest total gain; return the pairs and the total."""
    chosen, total = [], 0.0
    for i, j in pairs.camera_pairs:
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
