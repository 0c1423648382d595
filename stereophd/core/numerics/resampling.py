"""Resampling of weighted particles (compiled): four schemes.

Each draws n indices of which every one occurs n w_i times on average. References: R. Douc, O. Cappe and
E. Moulines, "Comparison of resampling schemes for particle filtering", ISPA 2005; paper [3].
"""

import math

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled


@compiled
def _pick(weights: Array, points: Array, out: Integers) -> None:
    """Index of the particle that each of the sorted points in [0, sum of weights) falls on."""
    last = len(weights) - 1
    while last > 0 and weights[last] == 0.0:
        last -= 1
    index = 0
    reached = weights[0]
    for i in range(len(points)):
        # rounding of the sums may leave the last points beyond the end: they go to the last that weighs
        while points[i] >= reached and index < last:
            index += 1
            reached += weights[index]
        out[i] = index


@compiled
def systematic(weights: Array, uniform: Array, count: int = 0) -> Integers:
    """One uniform number shifts a comb of n teeth. Of `uniform` the first is used; weights (n,) need not sum to 1.

    `count` above 0 is another number of particles to draw.

    Every particle is drawn floor(n w) or ceil(n w) times (J. Carpenter, P. Clifford and P. Fearnhead, 1999).
    """
    if count <= 0:
        count = len(weights)
    out = np.empty(count, dtype=np.int64)
    _pick(weights, (np.arange(count) + uniform[0]) / count * weights.sum(), out)
    return out


@compiled
def stratified(weights: Array, uniform: Array) -> Integers:
    """One uniform number (n,) for every tooth."""
    count = len(weights)
    out = np.empty(count, dtype=np.int64)
    _pick(weights, (np.arange(count) + uniform[:count]) / count, out)
    return out


@compiled
def multinomial(weights: Array, uniform: Array) -> Integers:
    """Independent draws, as sorted uniform numbers by their exponential spacings; `uniform` (n + 1,)."""
    count = len(weights)
    out = np.empty(count, dtype=np.int64)
    spacings = np.cumsum(-np.log1p(-uniform[: count + 1]))
    _pick(weights, spacings[:count] / spacings[count], out)
    return out


@compiled
def residual(weights: Array, uniform: Array) -> Integers:
    """Every particle floor(n w) times, the rest by independent draws; `uniform` (n + 1,)."""
    count = len(weights)
    out = np.empty(count, dtype=np.int64)
    rest = np.empty(count)
    filled = 0
    for i in range(count):
        copies = math.floor(count * weights[i])
        rest[i] = count * weights[i] - copies
        for _ in range(copies):
            if filled < count:
                out[filled] = i
                filled += 1
    left = count - filled
    if left > 0:
        spacings = np.cumsum(-np.log1p(-uniform[: left + 1]))
        _pick(rest / rest.sum(), spacings[:left] / spacings[left], out[filled:])
    return out


SCHEMES = {
    "systematic": systematic,
    "stratified": stratified,
    "residual": residual,
    "multinomial": multinomial,
}
