"""The motion and the map of time from tracks to truth are found again."""

import numpy as np
import pytest

from stereophd.core.alignment.to_truth import align_to_truth
from stereophd.core.geometry.pose import rotation_from_vector, rotation_to_vector
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import Freedom, Registration, TrackedPlaces, register, stepped


def two_objects():
    """Two objects on curves, 30 s at 50 Hz, ten apart."""
    times = np.linspace(100.0, 130.0, 1501)
    one = np.column_stack([3.0 * np.sin(0.4 * times), 2.0 * np.cos(0.7 * times), 0.1 * (times - 115.0)])
    other = np.column_stack([10.0 + np.cos(0.5 * times), 2.0 * np.sin(0.3 * times), np.sin(0.9 * times)])
    return times, np.stack([one, other])


def as_truth(times, paths):
    return Truth(np.tile(times, 2), np.repeat([4, 7], len(times)), paths.reshape(-1, 3))


def estimates(times, positions, covariance=None, track_id=0):
    """Estimates of unit covariance, unless it is given."""
    return TrackedPlaces(
        times, positions, np.tile(np.eye(3), (len(times), 1, 1)) if covariance is None else covariance,
        np.broadcast_to(track_id, len(times)),
    )  # fmt: skip


def interpolated(times, paths, at):
    return np.stack([[np.interp(at, times, path[:, axis]) for axis in range(3)] for path in paths]).transpose(2, 0, 1)


@pytest.mark.parametrize("clock", [False, True], ids=["frame", "clock"])
@pytest.mark.parametrize("scale", [1.0, 1.07], ids=["rigid", "similarity"])
def test_frame_scale_and_clock_are_found(clock, scale):
    times, paths = two_objects()
    turn, move = rotation_from_vector(np.array([0.05, -0.1, 0.08])), np.array([0.6, -0.4, 0.9])
    shift, rate = (0.12, 1.0007) if clock else (0.0, 1.0)
    at = np.linspace(103.0, 127.0, 350)
    seen = interpolated(times, paths, 115.0 + shift + rate * (at - 115.0))
    tracks = (seen - move) @ turn / scale
    rng = np.random.default_rng(0)
    tracks[rng.random((350, 2)) < 0.1] += rng.normal(scale=1.5, size=3)
    seen = estimates(np.repeat(at, 2), tracks.reshape(-1, 3), track_id=np.tile([0, 1], 350))
    found = register(seen, as_truth(times, paths), 0.1, Freedom(True, scale != 1.0, clock)).registration
    np.testing.assert_allclose(found.rotation, turn, atol=2e-4)
    np.testing.assert_allclose(found.translation, move, atol=2e-3)
    assert found.scale == pytest.approx(scale, abs=1e-4)
    assert found.estimates > 650
    np.testing.assert_allclose(found.times(at), 115.0 + shift + rate * (at - 115.0), atol=2e-3)
    np.testing.assert_allclose(found.track_times(found.times(at)), at, atol=1e-9)


@pytest.mark.parametrize("clock", [False, True], ids=["frame", "clock"])
def test_tracks_of_several_objects_in_any_frame_are_aligned(clock):
    """Tracks of cameras from nothing, in the frame of a camera and a 13th as large, were aligned wrongly or not."""
    times, paths = two_objects()
    turn, move, shift = rotation_from_vector(np.array([1.4, -0.9, 0.8])), np.array([60.0, -40.0, 9.0]), 47.3 * clock
    at = np.linspace(103.0, 127.0, 350)
    seen = interpolated(times, paths, at) + np.random.default_rng(2).normal(0.0, 0.02, (350, 2, 3))
    tracks = ((seen - move) @ turn / 13.0).reshape(-1, 3)
    seen = estimates(np.repeat(at - shift, 2), tracks, np.tile(np.eye(3) * (0.02 / 13.0) ** 2, (700, 1, 1)),
                     np.tile([0, 1], 350))  # fmt: skip
    found = align_to_truth(seen, as_truth(times, paths), 0.1, Freedom(True, True, clock))
    np.testing.assert_allclose(found.registration.rotation, turn, atol=2e-3)
    np.testing.assert_allclose(found.registration.translation, move, atol=0.1)
    assert found.registration.scale == pytest.approx(13.0, rel=1e-3)
    assert found.misfit == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(found.registration.times(at - shift), at, atol=0.01)


def test_a_short_track_tells_objects_that_move_alike_from_each_other():
    """Tracks that begin near the wrong one stayed there, with a misfit of 1: most places were near an object."""
    times, paths = two_objects()
    paths[1] = paths[0] + [0.0, 8.0, 0.0]
    at = np.linspace(103.0, 127.0, 350)
    seen = interpolated(times, paths, at) + np.random.default_rng(2).normal(0.0, 0.02, (350, 2, 3))
    is_there = np.tile([True, False], 350) | (np.arange(700) < 100)
    tracks = (seen.reshape(-1, 3) + [0.1, 8.0, 0.2])[is_there]
    seen = estimates(np.repeat(at, 2)[is_there], tracks, np.tile(np.eye(3) * 0.02**2, (is_there.sum(), 1, 1)),
                     np.tile([0, 1], 350)[is_there])  # fmt: skip
    found = align_to_truth(seen, as_truth(times, paths), 0.1, Freedom())
    np.testing.assert_allclose(found.registration.translation, [-0.1, -8.0, -0.2], atol=0.02)


