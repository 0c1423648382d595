"""Responses of tracks against a filter whose camera is moved, and changes of poses that are found in the residuals."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.two_views.responses import (
    USUAL,
    Pinhole,
    Predicted,
    add_residual,
    find_change,
    follow_detection,
    predict_track,
)

CAMERA = (650.0, 640.0, 320.0, 240.0)
ROTATIONS = [rotation_from_vector(np.array(turn)) for turn in ([0.1, 0.4, 0.02], [0.05, -0.4, 0.1])]
CENTERS = [np.array([-3.0, -1.0, 0.0]), np.array([3.0, -1.0, 0.5])]
STEP_S, TRUTH = 0.05, np.array([0.5, -0.4, 8.0, 0.3, 0.1, -0.2])


def seen_from(state: Array, camera: int, pose_error: Array) -> Array:
    """Return the pixel of a state from a camera whose pose is off by turns and moves along its axes."""
    x = ROTATIONS[camera] @ (state[:3] - CENTERS[camera])
    x = rotation_from_vector(pose_error[6 * camera : 6 * camera + 3]) @ x - pose_error[6 * camera + 3 : 6 * camera + 6]
    return np.array([CAMERA[0] * x[0] / x[2] + CAMERA[2], CAMERA[1] * x[1] / x[2] + CAMERA[3]])


def filtered(pose_error: Array) -> tuple[Array, Array, Array, Array]:
    """Return the state, the response, the last residual and its slope, after forty frames of two cameras by turns."""
    state, covariance, response = TRUTH.copy(), np.diag([0.2, 0.2, 0.2, 0.1, 0.1, 0.1]), np.zeros((6, 12))
    transition, truth = np.eye(6), TRUTH.copy()
    transition[:3, 3:] = STEP_S * np.eye(3)
    predicted = Predicted(np.empty(3), np.empty(2), np.empty((2, 3)), np.empty((2, 6)), np.empty((2, 2)))
    _, pixel, seen, shared, spread = predicted
    slope, residual = np.empty((2, 12)), np.empty(2)
    for frame in range(40):
        index = frame % 2
        camera = Pinhole(ROTATIONS[index], CENTERS[index], *CAMERA)
        predict_track(state, covariance, STEP_S, camera, predicted)
        state, truth = transition @ state, transition @ truth
        covariance = transition @ covariance @ transition.T
        response[:3] += STEP_S * response[3:]
        np.testing.assert_allclose(pixel, seen_from(state, index, np.zeros(12)))
        np.testing.assert_allclose(shared, np.hstack([seen, np.zeros((2, 3))]) @ covariance, atol=1e-9)
        spread += np.eye(2)
        slope = follow_detection(response, predicted, camera, index)
        residual = seen_from(truth, index, pose_error) - pixel
        gain = shared.T @ np.linalg.inv(spread)
        state, covariance = state + gain @ residual, covariance - gain @ shared
    return state, response, residual, slope


def test_responses_are_derivatives_of_the_filter() -> None:
    state, response, residual, slope = filtered(np.zeros(12))
    for unknown in range(12):
        moved = filtered(1e-6 * np.eye(12)[unknown])
        np.testing.assert_allclose((moved[0] - state) / 1e-6, response[:, unknown], rtol=1e-3, atol=2e-3)
        np.testing.assert_allclose((moved[2] - residual) / 1e-6, slope[:, unknown], rtol=1e-3, atol=0.2)


def sums_of(change: Array, blocks: int, halves: tuple[int, ...], seed: int) -> Array:
    """Return sums of a camera that is off by a little, and by a change more in the last blocks of some halves."""
    rng = np.random.default_rng(seed)
    sums = np.zeros((6, 2, 1, 6, 7))
    for block in range(6):
        for half in range(2):
            error = np.full(6, 0.1 * USUAL) + (change if block >= 6 - blocks and half in halves else 0.0)
            for _ in range(600 if block == 0 else 120):
                slope = rng.normal(0.0, 30.0, (2, 6)) * [4.0, 4.0, 4.0, 0.5, 0.5, 0.5]
                u, v = slope @ error + rng.normal(0.0, 1.0, 2)
                add_residual(sums[block, half], slope, (u, v), np.eye(2), 1.0)
    return sums[:, :, 0]


@pytest.mark.parametrize("seed", range(4))
def test_a_change_is_found_with_its_size_and_time(seed: int) -> None:
    """Distances are eight: a move by eight times as many lengths as a turn has radians is as large."""
    truth = USUAL * np.array([1.0, -0.5, 0.7, 0.0, 4.0, -8.0])
    change = find_change(sums_of(truth, 2, (0, 1), seed), 1.0)
    assert change is not None
    assert change.evidence > 100.0
    assert change.blocks == 2
    np.testing.assert_allclose(change.turns, truth[:3], atol=0.15 * USUAL)
    np.testing.assert_allclose(8.0 * change.moves, truth[3:], atol=1.2 * USUAL)


@pytest.mark.parametrize("seed", range(4))
def test_what_was_off_before_is_no_change_nor_what_half_of_the_tracks_say(seed: int) -> None:
    truth = USUAL * np.array([1.0, -0.5, 0.7, 0.0, 4.0, -8.0])
    for sums in (sums_of(truth, 0, (), seed), sums_of(truth, 2, (1,), seed)):
        change = find_change(sums, 1.0)
        assert change is not None
        assert change.evidence < 0.0
        assert change.misfit is not None
        assert change.misfit < 4.0


def test_nothing_is_found_where_nothing_is_known() -> None:
    assert find_change(np.zeros((6, 2, 6, 7)), 1.0) is None
    sums = sums_of(np.zeros(6), 0, (), 0)
    sums[1] = 0.0
    change = find_change(sums, 1.0)
    assert change is not None
    assert change.misfit is None


def test_objects_next_to_a_camera_end_no_run() -> None:
    """The pixels of an object at a camera change by any amount with its pose: sums are huge, and of low rank."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        sums = np.zeros((6, 2, 6, 7))
        for block in sums.reshape(12, 6, 7):
            slope = rng.normal(size=(rng.integers(1, 4), 6)) * 10.0 ** rng.uniform(0.0, 9.0)
            block[:, :6] = np.tril(slope.T @ slope)
            block[:, 6] = slope.T @ rng.normal(size=len(slope))
        change = find_change(sums, 1.0)
        assert change is not None
        assert change.misfit is None or change.misfit >= 0.0
