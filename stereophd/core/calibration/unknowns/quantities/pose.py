"""Pose of a camera that stands still or moves steadily."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities import base
from stereophd.core.geometry import layout
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.rotations import left_jacobians, rotations
from stereophd.core.settings import LARGEST_DEGREES

CENTER = ("center_x", "center_y", "center_z")
ROTATION = ("rotation_x", "rotation_y", "rotation_z")


class Center(base.Offset):
    """The optical centre of a camera: an offset in the world's axes."""

    name = "center"
    components, place = CENTER, ("pose", "center")
    unit, affects = base.LENGTH, base.MOVES
    prior = "center_std"
    description = "standard deviation of the centre, length; one value or x, y, z"
    on_path = False
    of_the_frame = True

    def _difference(self, camera: Camera, other: Camera) -> Array:
        """Return what moves one centre to the other, both at the time of the first pose."""
        return np.asarray(other.pose.at(camera.pose.time_s).center - camera.pose.center)

    def pulled(self, view: base.CameraView, pull: base.Pull, values: Array) -> Array:
        """Moving the camera moves the point the other way."""
        return -pull.force

    def _entry(self, camera: Camera) -> base.Entry:
        return {"pose": {"center": camera.pose.center.tolist()}}

    def pack(self, spaces: Array, camera: Camera, values: Array) -> None:
        """Move the centres of packed cameras."""
        spaces[:, layout.CENTER : layout.CENTER + 3] += values


class Rotation(base.Quantity):
    """The rotation of a camera: a rotation vector v in the camera's own axes, rotation = exp([v]_x) rotation_0.

    So rotation_x is pitch, rotation_y yaw and rotation_z roll.
    """

    name = "rotation"
    components = ROTATION
    unit, affects = base.RADIANS, base.MOVES
    prior, prior_unit, largest_std = "rotation_std_deg", np.pi / 180.0, LARGEST_DEGREES
    description = (
        "standard deviation of the rotation, degrees; one value or about the camera's own x (pitch), y (yaw), z (roll)"
    )
    on_path = False
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        turned_pose = replace(camera.pose, rotation=rotation_from_vector(values) @ camera.pose.rotation)
        return replace(camera, pose=turned_pose)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        """Return what turns one camera to the other, both at the time of the first pose."""
        return rotation_to_vector(other.pose.at(camera.pose.time_s).rotation @ camera.pose.rotation.T)

    def pulled(self, view: base.CameraView, pull: base.Pull, values: Array) -> Array:
        """d (point in the camera) / d v = -[point]_x turn J_left(v)."""
        torque = pull.torque if view.turns is None else np.einsum("na,nab->nb", pull.torque, view.turns)
        return np.asarray(torque @ left_jacobians(values[None])[0])

    def _entry(self, camera: Camera) -> base.Entry:
        return {"pose": {"rotation_matrix": camera.pose.rotation.tolist(), "rotation_vector_deg": None}}

    def pack(self, spaces: Array, camera: Camera, values: Array) -> None:
        """Turn packed cameras."""
        spaces[:, layout.ROTATION : layout.ROTATION + 9] = (rotations(values) @ camera.pose.rotation).reshape(-1, 9)


class Velocity(base.Offset):
    """The velocity of a moving camera's centre in the world."""

    name = "velocity"
    components = ("velocity_x", "velocity_y", "velocity_z")
    place = ("pose", "velocity")
    unit, affects = base.LENGTH_PER_SECOND, base.MOVES
    prior = "velocity_std"
    description = "standard deviation of the velocity of a camera that moves, length/s; one value or x, y, z"
    on_path = False
    of_the_frame = True

    def pulled(self, view: base.CameraView, pull: base.Pull, values: Array) -> Array:
        """The centre moves by the velocity times the time since that of the pose."""
        return -view.elapsed[:, None] * pull.force

    def _entry(self, camera: Camera) -> base.Entry:
        return {"pose": {"velocity": camera.pose.velocity.tolist(), "time_s": camera.pose.time_s}}


class RotationRate(base.Offset):
    """The angular velocity w of a moving camera about its axes: rotation(t) = exp(-[w]_x (t - t_0)) rotation(t_0)."""

    name = "rotation_rate"
    components = ("rotation_rate_x", "rotation_rate_y", "rotation_rate_z")
    place = ("pose", "rotation_rate")
    unit, affects = base.RADIANS_PER_SECOND, base.MOVES
    prior, prior_unit, largest_std = "rotation_rate_std_deg_s", np.pi / 180.0, 1e9
    description = (
        "standard deviation of the angular velocity of a camera that moves, deg/s; one value or about the "
        "camera's own x, y, z"
    )
    on_path = False
    of_the_frame = True

    def pulled(self, view: base.CameraView, pull: base.Pull, values: Array) -> Array:
        """d (point in the camera) / d w = (t - t_0) [point]_x J_left(-(t - t_0) w)."""
        elapsed = view.elapsed[:, None]
        axes = left_jacobians(-elapsed * view.camera.pose.rotation_rate)
        return np.asarray(-elapsed * np.einsum("na,nab->nb", pull.torque, axes))

    def _entry(self, camera: Camera) -> base.Entry:
        rate = np.degrees(camera.pose.rotation_rate).tolist()
        return {"pose": {"rotation_rate_deg_s": rate, "time_s": camera.pose.time_s}}
