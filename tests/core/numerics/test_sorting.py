"""Order, choice and places of array elements, beside NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.numerics.sorting import RUN, picked, places, stable_order


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


def test_picked_and_places() -> None:
    values = np.array([3.0, 1.0, 2.0])
    np.testing.assert_array_equal(picked(values, np.array([2, 2, 0])), [2.0, 2.0, 3.0])
    np.testing.assert_array_equal(places(values > 1.5), [0, 2])
    assert len(places(values > 5.0)) == 0
