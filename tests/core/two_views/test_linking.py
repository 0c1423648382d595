"""Detections of one camera are linked in the image, and cut where the next one is ambiguous."""

import numpy as np
import pytest

from stereophd.core.two_views.linking import linked, nearest_of_frame


def frames_of(paths, times, seen=None):
    """Detections of paths (k, f, 2), in order of frames: first, points, and the object of each."""
    count, frames = paths.shape[:2]
    seen = np.ones((count, frames), dtype=bool) if seen is None else seen
    first, points, objects = [0], [], []
    for frame in range(frames):
        for k in np.flatnonzero(seen[:, frame]):
            points.append(paths[k, frame])
            objects.append(k)
        first.append(len(points))
    return np.array(first), np.array(points), np.array(objects)


def grid(frames, step):
    """Twelve corners 40 px apart that move together by `step` px a frame, on a curve."""
    corners = np.array([[u, v] for v in range(3) for u in range(4)]) * 40.0 + 200.0
    angle = np.linspace(0.0, 3.0, frames)
    way = np.cumsum(step * np.column_stack([np.cos(angle), np.sin(angle)]), axis=0)
    return corners[:, None] + way[None]


def test_corners_that_move_together_are_not_swapped():
    rng = np.random.default_rng(0)
    paths = grid(40, 9.0)
    seen = rng.random((12, 40)) < 0.9
    times = np.arange(40) / 6.0
    first, points, objects = frames_of(paths + rng.normal(scale=0.5, size=paths.shape), times, seen)
    tracks = linked(times, first, points, np.full(len(points), 0.5), 60.0)
    assert all(len(set(objects[rows].tolist())) == 1 for rows in tracks)
    assert sum(len(rows) for rows in tracks if len(rows) >= 8) > 0.7 * len(points)


def test_a_track_ends_where_two_objects_cross():
    times = np.arange(31) / 10.0
    along = np.column_stack([np.linspace(0.0, 300.0, 31), np.full(31, 100.0)])
    across = along[::-1] + [0.0, 2.0]
    first, points, objects = frames_of(np.stack([along, across]), times)
    tracks = [rows for rows in linked(times, first, points, np.full(len(points), 1.0), 50.0) if len(rows) >= 4]
    assert len(tracks) == 4
    assert all(len(set(objects[rows].tolist())) == 1 for rows in tracks)


@pytest.mark.parametrize(("gap", "tracks"), [(2, 1), (3, 2)])
def test_a_track_goes_on_over_two_missed_frames(gap, tracks):
    times = np.arange(20) / 10.0
    seen = np.ones((1, 20), dtype=bool)
    seen[0, 8 : 8 + gap] = False
    first, points, _ = frames_of(np.column_stack([10.0 * np.arange(20), np.zeros(20)])[None], times, seen)
    assert len(linked(times, first, points, np.ones(len(points)), 50.0)) == tracks


def test_no_detections():
    assert linked(np.arange(3.0), np.zeros(4, dtype=np.int64), np.empty((0, 2)), np.empty(0), 50.0) == []


@pytest.mark.parametrize("step", [1, 3, -2])
@pytest.mark.parametrize("size", [9.0, 1e3, 1e200])
def test_the_nearest_of_another_frame_is_that_of_all_distances(step, size):
    """Whole pixels lie at equal distances; a distance that overflows is none."""
    rng = np.random.default_rng(4)
    counts = rng.integers(0, 30, 12)
    frame, first = np.repeat(np.arange(12), counts), np.concatenate([[0], np.cumsum(counts)])
    points = rng.integers(0, 9, (len(frame), 2)) * (size / 9.0)
    points = points[np.lexsort((points[:, 0], frame))]
    asked, there = rng.random((2, len(frame))) < 0.8
    found = nearest_of_frame(first, points, step, asked, there)
    with np.errstate(over="ignore"):
        squares = ((points[:, None] - points) ** 2).sum(axis=2)
    squares[~(asked[:, None] & there & (frame[:, None] + step == frame))] = np.inf
    least = squares.min(axis=1)
    np.testing.assert_array_equal(found >= 0, np.isfinite(least))
    seen = np.flatnonzero(found >= 0)
    assert len(seen) > 20
    np.testing.assert_allclose(squares[seen, found[seen]], least[seen])
