"""Known trajectories: slerp as SciPy has it, rates as finite differences, a camera on a body, refusals."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.trajectory import BodyTrajectory, MountedPath


def drawn(seed: int = 0, count: int = 6) -> np.ndarray:
    """Poses at irregular times, turned at random."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    return np.column_stack([np.sort(rng.uniform(0.0, 10.0, count)), rng.normal(size=(count, 3)), quaternions])


def test_poses_between_are_slerp_and_straight_lines() -> None:
    poses = drawn()
    trajectory = BodyTrajectory(poses)
    times = np.linspace(poses[0, 0], poses[-1, 0], 101)
    found = trajectory.at(times)
    turns = Slerp(poses[:, 0], Rotation.from_quat(poses[:, [5, 6, 7, 4]]))(times)
    np.testing.assert_allclose(found.rotations, turns.inv().as_matrix(), atol=1e-14)
    for axis in range(3):
        expected = np.interp(times, poses[:, 0], poses[:, 1 + axis])
        np.testing.assert_allclose(found.centers[:, axis], expected, atol=1e-14)
    np.testing.assert_allclose(trajectory.at(poses[:, 0]).centers, poses[:, 1:4], atol=1e-14)


def test_rates_are_derivatives_of_the_mounted_camera() -> None:
    poses = drawn(1)
    path = MountedPath(BodyTrajectory(poses), rotation_from_vector([0.1, 0.2, -0.3]), [1.0, -2.0, 0.5])
    middle = 0.5 * (poses[1:, 0] + poses[:-1, 0])
    step = 1e-5
    found, before, after = path.at(middle), path.at(middle - step), path.at(middle + step)
    np.testing.assert_allclose((after.centers - before.centers) / (2 * step), found.velocities, atol=1e-6)
    turned = [rotation_to_vector(b @ a.T) / (2 * step) for b, a in zip(before.rotations, after.rotations, strict=True)]
    np.testing.assert_allclose(turned, found.rates, atol=1e-6)


def test_a_mounted_camera_sees_points_of_the_body_where_the_mount_says() -> None:
    path = MountedPath(BodyTrajectory(drawn(2)), rotation_from_vector([0.3, 0.0, 0.1]), [0.2, 0.3, 0.4])
    time_s = 0.5 * sum(path.trajectory.span)
    body = path.trajectory.at(np.array([time_s]))
    on_body = np.array([[1.0, 2.0, 3.0]])
    world = on_body @ body.rotations[0] + body.centers[0]
    seen = Pose.following(path, time_s).to_camera(world)
    np.testing.assert_allclose(seen, (on_body - path.center) @ path.rotation.T, atol=1e-12)


def test_a_pose_follows_its_path_at_all_times() -> None:
    path = MountedPath(BodyTrajectory(drawn(3)), np.eye(3), np.zeros(3))
    pose = Pose.following(path)
    first, last = pose.span
    assert not pose.is_static
    assert pose.at(last).at(first) == pose
    times = np.linspace(first, last, 7)
    found = pose.motions(times)
    for k, time_s in enumerate(times.tolist()):
        np.testing.assert_allclose(pose.at(time_s).rotation, found.rotations[k], atol=1e-12)
        np.testing.assert_allclose(pose.at(time_s).center, found.centers[k], atol=1e-12)
    beyond = pose.at(last + 5.0)
    np.testing.assert_allclose(beyond.center, pose.at(last).center)
    assert not beyond.velocity.any()
    assert not beyond.rotation_rate.any()


def test_steady_poses_are_those_of_their_rates() -> None:
    pose = Pose(rotation_from_vector([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0], [0.1, 0.0, -0.2], [0.0, 0.3, 0.1], 2.0)
    found = pose.motions(np.array([0.0, 2.0, 7.0]))
    for k, time_s in enumerate((0.0, 2.0, 7.0)):
        np.testing.assert_allclose(found.rotations[k], pose.at(time_s).rotation, atol=1e-14)
        np.testing.assert_allclose(found.centers[k], pose.at(time_s).center, atol=1e-14)


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (2, 0, -1.0, "row 2: expected increasing times"),
        (3, 2, np.nan, "row 3: expected finite numbers"),
        (1, 5, 3.0, "row 1: expected a quaternion of norm 1"),
    ],
)
def test_bad_poses_are_refused_with_their_row(row: int, column: int, value: float, message: str) -> None:
    poses = drawn(4)
    poses[row, column] = value
    with pytest.raises(ValueError, match=message):
        BodyTrajectory(poses)


def test_one_pose_is_no_trajectory() -> None:
    with pytest.raises(ValueError, match="two or more poses"):
        BodyTrajectory(drawn(5)[:1])
