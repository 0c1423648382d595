"""Smoothed tracks that choose their detections anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.trajectories.chains import Chain, WholeRun
from stereophd.core.trajectories.reassociation import reassociate
from stereophd.core.trajectories.smoothing import Trajectory

MOTION = ConstantVelocity([0.3, 0.3, 0.3])
RATE, FRAMES = 6.0, 16


def _camera(number: int, readout_s: float = 0.0) -> Camera:
    angle = 0.9 * number
    turn = rotation_from_vector([0.0, angle, 0.0]).T
    return Camera(
        name=f"cam{number}", width=1280, height=720, fx=700.0, fy=700.0, cx=639.5, cy=359.5, lens=Lens(),
        pose=Pose(turn, np.array([0.0, 0.0, 1.0]) - turn[2]), detector=Detector([0.7, 0.7], 0.9, 0.05),
        readout_s=readout_s,
    )  # fmt: skip


CAMERAS = tuple(_camera(k) for k in range(3))
STARTS = np.array([[0.0, 0.0, 1.0], [0.05, 0.0, 1.0], [0.0, 0.05, 1.0], [0.05, 0.05, 1.0]])
VELOCITY = np.array([0.08, 0.02, -0.05])


def _at(track: int, time_s: float) -> np.ndarray:
    """Position of a corner that moves along a curve."""
    return np.asarray(STARTS[track] + VELOCITY * time_s + [0.0, 0.02 * np.sin(2.0 * time_s), 0.0])


def _scene(
    seed: int, cameras: Sequence[Camera] = CAMERAS, missed: float = 0.1
) -> tuple[list[Event | None], list[dict[int, int]]]:
    """Frames of cameras one after another; detections of every corner, in random order, and whose they are."""
    rng = np.random.default_rng(seed)
    events: list[Event | None] = []
    own: list[dict[int, int]] = [{} for _ in STARTS]
    for number in range(FRAMES * len(cameras)):
        index, time_s = number % len(cameras), number / (RATE * len(cameras))
        camera = cameras[index]
        seen = np.flatnonzero(rng.random(len(STARTS)) >= missed)
        points = np.array([_at(k, time_s) for k in seen]).reshape(-1, 3)
        pixels = camera.project(points)
        if camera.readout_s:
            late = camera.readout_s * pixels[:, 1] / camera.height
            pixels = camera.project(np.array([_at(k, time_s + t) for k, t in zip(seen, late, strict=True)]))
        pixels = pixels + rng.normal(0.0, 0.7, pixels.shape)
        event = make_event(camera, index, time_s, pixels)
        assert event.pixels is not None
        for k, pixel in zip(seen.tolist(), pixels, strict=True):
            own[k][number] = int(np.argmin(np.linalg.norm(event.pixels - pixel, axis=1)))
        events.append(event)
    return events, own


def _tracks(events: Sequence[Event | None], own: Sequence[dict[int, int]], cameras: Sequence[Camera] = CAMERAS):
    """Tracks smoothed from their detections, right or wrong."""
    run = WholeRun(tuple(events), tuple(cameras), MOTION)
    times = np.array([event.time_s for event in events if event is not None])
    out = []
    for k, detections in enumerate(own):
        states = np.array([np.concatenate([_at(k, t), VELOCITY]) for t in times])
        wide = np.tile(np.diag([0.01] * 3 + [0.05] * 3) ** 2, (len(times), 1, 1))
        begin = Trajectory(k, np.arange(len(times)), times, states, wide, np.ones(len(times)))
        out.append(Chain(begin, dict(detections), run).smoothed().trajectory)
    return out


def _exchanged(own: Sequence[dict[int, int]], one: int, other: int, events: Sequence[int]) -> list[dict[int, int]]:
    """Detections with those of two tracks exchanged at some events."""
    out = [dict(detections) for detections in own]
    for event in events:
        first, second = out[one].pop(event, None), out[other].pop(event, None)
        if second is not None:
            out[one][event] = second
        if first is not None:
            out[other][event] = first
    return out


def _found(own: Sequence[dict[int, int]], found) -> list[dict[int, int]]:
    """Detections of tracks after the changes."""
    out = []
    for detections, track in zip(own, found, strict=True):
        new = dict(detections)
        for event, (before, after) in track.changed.items():
            assert new.pop(event, None) == before
            if after is not None:
                new[event] = after
        out.append(new)
    return out


WRONG = {
    "one frame": [20],
    "every camera once": [21, 22, 23],
    "the first frames": [0, 1, 2],
    "the last frames": [46, 47],
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("wrong", WRONG)
def test_neighbours_that_were_exchanged_change_back(wrong: str, seed: int) -> None:
    events, own = _scene(seed)
    given = _exchanged(own, 0, 1, WRONG[wrong])
    tracks = _tracks(events, given)
    found = reassociate(tracks, given, events, CAMERAS, MOTION)
    after = _found(given, found)
    for event in WRONG[wrong]:
        for k in range(4):
            assert after[k].get(event) == own[k].get(event)
    # and the path is where the corner was, by its covariance: beyond it one in a million
    for k, track in enumerate(found):
        errors = track.trajectory.states[:, :3] - np.array([_at(k, t) for t in tracks[0].times])
        covariances = track.trajectory.covariances[:, :3, :3]
        distances = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
        assert distances.max() < 30.7


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mixed", [(), (22, 23, 26)], ids=["at once", "little by little"])
def test_tracks_that_exchanged_their_objects_for_good_change_back(mixed: tuple[int, ...], seed: int) -> None:
    events, own = _scene(seed)
    given = _exchanged(own, 0, 1, sorted({*range(24, 48)} ^ {*mixed}))
    after = _found(given, reassociate(_tracks(events, given), given, events, CAMERAS, MOTION))
    right = sum(after[k].get(event) == own[k].get(event) for k in range(4) for event in range(len(events)))
    # one in a thousand lies beyond the gate
    assert right >= 4 * len(events) - 2


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_tracks_that_are_right_stay_as_they_are(readout_s: float) -> None:
    cameras = tuple(_camera(k, readout_s) for k in range(3))
    events, own = _scene(5, cameras)
    tracks = _tracks(events, own, cameras)
    found = reassociate(tracks, own, events, cameras, MOTION)
    changes = sum(len(track.changed) for track in found)
    # 4.1 of 10^3 detections of a correct track lie beyond the noise that it may give away: at most a few
    assert changes <= 2
    for track, given in zip(found, tracks, strict=True):
        if not track.changed:
            assert track.trajectory is given


def test_no_detection_has_two_tracks() -> None:
    events, own = _scene(7)
    given = _exchanged(_exchanged(own, 0, 1, range(0, 9)), 2, 3, range(4, 12))
    after = _found(given, reassociate(_tracks(events, given), given, events, CAMERAS, MOTION))
    for event in range(len(events)):
        held = [detections[event] for detections in after if event in detections]
        assert len(held) == len(set(held))


def test_a_track_takes_a_detection_that_nobody_has() -> None:
    events, own = _scene(2, missed=0.0)
    given = [dict(detections) for detections in own]
    for event in (0, 1, 24):
        del given[2][event]
    after = _found(given, reassociate(_tracks(events, given), given, events, CAMERAS, MOTION))
    assert [after[2].get(event) for event in (0, 1, 24)] == [own[2][event] for event in (0, 1, 24)]


def test_predictions_of_a_grid_have_no_detections() -> None:
    events, own = _scene(3)
    events = [None if number == 10 else event for number, event in enumerate(events)]
    for detections in own:
        detections.pop(10, None)
    times = np.array([number / (RATE * 3) for number in range(len(events))])
    run = WholeRun(tuple(events), CAMERAS, MOTION)
    tracks = []
    for k, detections in enumerate(own):
        states = np.array([np.concatenate([_at(k, t), VELOCITY]) for t in times])
        wide = np.tile(np.diag([0.01] * 3 + [0.05] * 3) ** 2, (len(times), 1, 1))
        begin = Trajectory(k, np.arange(len(times)), times, states, wide, np.ones(len(times)))
        tracks.append(Chain(begin, dict(detections), run).smoothed().trajectory)
    given = _exchanged(own, 0, 1, [12])
    after = _found(given, reassociate(tracks, given, events, CAMERAS, MOTION))
    assert all(10 not in detections for detections in after)
    assert after[0].get(12) == own[0].get(12)


def test_a_state_without_its_window_does_not_depend_on_the_detections_there() -> None:
    # the two filters together are the smoother of a track that never had those detections
    events, own = _scene(4, missed=0.0)
    (track, *_) = _tracks(events, own)
    run = WholeRun(tuple(events), CAMERAS, MOTION)
    place, width = 24, 0.5 / RATE
    states, covariances = Chain(track, own[0], run).without_window(width)
    near = np.flatnonzero(np.abs(track.times - track.times[place]) < width)
    fewer = {event: row for event, row in own[0].items() if event not in near}
    other = Chain(track, fewer, run)
    mean, spread, _ = other.ahead
    assert len(near) > 1
    expected = other.smoothed().trajectory
    np.testing.assert_allclose(states[place, :3], expected.states[place, :3], atol=2e-4)
    np.testing.assert_allclose(
        np.sqrt(np.diag(covariances[place])), np.sqrt(np.diag(expected.covariances[place])), rtol=0.05
    )
    assert mean.shape == states.shape
    assert spread.shape == covariances.shape


def test_the_log_likelihood_is_that_of_all_detections_at_once() -> None:
    # an independent computation: the joint Gaussian of all pixels, motion integrated out, linear about the states
    events, own = _scene(6)
    (track, *_) = _tracks(events, own)
    run = WholeRun(tuple(events), CAMERAS, MOTION)
    chain = Chain(track, own[0], run)
    mean, prior = chain._prior(0)
    count = len(track.times)
    means, joint = np.empty((count, 6)), np.zeros((6 * count, 6 * count))
    marginal = prior
    means[0], joint[:6, :6] = mean, prior
    for k in range(1, count):
        step = MOTION.transition(float(track.times[k] - track.times[k - 1]))
        means[k] = step.matrix @ means[k - 1] + step.drift
        marginal = step.matrix @ marginal @ step.matrix.T + step.noise
        across = step.matrix @ joint[6 * (k - 1) : 6 * k, : 6 * k]
        joint[6 * k : 6 * k + 6, : 6 * k], joint[: 6 * k, 6 * k : 6 * k + 6] = across, across.T
        joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = marginal
    rows, errors, noises = [], [], []
    for k, event in enumerate(track.events.tolist()):
        if event in own[0]:
            found = run.event(event)
            points, jacobians = run.pixels(event, track.states[k][None], 0.0)
            row = np.zeros((2, 6 * count))
            row[:, 6 * k : 6 * k + 6] = jacobians[0]
            rows.append(row)
            errors.append(found.points[own[0][event]] - points[0] - jacobians[0] @ (means[k] - track.states[k]))
            noises.append(found.covariances[own[0][event]])
    matrix, error = np.concatenate(rows), np.concatenate(errors)
    spread = matrix @ joint @ matrix.T
    for k, noise in enumerate(noises):
        spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += noise
    _, determinant = np.linalg.slogdet(2.0 * np.pi * spread)
    expected = -0.5 * float(error @ np.linalg.solve(spread, error)) - 0.5 * determinant
    assert chain.ahead[2] == pytest.approx(expected, abs=1e-4)
