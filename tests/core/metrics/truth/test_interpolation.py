"""Times and truth: grids, gaps, interpolation, and which cameras saw what."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.truth.interpolation import (
    Events,
    Truth,
    add_truth_times,
    align_truth,
    fitted_velocities,
    last_event_of_each_time,
)
from stereophd.core.metrics.truth.scored import Sightings, cameras_that_saw, leave_out_unseen


def truth_of(*objects: tuple[int, list[float], list[float]]) -> Truth:
    """Objects that move along x: (identity, times, values of x)."""
    time = np.concatenate([times for _, times, _ in objects]).astype(float)
    label = np.concatenate([np.full(len(times), identity) for identity, times, _ in objects])
    x = np.concatenate([values for _, _, values in objects]).astype(float)
    return Truth(time, label, np.stack([x, -x, 2 * x], axis=1))


def test_the_last_event_of_a_time_counts():
    times = np.array([0.0, 0.0, 1.0, 1.0 + 5e-10, 2.0])
    assert last_event_of_each_time(times).tolist() == [1, 3, 4]
    assert last_event_of_each_time(times[:0]).tolist() == []


def test_truth_times_stand_in_for_events_without_estimates():
    events = Events(np.array([1.0, 3.0 + 1e-10]), np.array([0, 2]), np.array([2, 3]))
    full = add_truth_times(events, np.array([3.0, 0.0, 1.0, 2.0, 0.0]))
    assert full.time_s == pytest.approx([0, 1, 2, 3])
    assert (full.row_end - full.row_start).tolist() == [0, 2, 0, 1]
    off_grid = Events(np.array([1.0, 2.5]), np.array([0, 2]), np.array([2, 3]))
    assert add_truth_times(off_grid, np.array([0.0, 1.0, 2.0, 3.0])).time_s.tolist() == [1.0, 2.5]
    none = Events(np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    assert add_truth_times(none, np.array([0.0, 1.0])).time_s.tolist() == [0.0, 1.0]


def test_objects_exist_from_their_first_to_their_last_row():
    truth = truth_of((4, [0, 1, 2], [0, 10, 30]), (7, [1, 2, 3], [5, 5, 5]), (9, [2], [1]))
    aligned = align_truth(truth, np.array([-1.0, 0.0, 0.5, 1.5, 2.0, 2.5, 3.0, 3.5]), 1.5)
    labels = [aligned.points.label[aligned.points.scan == i].tolist() for i in range(8)]
    assert labels == [[], [4], [4], [4, 7], [4, 7, 9], [7], [7], []]
    assert aligned.outside.tolist() == [True] + [False] * 6 + [True]
    assert not aligned.gap.any()
    of_4 = aligned.points.label == 4
    assert aligned.points.position[of_4, 0] == pytest.approx([0, 5, 20, 30])
    # by rows: 10, (10 + 20) / 2 from both neighbours, 20
    assert aligned.points.velocity[of_4, 0] == pytest.approx([10, 12.5, 17.5, 20])
    assert np.isnan(aligned.points.velocity[aligned.points.label == 9]).all()


def test_no_interpolation_across_a_gap():
    truth = truth_of((1, [0, 1, 4, 5], [0, 1, 4, 6]), (2, [0, 1, 2, 3, 4, 5], [9] * 6))
    times = np.array([0.5, 1.0, 1.0 + 5e-10, 2.0, 3.999, 4.0, 4.5])
    aligned = align_truth(truth, times, truth.step_s * 1.5)
    assert aligned.gap.tolist() == [False, False, False, True, True, False, False]
    # On the row before the gap the velocity is that of the segment that ends there.
    of_1 = aligned.points.velocity[aligned.points.label == 1, 0]
    assert of_1[[0, 1, 2, 5, 6]] == pytest.approx([1, 1, 1, 2, 2])
    assert not align_truth(truth, times, 3.0).gap.any()


def test_given_velocities_are_interpolated():
    truth = truth_of((1, [0, 2], [0, 8]))
    truth = Truth(truth.time_s, truth.object_id, truth.position, np.array([[1.0, 0, 0], [3.0, 0, 6]]))
    assert align_truth(truth, np.array([0.5]), 5.0).points.velocity[0] == pytest.approx([1.5, 0, 1.5])


@settings(max_examples=80)
@given(seed=st.integers(0, 10_000), objects=st.integers(1, 5))
def test_positions_are_those_of_numpy_interp(seed, objects):
    random = np.random.default_rng(seed)
    rows = []
    for identity in range(objects):
        times = np.unique(random.uniform(0, 10, random.integers(1, 8)).round(2))
        rows.append((identity, times.tolist(), random.normal(size=len(times)).tolist()))
    truth = truth_of(*rows)
    times = np.sort(np.concatenate([random.uniform(-1, 11, 20), truth.time_s]))
    points = align_truth(truth, times, np.inf).points
    for identity, known, x in rows:
        mine = points.label == identity
        expected = times[(times >= known[0]) & (times <= known[-1])]
        assert (times[points.scan[mine]] == expected).all()
        assert points.position[mine, 0] == pytest.approx(np.interp(expected, known, x), abs=1e-12)


@settings(max_examples=80)
@given(seed=st.integers(0, 10_000), labelled=st.booleans())
def test_counts_of_cameras_against_all_pairs(seed, labelled):
    random = np.random.default_rng(seed)
    # A coarse grid, so that detections fall on the ends of the interval.
    detections = Sightings(
        random.integers(0, 40, 30) * 0.1,
        random.integers(0, 3, 30),
        random.integers(-1, 3, 30) if labelled else None,
    )
    times, objects = random.integers(0, 45, 25) * 0.1, random.integers(0, 3, 25)
    found = cameras_that_saw(detections, times, objects, 0.3)
    for time, label, count in zip(times, objects, found, strict=True):
        near = (detections.time_s <= time + 1e-9) & (detections.time_s >= time - 0.3 - 1e-9)
        if detections.object_id is not None:
            near &= detections.object_id == label
        assert count == len(set(detections.camera[near].tolist()))


def sets_of(*scans: list[float]) -> PointSets:
    """Points on the x axis."""
    x = np.array([value for scan in scans for value in scan], dtype=float)
    start = np.concatenate([[0], np.cumsum([len(scan) for scan in scans])]).astype(np.int64)
    zeros = np.zeros_like(x)
    return PointSets(start, np.stack([x, zeros, zeros], axis=1), np.zeros((len(x), 3)), np.arange(len(x)))


def test_unseen_objects_go_with_their_estimates():
    truth = sets_of([0, 100], [0], [0], [])
    estimates = sets_of([1, 101], [1], [50], [])
    seen = np.array([True, False, False, False])
    left_estimates, left_truth, emptied = leave_out_unseen(estimates, truth, seen, 2.0, 20.0, mahalanobis=False)
    # Scan 1 had nothing but an unseen object; the far estimate of scan 2 is false all the same; scan 3 had
    # nothing to lose.
    assert left_truth.counts.tolist() == [1, 0, 0, 0]
    assert left_estimates.position[:, 0].tolist() == [1, 50]
    assert emptied.tolist() == [False, True, False, False]


def test_rows_of_several_cameras_a_millisecond_apart_give_the_velocity_of_the_object() -> None:
    """A board at 0.09 m/s, its place known to 2 mm, seen by four cameras 1 ms apart, ten times a second."""
    rng = np.random.default_rng(0)
    time_s = (np.arange(50)[:, None] / 10.0 + np.arange(4) * 1e-3).ravel()
    position = np.zeros((200, 3))
    position[:, 0] = 0.09 * time_s
    position += rng.normal(0.0, 0.002, position.shape)
    truth = Truth(time_s, np.zeros(200, dtype=np.int64), position)
    velocity = align_truth(truth, time_s, 0.15).points.velocity
    # twelve rows over 0.2 s: 0.002 / sqrt(sum of squared times) = 0.007 m/s
    assert np.sqrt(((velocity - [0.09, 0.0, 0.0]) ** 2).mean()) < 0.012


def test_velocities_do_not_reach_over_a_gap() -> None:
    truth = truth_of((4, [0.0, 0.1, 5.0, 5.1, 9.0], [0.0, 1.0, 100.0, 102.0, 7.0]))
    assert fitted_velocities(truth, 0.2)[:, 0] == pytest.approx([10, 10, 20, 20, np.nan], nan_ok=True)
