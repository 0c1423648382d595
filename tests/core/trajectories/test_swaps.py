"""Smoothed tracks that choose their detections anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from stereophd.core.disparity.events import Event, make_event
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.trajectories import swaps
from stereophd.core.trajectories.chain import NONE, Chain, WholeRun, make_chain, make_run
from stereophd.core.trajectories.smoothing import Trajectory, smooth
from stereophd.core.trajectories.swaps import choose_anew
from tests.scenes import build_camera

MOTION = ConstantVelocity([0.3, 0.3, 0.3])
RATE, FRAMES = 6.0, 16


def _camera(number: int, readout_s: float = 0.0) -> Camera:
    angle = 0.9 * number
    turn = rotation_from_vector([0.0, angle, 0.0]).T
    center = np.array([0.0, 0.0, 1.0]) - turn[2]
    return build_camera(f"cam{number}", center, turn, size=(1280, 720), noise=0.7, clutter=0.05, readout_s=readout_s)


CAMERAS = tuple(_camera(k) for k in range(3))
STARTS = np.array([[0.0, 0.0, 1.0], [0.05, 0.0, 1.0], [0.0, 0.05, 1.0], [0.05, 0.05, 1.0]])
VELOCITY = np.array([0.08, 0.02, -0.05])


def _at(track: int, time_s: float) -> np.ndarray:
    """Position of a corner that moves along a curve."""
    return np.asarray(STARTS[track] + VELOCITY * time_s + [0.0, 0.02 * np.sin(2.0 * time_s), 0.0])


def _one_agile(seed: int, motion: ConstantVelocity) -> Callable[[int, float], np.ndarray]:
    """Positions of corners that rest but for corner 3, which moves as stated."""
    rng = np.random.default_rng(100 + seed)
    step = motion.transition(1.0 / (RATE * len(CAMERAS)))
    states = [np.concatenate([STARTS[3], np.zeros(3)])]
    for _ in range(FRAMES * len(CAMERAS) - 1):
        states.append(step.matrix @ states[-1] + rng.multivariate_normal(np.zeros(6), step.noise))

    def at(track: int, time_s: float) -> np.ndarray:
        return states[round(time_s * RATE * len(CAMERAS))][:3] if track == 3 else STARTS[track]

    return at


def _scene(
    seed: int,
    cameras: Sequence[Camera] = CAMERAS,
    missed: float = 0.1,
    at: Callable[[int, float], np.ndarray] = _at,
) -> tuple[list[Event | None], list[dict[int, int]]]:
    """Frames of cameras one after another; detections of every corner, in random order, and whose they are."""
    rng = np.random.default_rng(seed)
    events: list[Event | None] = []
    own: list[dict[int, int]] = [{} for _ in STARTS]
    for number in range(FRAMES * len(cameras)):
        index, time_s = number % len(cameras), number / (RATE * len(cameras))
        camera = cameras[index]
        seen = np.flatnonzero(rng.random(len(STARTS)) >= missed)
        points = np.array([at(k, time_s) for k in seen]).reshape(-1, 3)
        pixels = camera.project(points)
        if camera.readout_s:
            late = camera.readout_s * pixels[:, 1] / camera.height
            pixels = camera.project(np.array([at(k, time_s + t) for k, t in zip(seen, late, strict=True)]))
        pixels = pixels + rng.normal(0.0, 0.7, pixels.shape)
        event = make_event(camera, index, time_s, pixels)
        assert event.pixels is not None
        for k, pixel in zip(seen.tolist(), pixels, strict=True):
            own[k][number] = int(np.argmin(np.linalg.norm(event.pixels - pixel, axis=1)))
        events.append(event)
    return events, own


def _run(events: Sequence[Event | None], cameras: Sequence[Camera] = CAMERAS) -> WholeRun:
    return make_run(events, np.arange(len(events)) / (RATE * len(cameras)), cameras, MOTION)


def _tracks(run: WholeRun, own: Sequence[dict[int, int]]) -> list[Chain]:
    """Tracks smoothed from their detections, right or wrong."""
    out = []
    for k, places in enumerate(own):
        states = np.array([np.concatenate([_at(k, t), VELOCITY]) for t in run.times])
        wide = np.tile(np.diag([0.01] * 3 + [0.05] * 3) ** 2, (len(run.times), 1, 1))
        begin = Trajectory(k, np.arange(len(run.times)), run.times, states, wide, np.ones(len(run.times)))
        detections = np.full(len(run.times), NONE)
        for event, place in places.items():
            detections[event] = run.starts[event] + place
        out.append(make_chain(begin, detections, run).smoothed())
    return out


def _swapped(own: Sequence[dict[int, int]], one: int, other: int, events: Sequence[int]) -> list[dict[int, int]]:
    """Detections with those of two tracks exchanged at some events."""
    out = [dict(detections) for detections in own]
    for event in events:
        first, second = out[one].pop(event, None), out[other].pop(event, None)
        if second is not None:
            out[one][event] = second
        if first is not None:
            out[other][event] = first
    return out


def _squared_distances(track: Chain, positions: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances of a track from the positions (r, 3) of its object."""
    errors = track.trajectory.states[:, :3] - positions
    covariances = track.trajectory.covariances[:, :3, :3]
    return np.asarray(np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]))