def test_places_that_one_camera_saw_hardly_count():
    # two fifths of the track miss the object by 30 in depth, and state a standard deviation of 5 along it
    times, paths = two_objects()
    rng = np.random.default_rng(1)
    tracks = paths[0] + rng.normal(scale=0.02, size=(len(times), 3))
    lost = (times > 112.0) & (times < 124.0)
    tracks[lost, 2] += 30.0
    covariance = np.tile(4e-4 * np.eye(3), (len(times), 1, 1))
    covariance[lost, 2, 2] = 25.0
    truth = Truth(times, np.zeros(len(times), dtype=np.int64), paths[0])
    found = register(estimates(times, tracks, covariance), truth, 0.1, Freedom(True, True, True))
    errors = [*rotation_to_vector(found.registration.rotation), found.registration.scale - 1.0]
    errors += [found.registration.shift_s, found.registration.rate - 1.0]
    assert (np.abs(errors) < 5.0 * found.std[[0, 1, 2, 6, 7, 8]]).all()
    assert (np.abs(errors) < [5e-3, 5e-3, 5e-3, 5e-3, 5e-3, 5e-4]).all()


def test_an_error_of_the_scale_does_not_pass_for_one_of_the_clock():
    # objects that go away from the cameras: places 3 % too far off look like a clock that is 3 % fast
    times = np.linspace(0.0, 60.0, 301)
    starts, speeds = np.array([[5.0, 0.0, 20.0], [-5.0, 1.0, 25.0]]), np.array([[0.2, 0.0, 1.0], [-0.2, 0.1, 1.2]])
    paths = starts[:, None] + speeds[:, None] * times[:, None]
    paths += 0.3 * np.sin(times[:, None] * [0.3, 0.5, 0.7])
    truth = Truth(np.tile(times, 2), np.repeat([0, 1], len(times)), paths.reshape(-1, 3))
    places = np.swapaxes(1.03 * paths, 0, 1).reshape(-1, 3)
    covariance = 1e-4 * np.eye(3) + 0.03**2 * places[:, :, None] * places[:, None]
    seen = estimates(np.repeat(times, 2), places, covariance, np.tile([0, 1], len(times)))
    found = register(seen, truth, 0.5, Freedom(True, False, True)).registration
    assert found.rate == pytest.approx(1.0, abs=3e-3)
    assert found.shift_s == pytest.approx(0.0, abs=0.2)


def test_one_object_needs_no_start():
    times, paths = two_objects()
    turn = rotation_from_vector(np.array([0.5, 1.2, -0.3]))
    tracks = (paths[0] - [40.0, -10.0, 5.0]) @ turn
    truth = Truth(times, np.zeros(len(times), dtype=np.int64), paths[0])
    found = register(estimates(times, tracks), truth, 0.1, Freedom()).registration
    np.testing.assert_allclose(found.positions(tracks), paths[0], atol=1e-6)


def test_what_a_straight_line_leaves_open_stays():
    times = np.linspace(0.0, 10.0, 101)
    path = times[:, None] * [1.0, 0.0, 0.0]
    truth = Truth(times, np.zeros(101, dtype=np.int64), path)
    found = register(estimates(times, path + [0.0, 0.3, 0.0]), truth, 0.2, Freedom()).registration
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(found.translation, [0.0, -0.3, 0.0], atol=1e-9)


def test_covariances_and_velocities_turn_and_scale():
    times, paths = two_objects()
    turn = rotation_from_vector(np.array([0.0, 0.0, 0.3]))
    truth = Truth(times, np.zeros(len(times), dtype=np.int64), paths[0])
    found = register(estimates(times, paths[0] @ turn / 2.0), truth, 0.1, Freedom(True, True)).registration
    velocity, covariance = np.array([[1.0, 2.0, 3.0]]), np.diag([1.0, 4.0, 9.0])[None]
    np.testing.assert_allclose(found.velocities(velocity), 2.0 * velocity @ turn.T, atol=1e-6)
    np.testing.assert_allclose(found.covariances(covariance)[0], 4.0 * turn @ covariance[0] @ turn.T, atol=1e-5)


def test_too_few_estimates():
    times, paths = two_objects()
    with pytest.raises(ValueError, match="6 or more estimates at times of the truth, found 0"):
        register(estimates(times - 500.0, paths[0]), as_truth(times, paths), 0.1, Freedom())


def test_estimates_that_shrink_to_a_point_are_refused():
    with pytest.raises(ValueError, match="a scale of 0"):
        stepped(Registration(np.eye(3), np.zeros(3), 1e-300, 0.0, 0.0, 1.0, 6), np.eye(9)[6] * -1e3, np.zeros(3), 6)
