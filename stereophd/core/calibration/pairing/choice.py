"""Which one-camera tracks are one object: the gain of each pair of tracks, and the choice of the greatest total."""

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
    for number in pairs.tables:
        table = np.where(number >= 0, np.maximum(gains[number], 0.0), 0.0)
        row, column = linear_sum_assignment(-table)
        kept = table[row, column] > 0.0
        chosen.append(number[row[kept], column[kept]])
        total += float(table[row, column].sum())
    return np.concatenate([np.empty(0, dtype=np.int64), *chosen]), total
