"""Which one-camera tracks are one object: the gain of each pair of tracks, and the choice of the greatest total."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.pairing.track_pairs import LEAST_TIMES, TrackPairs

# A time counts for a pair within the root of this of the tolerance, in units of the noise of the distance.
GAIN_LIMIT = 9.0


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
    known, count = np.isfinite(distances), len(pairs.cameras)
    enough = np.bincount(pairs.pair, weights=known, minlength=count) >= LEAST_TIMES
    gain = GAIN_LIMIT - np.minimum((distances / tolerance) ** 2, 4.0 * GAIN_LIMIT)
    gain = np.where(known & enough[pairs.pair], gain, 0.0)
    return np.asarray(np.bincount(pairs.pair, weights=gain, minlength=count), dtype=np.float64)


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
