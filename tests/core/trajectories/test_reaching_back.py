"""Tracks that reach back to detections that the filter could not attribute."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.trajectories.chain import make_run
from stereophd.core.trajectories.reaching_back import reach_back
from stereophd.core.trajectories.smoothing import Trajectory
from tests import scenes

MOTION = ConstantVelocity([0.1, 0.1, 0.1])
VELOCITY = np.array([0.5, -0.2, 0.3])


def camera(name: str, x: float, clutter: float = 5.0, readout_s: float = 0.0) -> Camera:
    return scenes.build_camera(name, [x, 0.0, 0.0], size=(640, 480), focal=500.0, clutter=clutter, readout_s=readout_s)


CAMERAS = (camera("left", -1.0), camera("right", 1.0))


def position(time_s: float, start: tuple[float, float, float] = (0.5, 0.2, 10.0)) -> np.ndarray:
    return np.array(start) + time_s * VELOCITY


def known_from(event: int, count: int, start: tuple[float, float, float] = (0.5, 0.2, 10.0)) -> Trajectory:
    """A track that is known to a few millimetres from an event on; two events a tenth of a second."""
    events = np.arange(event, count)
    times = 0.1 * (events // 2)
    states = np.array([np.concatenate([position(t, start), VELOCITY]) for t in times])
    covariance = np.diag([1e-5, 1e-5, 1e-4, 1e-5, 1e-5, 1e-4])
    return Trajectory(3, events, times, states, np.tile(covariance, (len(events), 1, 1)), np.full(len(events), 0.9))


def frames(
    seen: Sequence[bool], cameras: Sequence[Camera] = CAMERAS, seed: int = 0, clutter: int = 5
) -> tuple[list[Event | None], np.ndarray]:
    """Events in which the object is detected where `seen` says so."""
    rng = np.random.default_rng(seed)
    out: list[Event | None] = []
    times = 0.1 * (np.arange(len(seen)) // 2)
    for number, time_s in enumerate(times):
        index = number % 2
        pixels = rng.uniform([0, 0], [640, 480], (clutter, 2))
        if seen[number]:
            row = cameras[index].project(position(time_s)[None])[0, 1]
            at = time_s + cameras[index].readout_s * row / 480
            pixels = np.concatenate([pixels, cameras[index].project(position(at)[None]) + rng.normal(0, 1, (1, 2))])
        out.append(make_event(cameras[index], index, float(time_s), pixels))
    return out, times


def begin(seen: Sequence[bool], first: int = 8, max_gap_s: float = 1.0, cameras: Sequence[Camera] = CAMERAS) -> int:
    events, times = frames(seen, cameras)
    return int(
        reach_back(known_from(first, 12), [], make_run(events, times, cameras, MOTION), max_gap_s).trajectory.events[0]
    )


def test_to_the_first_of_its_detections() -> None:
    assert begin([False] * 8 + [True] * 4) == 8
    assert begin([False] * 7 + [True] * 5) == 7
    assert begin([True] * 12) == 0
    # a miss in between is bridged, a long silence is not the object's
    assert begin([False] * 4 + [True, False, True, False] + [True] * 4) == 4
    assert begin([True] + [False] * 7 + [True] * 4) == 8


def test_not_further_than_the_gap() -> None:
    assert begin([True] * 12, max_gap_s=0.25) == 4


def test_the_detections_of_another_track_are_not_its_own() -> None:
    events, times = frames([True] * 12)
    other = known_from(0, 8)
    found = reach_back(known_from(8, 12), [other], make_run(events, times, CAMERAS, MOTION), 1.0)
    assert found.trajectory.events[0] == 8
    assert not len(found.detections)


def test_rows_that_are_read_later_see_the_object_further_on() -> None:
    # half a second from the first row to the last: the object crosses ten pixels, tens of standard deviations
    cameras = (camera("left", -1.0, readout_s=0.5), camera("right", 1.0, readout_s=0.5))
    assert begin([True] * 12, cameras=cameras) == 0
    events, times = frames([True] * 12, cameras)
    at_once = [None if e is None else Event(e.time_s, e.camera, e.points, e.covariances, e.areas) for e in events]
    assert reach_back(known_from(8, 12), [], make_run(at_once, times, cameras, MOTION), 1.0).trajectory.events[0] == 8


def test_states_are_predicted_back_with_their_uncertainty_and_probability() -> None:
    events, times = frames([False] * 4 + [True, False, True, False] + [True] * 4)
    track = known_from(8, 12)
    run = make_run(events, times, CAMERAS, MOTION)
    found = reach_back(track, [], run, 1.0)
    assert np.unique(run.event_of(found.detections)).tolist() == [4, 6]
    grown = found.trajectory
    np.testing.assert_allclose(grown.states[:, :3], [position(t) for t in grown.times], atol=1e-12)
    assert (np.linalg.eigvalsh(grown.covariances).min(axis=1) > 0.0).all()
    assert grown.covariances[0, 0, 0] > grown.covariances[4, 0, 0]
    assert (np.diff(grown.existence) >= 0.0).all()
    assert 0.5 < grown.existence[0] < track.existence[0]


@pytest.mark.parametrize("clutter", [0.0, 5.0])
def test_how_often_clutter_is_taken_for_it(clutter: float) -> None:
    # the object appears at event 8; a detection of clutter has to fall on its past within a few pixels
    cameras = (camera("left", -1.0, clutter), camera("right", 1.0, clutter))
    begins = []
    for seed in range(300):
        events, times = frames([False] * 8 + [True] * 4, cameras, seed, clutter=int(clutter))
        begins.append(
            reach_back(known_from(8, 12), [], make_run(events, times, cameras, MOTION), 1.0).trajectory.events[0]
        )
    # 5 / (640 480) per px^2, a gate of 29 px^2, of which only the innermost part convinces: below 5e-4 an event
    assert np.mean(np.array(begins) < 8) <= 0.01


def test_predictions_and_events_out_of_view_say_nothing() -> None:
    behind = scenes.build_camera("right", turn=np.diag([-1.0, 1.0, -1.0]), size=(640, 480), focal=500.0, clutter=5.0)
    cameras = (CAMERAS[0], behind)
    events, times = frames([False, False, True, False] + [False] * 4 + [True] * 4, (CAMERAS[0], CAMERAS[1]))
    # two misses of the left camera in between, none of the right one, which looks away
    found = reach_back(known_from(8, 12), [], make_run(events, times, cameras, MOTION), 1.0)
    assert found.trajectory.events[0] == 2
    nothing: list[Event | None] = [None] * 8
    assert (
        reach_back(
            known_from(8, 12), [], make_run(nothing + events[8:], times, cameras, MOTION), 1.0
        ).trajectory.events[0]
        == 8
    )
