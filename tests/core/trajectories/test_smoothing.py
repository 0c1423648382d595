"""The smoother against the batch solution, its extension back, and stitching."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.trajectories.joins import stitch
from stereophd.core.trajectories.smoothing import Trajectory, extend_back, smooth

MOTION = ConstantVelocity([0.3, 0.1, 0.5])
OBSERVE = np.eye(3, 6)
NOISE = np.diag([0.04, 0.09, 0.25])


def simulated(times: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """True states (k, 6) and noisy positions (k, 3) of one object."""
    states = [rng.normal(0.0, [5, 5, 5, 1, 1, 1])]
    for before, after in pairwise(times):
        matrix, noise, _ = MOTION.transition(after - before)
        states.append(matrix @ states[-1] + rng.multivariate_normal(np.zeros(6), noise, method="svd"))
    truth = np.array(states)
    return truth, truth[:, :3] + rng.multivariate_normal(np.zeros(3), NOISE, len(times))


def filtered(times: Array, positions: Array, prior: Array) -> Trajectory:
    """Kalman filter from a zero-mean prior (6, 6)."""
    mean, covariance = np.zeros(6), prior
    means, covariances = [], []
    for k, position in enumerate(positions):
        if k:
            matrix, noise, _ = MOTION.transition(times[k] - times[k - 1])
            mean, covariance = matrix @ mean, matrix @ covariance @ matrix.T + noise
        gain = covariance @ OBSERVE.T @ np.linalg.inv(OBSERVE @ covariance @ OBSERVE.T + NOISE)
        mean = mean + gain @ (position - OBSERVE @ mean)
        covariance = covariance - gain @ OBSERVE @ covariance
        means.append(mean)
        covariances.append(covariance)
    count = len(times)
    return Trajectory(0, np.arange(count), times, np.array(means), np.array(covariances), np.ones(count))


def batch(times: Array, positions: Array, prior: Array) -> tuple[Array, Array]:
    """All states at once from the joint Gaussian: the definition that smoothing must meet."""
    count = len(times)
    information = np.zeros((6 * count, 6 * count))
    vector = np.zeros(6 * count)
    information[:6, :6] += np.linalg.inv(prior)
    for k, position in enumerate(positions):
        here = slice(6 * k, 6 * k + 6)
        information[here, here] += OBSERVE.T @ np.linalg.inv(NOISE) @ OBSERVE
        vector[here] += OBSERVE.T @ np.linalg.inv(NOISE) @ position
        if k:
            matrix, noise, _ = MOTION.transition(times[k] - times[k - 1])
            step = np.concatenate([-matrix, np.eye(6)], axis=1)
            both = slice(6 * k - 6, 6 * k + 6)
            information[both, both] += step.T @ np.linalg.inv(noise) @ step
    covariance = np.linalg.inv(information)
    means = (covariance @ vector).reshape(count, 6)
    blocks = np.array([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(count)])
    return means, blocks


def test_smoothing_is_the_batch_solution() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.1, 0.9, 25))
    _, positions = simulated(times, rng)
    prior = np.diag([25.0] * 3 + [1.0] * 3)
    smoothed = smooth(filtered(times, positions, prior), MOTION)
    means, covariances = batch(times, positions, prior)
    np.testing.assert_allclose(smoothed.states, means, atol=1e-8)
    np.testing.assert_allclose(smoothed.covariances, covariances, atol=1e-8)


def test_events_at_one_time_share_one_state() -> None:
    rng = np.random.default_rng(4)
    times = np.repeat(np.arange(6.0), 2)
    _, positions = simulated(times, rng)
    smoothed = smooth(filtered(times, positions, np.diag([25.0] * 3 + [1.0] * 3)), MOTION)
    np.testing.assert_allclose(smoothed.states[::2], smoothed.states[1::2], atol=1e-9)
    np.testing.assert_allclose(smoothed.covariances[::2], smoothed.covariances[1::2], atol=1e-9)


def test_smoothed_covariances_are_honest() -> None:
    """Mean NEES of 200 tracks of 30 states: 6 within three standard errors of independent tracks (0.25)."""
    rng = np.random.default_rng(5)
    times = np.arange(30.0)
    prior = np.diag([25.0] * 3 + [1.0] * 3)
    means = []
    for _ in range(200):
        truth, positions = simulated(times, rng)
        smoothed = smooth(filtered(times, positions, prior), MOTION)
        error = smoothed.states[:10:3] - truth[:10:3]
        solved = np.linalg.solve(smoothed.covariances[:10:3], error[..., None])[..., 0]
        means.append(np.mean(np.sum(error * solved, axis=1)))
    standard_error = np.std(means) / np.sqrt(len(means))
    assert standard_error < 0.3
    assert np.mean(means) == pytest.approx(6.0, abs=3.0 * standard_error)


def test_extension_back_is_a_prediction_backwards() -> None:
    states = np.array([[1.0, 2.0, 3.0, 0.5, 0.0, -1.0]])
    track = Trajectory(7, np.array([4]), np.array([2.0]), states, np.eye(6)[None], np.array([0.9]))
    longer = extend_back(track, np.array([2, 3]), np.array([0.0, 1.0]), MOTION)
    np.testing.assert_array_equal(longer.events, [2, 3, 4])
    np.testing.assert_allclose(longer.states[0], [0.0, 2.0, 5.0, 0.5, 0.0, -1.0])
    assert longer.covariances[0, 0, 0] > longer.covariances[1, 0, 0] > longer.covariances[2, 0, 0]
    np.testing.assert_array_equal(longer.existence, [0.9, 0.9, 0.9])


class TestStitching:
    @staticmethod
    def piece(track_id: int, start: float, end: float, state_at_start: list[float]) -> Trajectory:
        times = np.array([start, end])
        first = np.array(state_at_start, dtype=float)
        last = ConstantVelocity([0.0] * 3).transition(end - start)[0] @ first
        covariances = np.repeat(np.diag([0.01] * 6)[None], 2, axis=0)
        events = np.round(10 * times).astype(int)
        return Trajectory(track_id, events, times, np.stack([first, last]), covariances, np.ones(2))

    def test_a_piece_that_fits_is_the_same_object(self) -> None:
        pieces = [self.piece(0, 0.0, 5.0, [0, 0, 0, 1, 0, 0]), self.piece(1, 5.5, 9.0, [5.5, 0, 0, 1, 0, 0])]
        assert stitch(pieces, MOTION, 1.0) == {1: 0}

    def test_too_long_a_gap_or_too_far_away_is_not(self) -> None:
        pieces = [self.piece(0, 0.0, 5.0, [0, 0, 0, 1, 0, 0]), self.piece(1, 5.5, 9.0, [9.5, 0, 0, 1, 0, 0])]
        assert stitch(pieces, MOTION, 1.0) == {}
        pieces[1] = self.piece(1, 6.5, 9.0, [6.5, 0, 0, 1, 0, 0])
        assert stitch(pieces, MOTION, 1.0) == {}

    def test_pieces_that_overlap_in_time_are_two_objects(self) -> None:
        pieces = [self.piece(0, 0.0, 5.0, [0, 0, 0, 1, 0, 0]), self.piece(1, 4.5, 9.0, [4.5, 0, 0, 1, 0, 0])]
        assert stitch(pieces, MOTION, 1.0) == {}

    def test_pairs_are_chosen_jointly(self) -> None:
        pieces = [
            self.piece(0, 0.0, 5.0, [0, 0.0, 0, 1, 0, 0]),
            self.piece(1, 0.0, 5.0, [0, 0.6, 0, 1, 0, 0]),
            self.piece(2, 5.5, 9.0, [5.5, 0.3, 0, 1, 0, 0]),
            self.piece(3, 5.5, 9.0, [5.5, 0.9, 0, 1, 0, 0]),
        ]
        assert stitch(pieces, MOTION, 1.0) == {2: 0, 3: 1}

    def test_a_pair_that_is_not_allowed_costs_no_pair_that_is(self) -> None:
        """Two ends and two starts of which one start fits no end: its pairs must not outbid those that fit."""
        still = ConstantVelocity([0.0] * 3)
        pieces = [
            self.piece(0, 0.0, 5.0, [0.0] * 6),
            self.piece(1, 0.0, 5.0, [0.60, 0, 0, 0, 0, 0]),
            self.piece(2, 5.0, 9.0, [0.20, 0, 0, 0, 0, 0]),
            self.piece(3, 5.0, 9.0, [-0.70, 0, 0, 0, 0, 0]),
        ]
        # the last two start at the time at which the first two end, with a later event
        pieces[2:] = [replace(p, events=np.array([51, 90])) for p in pieces[2:]]
        found = stitch(pieces, still, 1.0)
        assert found == {2: 0}

    def test_what_continues_two_tracks_alike_continues_neither(self) -> None:
        still = ConstantVelocity([0.0] * 3)
        ends = [self.piece(0, 0.0, 5.0, [0.0] * 6), self.piece(1, 0.0, 5.0, [0.60, 0, 0, 0, 0, 0])]
        start = replace(self.piece(2, 5.0, 9.0, [0.30, 0, 0, 0, 0, 0]), events=np.array([51, 90]))
        assert stitch([*ends, start], still, 1.0) == {}
        assert stitch([ends[0], start], still, 1.0) == {2: 0}


def test_static_objects_have_one_state_throughout() -> None:
    covariances = np.zeros((3, 6, 6))
    covariances[:, :3, :3] = np.array([3.0, 2.0, 1.0])[:, None, None] * np.eye(3)
    states = np.array([[1.0, 2, 3, 0, 0, 0], [1.5, 2, 3, 0, 0, 0], [1.2, 2, 3, 0, 0, 0]])
    track = Trajectory(0, np.arange(3), np.arange(3.0), states, covariances, np.ones(3))
    smoothed = smooth(track, Static())
    np.testing.assert_array_equal(smoothed.states, np.repeat(states[-1:], 3, axis=0))
    np.testing.assert_array_equal(smoothed.covariances, np.repeat(covariances[-1:], 3, axis=0))


def test_many_pieces_are_stitched_as_one_assignment_would() -> None:
    # a thousand objects far apart, each in three pieces: groups are matched apart, with the result of all at once
    rng = np.random.default_rng(5)
    pieces: list[Trajectory] = []
    expected = {}
    for thing in range(1000):
        start = np.concatenate([rng.uniform(-1e4, 1e4, 3), rng.normal(size=3)])
        for part in range(3):
            events = 30 * part + np.arange(5)
            times = 0.1 * events
            states = np.tile(start, (5, 1))
            states[:, :3] += times[:, None] * start[3:]
            track_id = 3 * thing + part
            covariances = np.tile(0.01 * np.eye(6), (5, 1, 1))
            pieces.append(Trajectory(track_id, events, times, states, covariances, np.ones(5)))
            if part:
                expected[track_id] = track_id - 1
    shuffled = [pieces[k] for k in rng.permutation(len(pieces))]
    assert stitch(shuffled, MOTION, 3.0) == expected