def _found(tracks: Sequence[Chain]) -> list[dict[int, int]]:
    """Detections of tracks."""
    out = []
    for one in tracks:
        pairs = zip(one.trajectory.events.tolist(), one.detections.tolist(), strict=True)
        out.append({event: d - int(one.run.starts[event]) for event, d in pairs if d != NONE})
    return out


WRONG = {
    "one frame": [20],
    "every camera once": [21, 22, 23],
    "the first frames": [0, 1, 2],
    "the last frames": [46, 47],
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("wrong", WRONG)
def test_neighbours_that_were_swapped_change_back(wrong: str, seed: int) -> None:
    events, own = _scene(seed)
    given = _swapped(own, 0, 1, WRONG[wrong])
    run = _run(events)
    found, _ = choose_anew(_tracks(run, given), run)
    after = _found(found)
    for event in WRONG[wrong]:
        for k in range(4):
            assert after[k].get(event) == own[k].get(event)
    # and the path is where the corner was, by its covariance: beyond it one in a million
    for k, track in enumerate(found):
        assert _squared_distances(track, np.array([_at(k, t) for t in run.times])).max() < 30.7


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mixed", [(), (22, 23, 26)], ids=["at once", "little by little"])
def test_tracks_that_swapped_their_objects_for_good_change_back(mixed: tuple[int, ...], seed: int) -> None:
    events, own = _scene(seed)
    given = _swapped(own, 0, 1, sorted({*range(24, 48)} ^ {*mixed}))
    run = _run(events)
    after = _found(choose_anew(_tracks(run, given), run)[0])
    right = sum(after[k].get(event) == own[k].get(event) for k in range(4) for event in range(len(events)))
    # one in a thousand lies beyond the gate
    assert right >= 4 * len(events) - 2


@pytest.mark.parametrize("readout_s", [0.0, 0.03])
def test_tracks_that_are_right_stay_as_they_are(readout_s: float) -> None:
    cameras = tuple(_camera(k, readout_s) for k in range(3))
    events, own = _scene(5, cameras)
    run = _run(events, cameras)
    tracks = _tracks(run, own)
    found, stopped = choose_anew(tracks, run)
    assert not stopped.any()
    changes = sum(int((new.detections != old.detections).sum()) for new, old in zip(found, tracks, strict=True))
    # 4.1 of 10^3 detections of a correct track lie beyond the noise that it may give away: at most a few
    assert changes <= 2
    # at most 0.08 m/s^2 on one axis of three, 0.3 stated
    shown = {track.run.motion.noise_std[0] / MOTION.noise_std[0] for track in found}
    assert shown <= {0.0625, 0.125, 0.25}


def test_an_agile_object_among_resting_ones_is_as_certain_as_it_is() -> None:
    motion = ConstantVelocity([0.06, 0.06, 0.06])
    distances, shown = [], []
    for seed in range(5):
        at = _one_agile(seed, motion)
        events, own = _scene(seed, at=at)
        run = replace(_run(events), motion=motion)
        (resting, *_, agile), _ = choose_anew(_tracks(run, own), run)
        for k, track in ((0, resting), (3, agile)):
            shown.append(track.run.motion.noise_std[0] / motion.noise_std[0])
            distances.append(_squared_distances(track, np.array([at(k, t) for t in run.times])).mean())
    assert min(shown[1::2]) >= 0.5
    assert max(shown[::2]) <= 0.125
    # 3 in the mean of three dimensions, of a few independent ones a seed; one factor for all gives the agile 6.1
    assert 2.0 < np.mean(distances[1::2]) < 4.5
    assert np.mean(distances[::2]) < 4.5


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_detection_is_left_where_objects_seem_ten_times_as_agile_as_they_are(seed: int) -> None:
    # two of three cameras are right: only the noise of the motion that the tracks show tells which
    events, own = _scene(seed, missed=0.0)
    agile = replace(_run(events), motion=ConstantVelocity([3.0, 3.0, 3.0]))
    event, place = 25, own[1][25]
    detection = int(agile.starts[event]) + place
    points = agile.points.copy()
    points[detection] += 9.0 * np.sqrt(np.diagonal(agile.noises[detection]))
    run = replace(agile, points=points)
    (_, track, *_), _ = choose_anew(_tracks(run, own), run)
    assert track.detections[event] == NONE
    assert (track.detections != NONE).sum() >= len(events) - 2
    errors = track.trajectory.states[:, :3] - np.array([_at(1, t) for t in run.times])
    assert np.abs(errors).max() < 0.004


def test_no_detection_has_two_tracks() -> None:
    events, own = _scene(7)
    given = _swapped(_swapped(own, 0, 1, range(0, 9)), 2, 3, range(4, 12))
    run = _run(events)
    after = _found(choose_anew(_tracks(run, given), run)[0])
    for event in range(len(events)):
        held = [detections[event] for detections in after if event in detections]
        assert len(held) == len(set(held))


def test_it_says_where_the_bound_of_its_work_ended_it(monkeypatch: pytest.MonkeyPatch) -> None:
    events, own = _scene(7)
    run = _run(events)
    monkeypatch.setattr(swaps, "MOST_WORK", 2)
    found, stopped = choose_anew(_tracks(run, _swapped(own, 0, 1, range(0, 16))), run)
    # wherever a track still goes over from one object to the other
    holds_own = [(event, place == own[0].get(event)) for event, place in sorted(_found(found)[0].items())]
    turns = [event for (event, now), (_, then) in pairwise(holds_own) if now != then]
    assert turns
    assert stopped[turns].all()


@pytest.mark.parametrize("seed", range(3, 12))
def test_what_it_says_of_its_bound_is_near_to_what_stays_wrong(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    events, own = _scene(seed)
    run = _run(events)
    monkeypatch.setattr(swaps, "MOST_WORK", 1)
    found, stopped = choose_anew(_tracks(run, _swapped(own, 0, 1, range(0, 16))), run)
    holds_own = [(event, place == own[0].get(event)) for event, place in sorted(_found(found)[0].items())]
    for (event, now), (_, then) in pairwise(holds_own):
        assert now == then or stopped[max(event - 2, 0) : event + 3].any()


def test_a_track_takes_a_detection_that_nobody_has() -> None:
    events, own = _scene(2, missed=0.0)
    given = [dict(detections) for detections in own]
    for event in (0, 1, 24):
        del given[2][event]
    run = _run(events)
    after = _found(choose_anew(_tracks(run, given), run)[0])
    assert [after[2].get(event) for event in (0, 1, 24)] == [own[2][event] for event in (0, 1, 24)]


def test_predictions_of_a_grid_have_no_detections() -> None:
    events, own = _scene(3)
    events = [None if number == 10 else event for number, event in enumerate(events)]
    for detections in own:
        detections.pop(10, None)
    given = _swapped(own, 0, 1, [12])
    run = _run(events)
    after = _found(choose_anew(_tracks(run, given), run)[0])
    assert all(10 not in detections for detections in after)
    assert after[0].get(12) == own[0].get(12)


@pytest.mark.parametrize("seed", range(3))
def test_states_of_well_known_tracks_have_covariances(seed: int) -> None:
    # 0.07 px: with a prior of ten distances from the camera rounding left the first state none
    events, own = _scene(seed)
    run = _run(events)
    run = replace(run, motion=ConstantVelocity([0.03, 0.03, 0.03]), noises=0.01 * run.noises)
    for track in _tracks(run, own):
        stds = np.sqrt(np.diagonal(track.trajectory.covariances, axis1=1, axis2=2))
        correlations = track.trajectory.covariances / stds[:, :, None] / stds[:, None, :]
        assert np.linalg.eigvalsh(correlations).min() > 1e-3


def test_a_state_without_its_window_does_not_depend_on_the_detections_there() -> None:
    # the two filters together are the smoother of a track that never had those detections
    events, own = _scene(4, missed=0.0)
    run = _run(events)
    (chain, *_) = _tracks(run, own)
    place, width = 24, 0.5 / RATE
    states, covariances = chain.without_window(width)
    near = np.flatnonzero(np.abs(run.times - run.times[place]) < width)
    fewer = chain.detections.copy()
    fewer[near] = NONE
    other = replace(chain, detections=fewer)
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
    run = _run(events)
    (chain, *_) = _tracks(run, own)
    track = chain.trajectory
    means, priors = chain._prior(np.array([0]))
    mean, prior = means[0], priors[0]
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
            detection = chain.detections[k : k + 1]
            points, jacobians = run.project(np.array([event]), track.states[k][None], detection)
            row = np.zeros((2, 6 * count))
            row[:, 6 * k : 6 * k + 6] = jacobians[0]
            rows.append(row)
            errors.append(run.points[detection[0]] - points[0] - jacobians[0] @ (means[k] - track.states[k]))
            noises.append(run.noises[detection[0]])
    matrix, error = np.concatenate(rows), np.concatenate(errors)
    spread = matrix @ joint @ matrix.T
    for k, noise in enumerate(noises):
        spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += noise
    _, determinant = np.linalg.slogdet(2.0 * np.pi * spread)
    expected = -0.5 * float(error @ np.linalg.solve(spread, error)) - 0.5 * determinant
    assert chain.ahead[2] == pytest.approx(expected, abs=1e-4)


def test_a_pass_both_ways_is_the_smoother_of_rauch_tung_and_striebel() -> None:
    events, own = _scene(8)
    chain = _tracks(_run(events), own)[1]
    # about settled states another pass changes nothing but by rounding
    filtered, covariances, _ = chain.ahead
    expected = smooth(replace(chain.trajectory, states=filtered, covariances=covariances), MOTION)
    found = chain.smoothed().trajectory
    stds = np.sqrt(np.diagonal(expected.covariances, axis1=1, axis2=2))
    np.testing.assert_allclose(found.states, expected.states, atol=1e-6 * stds.max())
    np.testing.assert_allclose(found.covariances, expected.covariances, rtol=1e-5, atol=1e-9)


def test_the_gain_of_a_detection_is_its_likelihood_over_that_of_a_miss() -> None:
    events, own = _scene(9, missed=0.0)
    run = _run(events)
    (chain, *_) = _tracks(run, own)
    event, camera = 20, CAMERAS[20 % 3]
    state, covariance = chain.trajectory.states[event], chain.trajectory.covariances[event]
    gains = run.gains(event, state[None], covariance[None])[0]
    pixel = camera.project(state[None, :3])[0]
    steps = 1e-6 * np.eye(3)
    jacobian = np.stack([(camera.project((state[:3] + step)[None])[0] - pixel) / 1e-6 for step in steps], axis=1)
    spread = jacobian @ covariance[:3, :3] @ jacobian.T + 0.7**2 * np.eye(2)
    place = own[0][event]
    density = multivariate_normal(pixel, spread).pdf(run.points[run.starts[event] + place])
    clutter = 0.05 / (1280 * 720)
    assert gains[place] == pytest.approx(np.log(0.9 * density / (0.1 * clutter)), abs=1e-3)
    # the corners are 35 pixels apart
    assert np.isinf(np.delete(gains, place)).all()
    # of a track that follows nothing rounding may leave what is no covariance
    wrong = np.diag([-1e4, -1e4, -1e4, 1.0, 1.0, 1.0])
    assert np.isinf(run.gains(event, state[None], wrong[None])).all()
