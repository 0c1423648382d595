"""Which detections belong to the tracks of a filter."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.association import TRACK_GATE, matched
from tests.scenes import build_camera

EVENTS, OBJECTS = 40, 6


@pytest.mark.parametrize("inflation", [1.0, 2.0])
def test_states_are_assigned_to_detections_as_event_by_event(inflation: float) -> None:
    rng, left = np.random.default_rng(3), build_camera("left")
    cameras = (left, replace(left, name="right", detector=replace(left.detector, sigma=(2.0, 1.0))))
    events, frames = np.repeat(np.arange(EVENTS), rng.integers(0, OBJECTS, EVENTS)), []
    # pixels a few deviations from one another, so that tracks compete for detections
    pixels = np.array([400.0, 300.0]) + rng.uniform(0.0, 8.0, (len(events), 2))
    states = np.column_stack([left.unproject(pixels, np.full(len(events), 100.0)), np.zeros((len(events), 3))])
    for event in range(EVENTS):
        seen = np.array([400.0, 300.0]) + rng.uniform(0.0, 8.0, (int(rng.integers(0, OBJECTS)), 2))
        frames.append((event % 2, 0.1 * event, seen, None))
    scans = Scans.of(Recording.of(cameras, frames), cameras)
    expected = set[tuple[int, int]]()
    for event in range(EVENTS):
        rows, seen = np.flatnonzero(events == event), np.arange(scans.first[event], scans.first[event + 1])
        errors = (pixels[rows, None] - scans.points[seen]) / np.array(cameras[event % 2].detector.sigma)
        cost = np.minimum((errors**2).sum(axis=2) / inflation**2, TRACK_GATE)
        expected |= {
            (int(rows[i]), int(seen[j]))
            for i, j in zip(*linear_sum_assignment(cost), strict=True)
            if cost[i, j] < TRACK_GATE
        }
    found = matched(cameras, events, states, scans, inflation)
    assert set(zip(*map(np.ndarray.tolist, found), strict=True)) == expected
    assert len(expected) > EVENTS
