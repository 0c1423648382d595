"""Labels that an event detected, and the detections of each, against their definition in plain NumPy."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from stereophd.core.multi.association.attribution import UNDECIDED, detected_labels


@pytest.mark.parametrize("seed", range(5))
def test_labels_detected_more_probably_than_not(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 20, 80)
    weights = rng.gamma(0.5, 0.5, 80)
    n_missed = int(rng.integers(30, 50))
    updated = rng.integers(0, 8, 80 - n_missed - 8)
    detections = np.concatenate([np.full(n_missed, -1), updated, np.arange(8)])
    missed = detections < 0
    expected, made = [], []
    for label in range(20):
        own = labels == label
        if weights[own & ~missed].sum() > weights[own & missed].sum():
            expected.append(label)
            sums = np.array([weights[own & (detections == j)].sum() for j in range(8)])
            made.append(int(sums.argmax()) if sums.max() > 0.5 * weights[own].sum() else UNDECIDED)
    found, by = detected_labels(labels, weights, n_missed, updated)
    assert found.tolist() == expected
    assert by.tolist() == made
    assert 0 < len(expected) < 20


def test_an_undecided_label_has_no_detection() -> None:
    # one missed, two detected, and the newborn of both detections
    labels, weights = np.array([3, 3, 3, 4, 5]), np.array([0.2, 0.35, 0.45, 0.9, 0.1])
    found, by = detected_labels(labels, weights, 1, np.array([0, 1]))
    assert found.tolist() == [3, 4, 5]
    assert by.tolist() == [UNDECIDED, 0, 1]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the memory as Linux states it")
def test_what_is_kept_does_not_keep_all_outcomes() -> None:
    """Filters keep the labels of dozens of events: slices of arrays of all outcomes would fill the memory."""
    count = 200_000
    labels, weights = np.arange(count) % 5, np.ones(count)
    before = resident_bytes()
    kept = [detected_labels(labels, weights, 0, np.zeros(count - 10, dtype=np.int64)) for _ in range(60)]
    assert all(found.tolist() == list(range(5)) for found, _ in kept)
    # two arrays of all labels for each event would be 192 MB
    assert resident_bytes() - before < 50e6


def resident_bytes() -> int:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")


def test_no_components() -> None:
    nothing = np.empty(0, dtype=np.int64)
    assert [len(found) for found in detected_labels(nothing, np.empty(0), 0, nothing)] == [0, 0]
