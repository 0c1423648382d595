"""Poses of cameras in a configuration: fixed, moving, or along the known trajectory of a body."""

from typing import Annotated, Any, Self

import numpy as np
from annotated_types import Interval
from pydantic import AfterValidator, field_validator, model_validator

from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.geometry.rotations import checked_rotation
from stereophd.core.geometry.trajectory import BodyTrajectory, MountedPath
from stereophd.core.settings import FINITE, Degrees, DegreesPerSecond, Time, Vector3, parameter
from stereophd.io.tables.trajectories import read_trajectory, unpack_poses
from stereophd.validated import Model

Entry = Annotated[float, Interval(ge=-2, le=2), FINITE]
Row = tuple[Entry, Entry, Entry]

# A rotation matrix typed by hand with six digits passes; a reflection or a scaled matrix does not.
ROTATION_TOLERANCE = 1e-5


def _check_rotation(rows: Any) -> Any:
    if rows is not None:
        checked_rotation(np.asarray(rows, dtype=float), ROTATION_TOLERANCE)
    return rows


RotationMatrix = Annotated[tuple[Row, Row, Row], AfterValidator(_check_rotation)]
RotationVector = tuple[Degrees, Degrees, Degrees]


class PlaceConfig(Model):
    """A place, and a rotation in one of two forms: the identity without either."""

    center: Vector3 | None = parameter("optical centre", default=None, unit="length")
    rotation_matrix: RotationMatrix | None = parameter("rows of the rotation to camera axes", default=None)
    rotation_vector_deg: RotationVector | None = parameter(
        "the same rotation as axis times angle", default=None, unit="degrees"
    )

    @model_validator(mode="after")
    def _one_rotation(self) -> Self:
        if self.rotation_matrix is not None and self.rotation_vector_deg is not None:
            raise ValueError("expected one of rotation_matrix and rotation_vector_deg, found both")
        return self

    @property
    def rotation(self) -> Array:
        """The rotation matrix."""
        if self.rotation_matrix is not None:
            return np.asarray(self.rotation_matrix, dtype=float)
        return rotation_from_vector(np.deg2rad(self.rotation_vector_deg or (0.0, 0.0, 0.0)))


class MountConfig(PlaceConfig):
    """How a body carries a camera (hand-eye), in the body's axes: x_camera = rotation @ (x_body - center)."""

    center: Vector3 = parameter("optical centre in the body's axes", default=(0.0, 0.0, 0.0), unit="length")


class TrajectoryConfig(Model):
    """A trajectory that was read from its file, as outputs keep it."""

    file: str = parameter("name of the file that it was read from")
    poses: str = parameter("its poses, packed")

    @field_validator("poses")
    @classmethod
    def _unpacks(cls, text: str) -> str:
        unpack_poses(text)
        return text

    def build(self) -> BodyTrajectory:
        """Return the `BodyTrajectory`."""
        return unpack_poses(self.poses)


class PoseConfig(PlaceConfig):
    """Pose of a camera: x_camera = rotation @ (x_world - center)."""

    center: Vector3 | None = parameter(
        "optical centre in the world; required without trajectory", default=None, unit="length"
    )
    velocity: Vector3 = parameter("velocity of the centre in the world", default=(0.0, 0.0, 0.0), unit="length/s")
    rotation_rate_deg_s: tuple[DegreesPerSecond, DegreesPerSecond, DegreesPerSecond] = parameter(
        "angular velocity about the camera's own axes", default=(0.0, 0.0, 0.0), unit="deg/s"
    )
    time_s: Time = parameter("time at which center and rotation hold, for a moving camera", default=0.0, unit="s")
    trajectory: str | TrajectoryConfig | None = parameter(
        "file of the known poses of a body that carries the camera, in place of all of the above: a table time_s, x, "
        "y, z, qw, qx, qy, qz or TUM text, on true time; a path is relative to the file that names it",
        default=None,
    )
    mount: MountConfig | None = parameter("how that body carries the camera; default: they are one", default=None)
    unknown: bool = parameter(
        "nothing is known of the pose (pose: unknown): calibrate finds it from the tracks alone", default=False
    )

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if self.unknown:
            if self.model_dump(exclude_defaults=True).keys() != {"unknown"}:
                raise ValueError("expected nothing besides unknown, found more")
            return self
        if self.trajectory is None:
            if self.center is None:
                raise ValueError("expected center or trajectory, found neither")
            if self.mount is not None:
                raise ValueError("mount: expected a trajectory of the body that carries the camera, found none")
            return self
        others = {"center", "rotation_matrix", "rotation_vector_deg", "velocity", "rotation_rate_deg_s", "time_s"}
        defaults = {name: field.default for name, field in type(self).model_fields.items()}
        if stated := [name for name in sorted(others) if getattr(self, name) != defaults[name]]:
            raise ValueError(f"expected only mount besides trajectory, found {', '.join(stated)}")
        return self

    def build(self) -> Pose:
        """Return the `Pose`; without a rotation the camera looks along the world's z axis. Unknown: the origin."""
        if self.unknown:
            return Pose(np.eye(3), np.zeros(3))
        if self.trajectory is not None:
            mount = self.mount or MountConfig()
            file = self.trajectory
            trajectory = read_trajectory(file) if isinstance(file, str) else file.build()
            return Pose.following(MountedPath(trajectory, mount.rotation, np.array(mount.center)))
        assert self.center is not None
        return Pose(
            rotation=self.rotation,
            center=np.asarray(self.center, dtype=float),
            velocity=np.asarray(self.velocity, dtype=float),
            rotation_rate=np.deg2rad(self.rotation_rate_deg_s),
            time_s=self.time_s,
        )


class LaterPoseConfig(PlaceConfig):
    """A pose that a camera has from a time on."""

    from_s: Time = parameter("true time from which it holds", unit="s")
    center: Vector3 = parameter("optical centre in the world", unit="length")

    @model_validator(mode="after")
    def _is_rotated(self) -> Self:
        if self.rotation_matrix is None and self.rotation_vector_deg is None:
            raise ValueError("expected rotation_matrix or rotation_vector_deg, found neither")
        return self

    def build(self) -> Pose:
        """Return the `Pose`."""
        return Pose(self.rotation, np.array(self.center))


def parse_pose(value: Any) -> Any:
    """Turn the short form ``unknown`` into a pose of which nothing is known."""
    if isinstance(value, str):
        if value != "unknown":
            raise ValueError(f"expected unknown or center and a rotation, found {value}")
        return {"unknown": True}
    return with_tuples(value)


def with_tuples(value: Any) -> Any:
    """Return a value with tuples in place of lists, which pydantic does not take for them behind our own validators."""
    if isinstance(value, dict):
        return {key: with_tuples(part) for key, part in value.items()}
    return tuple(with_tuples(part) for part in value) if isinstance(value, list) else value
