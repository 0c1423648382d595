"""Order, choice and places of array elements, beside NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.numerics.sorting import RUN, largest, picked, places, stable_order


@pytest.mark.parametrize("count", [0, 1, 2, RUN, RUN + 1, 3 * RUN, 100, 1000])
@pytest.mark.parametrize("kind", ["floats", "ties", "integers", "sorted"])
def test_stable_order(count: int, kind: str) -> None:
    rng = np.random.default_rng(count)
    keys = rng.normal(size=count)
    if kind == "ties":
        keys = np.round(keys)
        keys[rng.random(count) < 0.1] = np.nan
        keys[rng.random(count) < 0.1] = -np.inf
    elif kind == "integers":
        keys = rng.integers(-5, 5, count)
    elif kind == "sorted":
        keys = np.sort(keys)[::-1].copy()
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 30, 1000])
@pytest.mark.parametrize("kind", ["floats", "ties", "equal", "sorted", "infinities"])
def test_largest(count: int, kind: str) -> None:
    """The first in falling order, of equal ones the first, whatever number of them is asked for."""
    rng = np.random.default_rng(count)
    keys = rng.normal(size=count)
    if kind == "ties":
        keys = np.round(keys)
    elif kind == "equal":
        keys[:] = 3.0
    elif kind == "sorted":
        keys = np.sort(keys)
    elif kind == "infinities":
        keys[rng.random(count) < 0.3] = np.inf
        keys[rng.random(count) < 0.3] = -np.inf
    before = keys.copy()
    for most in {0, 1, 2, count // 3, count - 1, count, count + 5}:
        expected = np.zeros(count, dtype=bool)
        expected[np.argsort(-keys, kind="stable")[: max(most, 0)]] = True
        np.testing.assert_array_equal(largest(keys, most), expected)
    np.testing.assert_array_equal(keys, before)


def test_no_number_is_the_smallest() -> None:
    keys = np.array([np.nan, 1.0, np.nan, 3.0, -2.0])
    np.testing.assert_array_equal(largest(keys, 3), [False, True, False, True, True])
    np.testing.assert_array_equal(largest(keys, 4), [True, True, False, True, True])


def test_picked_and_places() -> None:
    values = np.array([3.0, 1.0, 2.0])
    np.testing.assert_array_equal(picked(values, np.array([2, 2, 0])), [2.0, 2.0, 3.0])
    np.testing.assert_array_equal(places(values > 1.5), [0, 2])
    assert len(places(values > 5.0)) == 0
