"""Resampling of weighted particles: four schemes.

Each draws n indices of which every one occurs n w_i times on average. References: R. Douc, O. Cappe and
E. Moulines, "Comparison of resampling schemes for particle filtering", ISPA 2005; paper [3].
"""

import numpy as np

from stereophd.core.arrays import Array, Integers


def _picked(weights: Array, points: Array) -> Integers:
    """Index of the particle that each of the sorted points, in parts of the sum of the weights, falls on."""
    ends = np.cumsum(weights)
    # rounding of the sums may leave the last points beyond the end: they go to the last that weighs
    last = np.flatnonzero(weights).max(initial=0)
    return np.asarray(np.minimum(np.searchsorted(ends, points * ends[-1:], side="right"), last))


def systematic(weights: Array, uniform: Array, count: int = 0) -> Integers:
    """One uniform number shifts a comb of n teeth. Of `uniform` the first is used; weights (n,) need not sum to 1.

    `count` above 0 is another number of particles to draw.

    Every particle is drawn floor(n w) or ceil(n w) times (J. Carpenter, P. Clifford and P. Fearnhead, 1999).
    """
    count = count or len(weights)
    return _picked(weights, (np.arange(count) + uniform[0]) / count)


def stratified(weights: Array, uniform: Array) -> Integers:
    """One uniform number (n,) for every tooth."""
    count = len(weights)
    return _picked(weights, (np.arange(count) + uniform[:count]) / count)


def multinomial(weights: Array, uniform: Array) -> Integers:
    """Independent draws, as sorted uniform numbers by their exponential spacings: one less than there is `uniform`."""
    spacings = np.cumsum(-np.log1p(-uniform))
    return _picked(weights, spacings[:-1] / spacings[-1])


def residual(weights: Array, uniform: Array) -> Integers:
    """Every particle floor(n w) times, the rest by independent draws; `uniform` (n + 1,)."""
    count = len(weights)
    copies = np.floor(count * weights).astype(np.int64)
    kept = np.repeat(np.arange(count), copies)[:count]
    return np.concatenate([kept, multinomial(count * weights - copies, uniform[: count - len(kept) + 1])])


SCHEMES = {each.__name__: each for each in (systematic, stratified, residual, multinomial)}
