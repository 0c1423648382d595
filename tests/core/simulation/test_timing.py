"""Schedules and windows: every instant once, in order, inside the run."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from stereophd.core.simulation.timing import INSTANTS_PER_WINDOW, Schedule, TimeGrid

SCHEDULES = st.builds(
    lambda rate, start, duration, phase: Schedule(rate, start, start + duration, phase),
    st.floats(0.2, 120.0),
    st.floats(-1000.0, 1000.0),
    st.floats(0.5, 60.0),
    st.floats(-2.0, 2.0),
)


@given(SCHEDULES, st.integers(1, 7))
def test_windows_of_a_schedule_hold_every_instant_once(schedule: Schedule, parts: int) -> None:
    whole_number, whole_time = schedule.window(schedule.start_s, schedule.end_s)
    edges = np.linspace(schedule.start_s, schedule.end_s, parts + 1)
    pieces = [schedule.window(low, high) for low, high in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate([number for number, _ in pieces]), whole_number)
    np.testing.assert_array_equal(np.concatenate([time for _, time in pieces]), whole_time)
    np.testing.assert_array_equal(whole_number, np.arange(whole_number.size))
    assert schedule.count() == whole_number.size
    assert (whole_time >= schedule.start_s).all()
    assert (whole_time < schedule.end_s).all()
    np.testing.assert_allclose(np.diff(whole_time), 1 / schedule.rate_hz, atol=3e-9)


def test_instants_are_start_plus_phase_plus_multiples_of_the_period() -> None:
    number, time = Schedule(25.0, 100.0, 101.0, phase_s=0.013).window(100.0, 101.0)
    np.testing.assert_array_equal(number, np.arange(25))
    np.testing.assert_allclose(time, 100.013 + np.arange(25) / 25, atol=1e-9)


def test_negative_phase_leaves_out_the_instants_before_the_start() -> None:
    number, time = Schedule(10.0, 5.0, 6.0, phase_s=-0.25).window(-np.inf, np.inf)
    np.testing.assert_array_equal(number, np.arange(10))
    np.testing.assert_allclose(time, 5.05 + np.arange(10) / 10, atol=1e-9)


def test_cameras_of_30_and_60_hz_share_their_instants_exactly() -> None:
    grid = TimeGrid((Schedule(30.0, 0.0, 100.0), Schedule(60.0, 0.0, 100.0)))
    assert grid.times(0.0, 100.0).size == 6000
    assert grid.frame_count() == 9000


@given(st.lists(st.floats(0.2, 120.0), min_size=1, max_size=4), st.floats(0.5, 300.0))
def test_windows_of_a_grid_are_contiguous_and_bounded(rates: list[float], duration: float) -> None:
    grid = TimeGrid(tuple(Schedule(rate, 7.0, 7.0 + duration) for rate in rates), Schedule(33.0, 7.0, 7.0 + duration))
    windows = list(grid.windows())
    assert windows[0][0] == 7.0
    assert windows[-1][1] == grid.end_s == round(7.0 + duration, 9)
    assert all(before[1] == after[0] for before, after in pairwise(windows))
    times = [grid.times(*window) for window in windows]
    np.testing.assert_array_equal(np.concatenate(times), grid.times(7.0, grid.end_s))
    assert max(part.size for part in times) <= INSTANTS_PER_WINDOW + len(rates) + 1


def test_truth_has_its_own_rate_or_every_distinct_frame_time() -> None:
    frames = (Schedule(10.0, 0.0, 1.0), Schedule(10.0, 0.0, 1.0, 0.05))
    np.testing.assert_allclose(TimeGrid(frames).truth_times(0.0, 1.0), np.arange(20) / 20, atol=1e-9)
    own = TimeGrid(frames, Schedule(4.0, 0.0, 1.0))
    np.testing.assert_allclose(own.truth_times(0.0, 1.0), [0.0, 0.25, 0.5, 0.75])
    assert np.isin(own.truth_times(0.0, 1.0), own.times(0.0, 1.0)).all()
