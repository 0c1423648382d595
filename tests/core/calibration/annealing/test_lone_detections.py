"""Detections that stand alone in their camera."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.calibration.annealing.rejected import lone

# Two cameras in turn, eight frames each: events 0, 2, ... are of camera 0.
OF_EVENT = np.tile([0, 1], 8)


def found(frames_of_camera_0: list[int], p_detect: float = 0.9) -> list[bool]:
    """Which detections of camera 0 are lone, where camera 1 detects the object in every frame."""
    events = np.sort(np.concatenate([2 * np.array(frames_of_camera_0), np.arange(1, 16, 2)]))
    out = lone(np.zeros(len(events), dtype=np.int64), events, OF_EVENT, np.array([p_detect, p_detect]))
    assert not out[events % 2 == 1].any()
    return out[events % 2 == 0].tolist()


@pytest.mark.parametrize(
    ("frames", "p_detect", "expected"),
    [
        ([4], 0.9, [True]),
        ([4, 5], 0.9, [False, False]),
        ([2, 4], 0.9, [False, False]),  # one miss is likely enough
        ([2, 5], 0.9, [True, True]),  # two are not
        ([2, 5], 0.6, [False, False]),  # with such a detector they are
        ([0], 0.9, [False]),  # nothing was missed before the first frame
        ([7], 0.9, [False]),  # nor after the last one
        ([1, 6, 7], 0.9, [False, False, False]),
        ([3], 1.0, [True]),
        ([3, 4], 1.0, [False, False]),
    ],
)
def test_a_detection_is_lone_where_too_many_are_missed_on_either_side(
    frames: list[int], p_detect: float, expected: list[bool]
) -> None:
    assert found(frames, p_detect) == expected


def test_other_trajectories_and_cameras_are_no_company() -> None:
    """Detections of frame 4 of camera 0, of two trajectories, and of camera 1."""
    trajectories, events = np.array([0, 0, 1]), np.array([8, 9, 8])
    assert lone(trajectories, events, OF_EVENT, np.array([0.9, 0.9])).tolist() == [True, True, True]


@pytest.mark.parametrize(("seen_by_third", "expected"), [(4, False), (5, False), (6, True), (None, True)])
def test_two_other_cameras_confirm_a_detection(seen_by_third: int | None, expected: bool) -> None:
    """Camera 0 detects the object in frame 4 alone, camera 1 in every frame, and camera 2 in one or none."""
    of_event = np.tile([0, 1, 2], 10)
    events = [12, *range(1, 30, 3)] + ([] if seen_by_third is None else [3 * seen_by_third + 2])
    events = np.sort(np.array(events))
    out = lone(np.zeros(len(events), dtype=np.int64), events, of_event, np.array([0.9, 0.9, 0.1]))
    assert out[events == 12].tolist() == [expected]


def test_the_order_of_cameras_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    of_event = rng.integers(0, 2, 60)
    events = np.sort(rng.choice(60, 25, replace=False))
    p_detect = np.array([0.8, 0.95])
    plain = lone(np.zeros(25, dtype=np.int64), events, of_event, p_detect)
    turned = lone(np.zeros(25, dtype=np.int64), events, 1 - of_event, p_detect[::-1])
    np.testing.assert_array_equal(plain, turned)
    assert 0 < plain.sum() < 25


def test_no_detections() -> None:
    nothing = np.empty(0, dtype=np.int64)
    assert lone(nothing, nothing, OF_EVENT, np.array([0.9, 0.9])).shape == (0,)
