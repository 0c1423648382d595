"""Compiled order, choice and copies of array elements.

NumPy's own functions and assignments of slices do the same in compiled code, but numba compiles their general forms
anew at every place: half a second each.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled

# Keys that are sorted by insertion, before sorted parts are merged.
RUN = 16


@compiled
def stable_order(keys: NDArray[Any]) -> Integers:
    """Return the indices that sort keys (n,), equal ones in their order, NaN last: `np.argsort` by merging."""
    count, place = len(keys), 1
    order, other = np.arange(count), np.empty(count, dtype=np.int64)
    while place < count and not _precedes(keys[place], keys[place - 1]):
        place += 1
    # most often the keys are in order
    width = RUN if place < count else count
    for end in range(place, count):
        place = end
        while place % RUN > 0 and _precedes(keys[end], keys[order[place - 1]]):
            order[place] = order[place - 1]
            place -= 1
        order[place] = end
    while width < count:
        for start in range(0, count, 2 * width):
            middle, end = min(start + width, count), min(start + 2 * width, count)
            left, right = start, middle
            for place in range(start, end):
                if left < middle and (right >= end or not _precedes(keys[order[right]], keys[order[left]])):
                    other[place] = order[left]
                    left += 1
                else:
                    other[place] = order[right]
                    right += 1
        order, other = other, order
        width *= 2
    return order


@compiled
def _precedes(one: float, other: float) -> bool:
    """Whether a key comes before another one; NaN is the last."""
    # only NaN differs from itself
    return one < other or (other != other and one == one)


@compiled
def largest(keys: Array, count: int) -> NDArray[np.bool_]:
    """Return which keys (n,) are the `count` largest, the first of equal ones; NaN counts as the smallest.

    The time is proportional to n: the largest ones are not brought in order (C. A. R. Hoare's "Find", 1961).
    """
    chosen = np.zeros(len(keys), dtype=np.bool_)
    if count <= 0:
        return chosen
    values = np.empty(len(keys))
    for i in range(len(keys)):
        # only NaN differs from itself
        values[i] = keys[i] if keys[i] == keys[i] else -np.inf
    least = _nth_largest(values, count) if count < len(keys) else -np.inf
    equal = count
    for i in range(len(keys)):
        chosen[i] = keys[i] > least
        equal -= 1 if chosen[i] else 0
    for i in range(len(keys)):
        if equal > 0 and not chosen[i] and (keys[i] == least or least == -np.inf):
            chosen[i] = True
            equal -= 1
    return chosen


@compiled
def _nth_largest(values: Array, nth: int) -> float:
    """Return the nth largest of values (n,) without NaN, 1 <= nth <= n; their order changes."""
    begin, end, place = 0, len(values) - 1, nth - 1
    while begin < end:
        one, two, three = values[begin], values[(begin + end) // 2], values[end]
        pivot = max(min(one, two), min(max(one, two), three))
        left, right = begin, end
        while left <= right:
            while values[left] > pivot:
                left += 1
            while values[right] < pivot:
                right -= 1
            if left <= right:
                values[left], values[right] = values[right], values[left]
                left += 1
                right -= 1
        if place <= right:
            end = right
        elif place >= left:
            begin = left
        else:
            break
    return float(values[place])


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
def group(keys: Integers) -> tuple[Integers, int]:
    """Number equal keys alike: the number of each key (n,) in order of the keys, and how many there are."""
    order = stable_order(keys)
    member = np.empty(len(keys), dtype=np.int64)
    count = 0
    for i in range(len(keys)):
        if i > 0 and keys[order[i]] != keys[order[i - 1]]:
            count += 1
        member[order[i]] = count
    return member, count + 1 if len(keys) > 0 else 0


@compiled
def copy_gaussian(means: Array, covariances: Array, k: int, to_means: Array, to_covariances: Array, i: int) -> None:
    """Copy mean and covariance k to place i (in loops: compiled, assigning slices takes five times as long)."""
    size = means.shape[1]
    for a in range(size):
        to_means[i, a] = means[k, a]
        for b in range(size):
            to_covariances[i, a, b] = covariances[k, a, b]
