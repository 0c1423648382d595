"""Rotations against OpenCV, and poses at rest and in motion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector

finite = st.floats(-100, 100)
vectors = st.tuples(finite, finite, finite).map(np.array)
# Axis times angle up to just under half a turn, where the vector is unique.
rotation_vectors = vectors.map(lambda v: v * min(1.0, 3.14 / max(np.linalg.norm(v), 1e-300)))


@settings(max_examples=100)
@given(vector=rotation_vectors)
def test_rotation_vector_round_trip(vector: np.ndarray) -> None:
    rotation = rotation_from_vector(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(rotation_to_vector(rotation), vector, rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 1.0, 3.0, np.pi - 1e-7, np.pi])
def test_rotations_agree_with_opencv(angle: float) -> None:
    generator = np.random.default_rng(5)
    for axis in generator.normal(size=(50, 3)):
        vector = angle * axis / np.linalg.norm(axis)
        rotation = rotation_from_vector(vector)
        np.testing.assert_allclose(rotation, cv2.Rodrigues(vector)[0], rtol=0, atol=1e-14)
        back = rotation_to_vector(rotation)
        # Half a turn about an axis is half a turn about its opposite.
        sign = np.sign(back @ vector) if angle == np.pi else 1.0
        np.testing.assert_allclose(sign * back, vector, rtol=0, atol=1e-14 + 1e-14 * angle)


@settings(max_examples=100)
@given(vector=rotation_vectors, center=vectors, x=vectors)
def test_world_round_trip(vector: np.ndarray, center: np.ndarray, x: np.ndarray) -> None:
    pose = Pose(rotation_from_vector(vector), center)
    np.testing.assert_allclose(pose.to_camera([x])[0], pose.rotation @ (x - center), atol=1e-12)
    np.testing.assert_allclose(pose.to_world(pose.to_camera([x])), [x], atol=1e-11)


def test_positive_rate_about_y_turns_the_camera_to_the_right() -> None:
    # y is down: a quarter turn about it brings the optical axis from z (forward) to x (right).
    pose = Pose(np.eye(3), [0.0, 0.0, 0.0], rotation_rate=[0.0, np.pi / 8, 0.0], time_s=1.0)
    assert not pose.is_static
    np.testing.assert_allclose(pose.at(5.0).to_camera([[1.0, 0.0, 0.0]]), [[0.0, 0.0, 1.0]], atol=1e-15)
    np.testing.assert_array_equal(pose.at(1.0).rotation, np.eye(3))


def test_moving_pose_has_the_stated_velocities() -> None:
    rate, velocity = np.array([0.3, -0.2, 0.5]), np.array([1.0, 2.0, -3.0])
    pose = Pose(rotation_from_vector([0.1, 0.9, -0.4]), [4.0, 5.0, 6.0], velocity, rate, time_s=2.0)
    step, time = 1e-5, 3.7
    before, now, after = (pose.at(time + dt) for dt in (-step, 0.0, step))
    np.testing.assert_allclose((after.center - before.center) / (2 * step), velocity, atol=1e-9)
    # The camera's axes in the world are the rows of the rotation; each turns as omega x axis, with
    # omega the rate seen from the world.
    omega = now.rotation.T @ rate
    derivative = (after.rotation - before.rotation) / (2 * step)
    np.testing.assert_allclose(derivative, np.cross(omega, now.rotation), atol=1e-9)


@settings(max_examples=100)
@given(rate=vectors, first=st.floats(-5, 5), second=st.floats(-5, 5))
def test_moving_in_two_steps_is_moving_in_one(rate: np.ndarray, first: float, second: float) -> None:
    pose = Pose(rotation_from_vector([0.4, 0.1, 0.2]), [1.0, 2.0, 3.0], [0.5, 0.0, -1.0], 0.02 * rate)
    two, one = pose.at(first).at(second), pose.at(second)
    np.testing.assert_allclose(two.rotation, one.rotation, atol=1e-12)
    np.testing.assert_allclose(two.center, one.center, atol=1e-12)


def test_static_pose_stays_itself() -> None:
    pose = Pose(np.eye(3), np.zeros(3), time_s=3.0)
    assert pose.is_static
    assert pose.at(100.0) is pose


def test_matrix_of_few_digits_becomes_the_nearest_rotation() -> None:
    exact = rotation_from_vector([0.3, -0.2, 0.7])
    pose = Pose(np.round(exact, 6), np.zeros(3))
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(pose.rotation, exact, atol=2e-6)
    # A rotation is taken as it is, to the last bit.
    assert np.array_equal(Pose(exact, np.zeros(3)).rotation, exact)


@pytest.mark.parametrize(
    ("rotation", "center"),
    [
        (np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
        (1.01 * np.eye(3), np.zeros(3)),
        (np.eye(2), np.zeros(3)),
        (np.full((3, 3), np.nan), np.zeros(3)),
        (np.eye(3), np.zeros(2)),
        (np.eye(3), np.array([0.0, np.inf, 0.0])),
    ],
)
def test_bad_pose_is_refused(rotation: np.ndarray, center: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected"):
        Pose(rotation, center)


def test_poses_compare_by_value_and_cannot_be_changed() -> None:
    center = np.array([1.0, 0.0, 3.0])
    pose = Pose(np.eye(3), center)
    center[0] = 9.0
    assert pose.center[0] == 1.0
    assert pose == Pose(np.eye(3), [1.0, -0.0, 3.0])
    assert hash(pose) == hash(Pose(np.eye(3), [1.0, -0.0, 3.0]))
    assert pose != Pose(np.eye(3), [1.0, 0.0, 3.0], time_s=1.0)
    with pytest.raises(ValueError, match="read-only"):
        pose.center[0] = 2.0


def test_a_pose_in_steps_is_another_one_from_a_time_on() -> None:
    poses = [Pose(rotation_from_vector([0.0, 0.1 * k, 0.2]), [float(k), 0.0, 1.0]) for k in range(3)]
    for start in (0.0, 1.7e9):
        stepped = Pose.in_steps(poses[0], [(start + 10.0, poses[1]), (start + 20.5, poses[2])])
        assert not stepped.is_static
        assert stepped.span[0] < -1e13
        for time_s, expected in ((-1e6, 0), (start + 9.99, 0), (start + 10.0, 1), (start + 20.4, 1), (start + 1e6, 2)):
            pose = stepped.at(time_s)
            np.testing.assert_allclose(pose.rotation, poses[expected].rotation, atol=1e-14)
            np.testing.assert_array_equal(pose.center, poses[expected].center)
            np.testing.assert_array_equal(pose.velocity, np.zeros(3))
            np.testing.assert_array_equal(pose.rotation_rate, np.zeros(3))
