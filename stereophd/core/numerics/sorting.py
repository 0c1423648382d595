"""Compiled order, choice and copies of array elements.

NumPy's own functions and assignments of slices do the same in compiled code, but numba compiles their general forms
anew at every place: half a second each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.numerics.compilation import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Runs of this length are sorted by insertion, and then merged.
RUN = 16


@compiled
def stable_order(keys: NDArray[Any]) -> Integers:
    """Return the indices that sort keys (n,), equal ones in their order, NaN last: `np.argsort` by merging."""
    count = len(keys)
    order = np.arange(count)
    sorted_until = 1
    while sorted_until < count and not _precedes(keys[sorted_until], keys[sorted_until - 1]):
        sorted_until += 1
    if sorted_until >= count:
        return order
    for i in range(count):
        key, place = keys[i], i
        first = i - i % RUN
        while place > first and _precedes(key, keys[order[place - 1]]):
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
    if count <= RUN:
        return order
    other = np.empty(count, dtype=np.int64)
    length = RUN
    while length < count:
        for start in range(0, count, 2 * length):
            middle, end = min(start + length, count), min(start + 2 * length, count)
            left, right = start, middle
            for place in range(start, end):
                if left < middle and (right >= end or not _precedes(keys[order[right]], keys[order[left]])):
                    other[place] = order[left]
                    left += 1
                else:
                    other[place] = order[right]
                    right += 1
        order, other = other, order
        length *= 2
    return order


@compiled
def _precedes(one: float, other: float) -> bool:
    """Whether a key comes before another one; NaN is the last."""
    # only NaN differs from itself
    return one < other or (other != other and one == one)


@compiled
def picked(values: NDArray[Any], index: Integers) -> NDArray[Any]:
    """Return the values (n,) with these indices (m,)."""
    out = np.empty(len(index), dtype=values.dtype)
    for i in range(len(index)):
        out[i] = values[index[i]]
    return out


@compiled
def places(chosen: NDArray[np.bool_]) -> Integers:
    """Return the indices of what is chosen."""
    out = np.empty(len(chosen), dtype=np.int64)
    count = 0
    for i in range(len(chosen)):
        if chosen[i]:
            out[count] = i
            count += 1
    return out[:count]


@compiled
def copy_gaussian(means: Array, covariances: Array, k: int, to_means: Array, to_covariances: Array, i: int) -> None:
    """Copy mean and covariance k to place i (in loops: compiled, assigning slices takes five times as long)."""
    size = means.shape[1]
    for a in range(size):
        to_means[i, a] = means[k, a]
        for b in range(size):
            to_covariances[i, a, b] = covariances[k, a, b]
