"""Labels that an event detected, against their definition in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.multi.attribution import detected_labels


@pytest.mark.parametrize("seed", range(5))
def test_labels_detected_more_probably_than_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(-1, 20, 80)
    weights = rng.gamma(0.5, 0.5, 80)
    n_missed = int(rng.integers(30, 50))
    missed = np.arange(80) < n_missed
    expected = [
        label
        for label in range(20)
        if weights[(labels == label) & ~missed].sum() > weights[(labels == label) & missed].sum()
    ]
    assert detected_labels(labels, weights, n_missed).tolist() == expected
    assert 0 < len(expected) < 20


def test_no_components() -> None:
    assert len(detected_labels(np.empty(0, dtype=np.int64), np.empty(0), 0)) == 0
