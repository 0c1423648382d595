"""Pose of a camera in the world, standing still or moving steadily."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.geometry.rotations import checked_rotation, rotations
from stereophd.core.geometry.trajectory import BodyTrajectory, EqualByValue, Motions, MountedPath, frozen

# A matrix whose R R^T differs more than this from the identity is refused rather than repaired.
LARGEST_ROTATION_DEFECT = 1e-4
# Ends of a pose that changes in steps: later than any time of a log, s.
STEPS_END_S = 1e14


def rotation_from_vector(vector: ArrayLike) -> Array:
    """Return the rotation matrix exp([v]_x) of an axis times an angle v (3,), rad, right-handed.

    Rodrigues' formula, in the convention of OpenCV's ``Rodrigues``.
    """
    v = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(v))
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    if angle < 1e-8:
        # sin(a) / a and (1 - cos a) / a^2 to full precision; the squared term is below rounding.
        return np.asarray(np.eye(3) + cross + 0.5 * cross @ cross, dtype=np.float64)
    # 2 sin^2(a / 2) is 1 - cos a without the cancellation at small angles.
    first = math.sin(angle) / angle
    second = 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross, dtype=np.float64)


def rotation_to_vector(rotation: ArrayLike) -> Array:
    """Return the axis times the angle (3,) of a rotation matrix, the inverse of `rotation_from_vector`.

    The angle is in [0, pi]; at pi the sign of the axis is arbitrary.
    """
    from scipy.spatial.transform import Rotation  # only here: costly to import

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


@dataclass(frozen=True, init=False, eq=False)
class Pose(EqualByValue):
    """Pose of a camera: ``x_camera = rotation @ (x_world - center)``.

    Camera axes: x right, y down, z forward. A moving camera has a constant velocity of its centre and a constant
    angular velocity about its own axes, or it follows a known path; `rotation` and `center` hold at `time_s`. Poses are
    equal when all their values are, and their arrays are read-only copies. Raises ValueError if a shape is wrong, a
    value is not finite, or the matrix is not a rotation.

    Attributes
    ----------
    rotation : (3, 3), from world to camera axes; one of few digits is replaced by the nearest rotation
    center : (3,), optical centre in the world, length
    velocity : (3,), velocity of the centre in the world, length/s
    rotation_rate : (3,), angular velocity about the camera's own axes, rad/s; (0, w, 0) turns it to the right
    time_s : time at which rotation and center hold, s
    path : the camera follows it at all times; the other values are those at `time_s` (see `following`)
    """

    rotation: Array
    center: Array
    velocity: Array
    rotation_rate: Array
    time_s: float
    path: MountedPath | None

    def __init__(
        self, rotation: ArrayLike, center: ArrayLike, velocity: ArrayLike = (0.0, 0.0, 0.0),
        rotation_rate: ArrayLike = (0.0, 0.0, 0.0), time_s: float = 0.0, path: MountedPath | None = None,
    ) -> None:  # fmt: skip
        turn = checked_rotation(frozen(rotation, (3, 3), "rotation"), LARGEST_ROTATION_DEFECT)
        turn.setflags(write=False)
        self.__dict__["rotation"] = turn
        for name, values in (("center", center), ("velocity", velocity), ("rotation_rate", rotation_rate)):
            self.__dict__[name] = frozen(values, (3,), name)
        self.__dict__.update(time_s=float(time_s), path=path)

    @staticmethod
    def following(path: MountedPath, time_s: float | None = None) -> "Pose":
        """Return the pose of a camera on a path at a time, s; by default the first of its trajectory."""
        time_s = path.trajectory.span[0] if time_s is None else time_s
        turns, centers, velocities, rates = path.at(np.array([time_s]))
        return Pose(turns[0], centers[0], velocities[0], rates[0], time_s, path)

    @staticmethod
    def in_steps(first: "Pose", later: Sequence[tuple[float, "Pose"]]) -> "Pose":
        """Return a pose that is `first`, and from each later time (s, rising) on another one that stands still.

        It is a trajectory whose poses change within a nanosecond, and that has no ends.
        """
        from scipy.spatial.transform import Rotation  # only here: costly to import

        poses = [first, *(pose for _, pose in later)]
        quaternions = Rotation.from_matrix([pose.rotation.T for pose in poses]).as_quat(scalar_first=True)
        rows = [[*pose.center, *quaternion] for pose, quaternion in zip(poses, quaternions, strict=True)]
        times = [-STEPS_END_S, *(time_s for time_s, _ in later), STEPS_END_S]
        table = []
        for row, begin, end in zip(rows, times[:-1], times[1:], strict=True):
            before = end if end == STEPS_END_S else end - max(1e-9, 4.0 * float(np.spacing(abs(end))))
            table += [[begin, *row], [before, *row]]
        return Pose.following(MountedPath(BodyTrajectory(np.array(table)), np.eye(3), np.zeros(3)))

    @cached_property
    def is_static(self) -> bool:
        """Whether the pose is the same at all times."""
        return self.path is None and not (self.velocity.any() or self.rotation_rate.any())

    @property
    def span(self) -> tuple[float, float]:
        """First and last time, s, at which the pose is known."""
        return (-math.inf, math.inf) if self.path is None else self.path.trajectory.span

    def at(self, time_s: float) -> "Pose":
        """Return the pose moved to a time, s; the pose itself if it is static.

        The rotation is exp(-[rotation_rate]_x (time_s - self.time_s)) @ rotation: the camera turns by the
        angle about its own axes, so world points turn the other way in its view.
        """
        if self.is_static:
            return self
        if self.path is not None:
            return Pose.following(self.path, time_s)
        elapsed = time_s - self.time_s
        return Pose(
            rotation=rotation_from_vector(-elapsed * self.rotation_rate) @ self.rotation,
            center=self.center + elapsed * self.velocity,
            velocity=self.velocity,
            rotation_rate=self.rotation_rate,
            time_s=time_s,
        )

    def motions(self, times: Array) -> Motions:
        """Return rotations, centres and their rates at times (n,), s, as `at` has them one by one."""
        if self.path is not None:
            return self.path.at(times)
        elapsed = (times - self.time_s)[:, None]
        turns = np.broadcast_to(self.rotation, (len(times), 3, 3))
        if self.rotation_rate.any():
            turns = rotations(-elapsed * self.rotation_rate) @ self.rotation
        rates = (np.broadcast_to(one, (len(times), 3)) for one in (self.velocity, self.rotation_rate))
        return Motions(turns, self.center + elapsed * self.velocity, *rates)

    def to_camera(self, x_world: ArrayLike) -> Array:
        """Map world positions (n, 3) to camera axes (n, 3), length, at the pose's own time."""
        x = np.asarray(x_world, dtype=np.float64)
        return np.asarray((x - self.center) @ self.rotation.T, dtype=np.float64)

    def to_world(self, x_camera: ArrayLike) -> Array:
        """Map positions in camera axes (n, 3) to the world (n, 3), length, at the pose's own time."""
        x = np.asarray(x_camera, dtype=np.float64)
        return np.asarray(x @ self.rotation + self.center, dtype=np.float64)
