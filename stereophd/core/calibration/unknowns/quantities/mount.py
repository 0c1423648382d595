"""How a body of known trajectory carries a camera (hand-eye)."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities import base
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.rotations import left_jacobians
from stereophd.core.geometry.trajectory import MountedPath
from stereophd.core.settings import LARGEST_DEGREES


def _path(camera: Camera) -> MountedPath:
    assert camera.pose.path is not None
    return camera.pose.path


def _mounted(camera: Camera, rotation: Array, center: Array) -> Camera:
    path = MountedPath(_path(camera).trajectory, rotation, center)
    return replace(camera, pose=Pose.following(path, camera.pose.time_s))


class MountCenter(base.Quantity):
    """Where a body of known trajectory carries a camera: the optical centre in the body's axes (hand-eye)."""

    name = "mount_center"
    components = ("mount_center_x", "mount_center_y", "mount_center_z")
    unit, affects = base.LENGTH, base.MOVES
    prior = "mount_center_std"
    description = (
        "standard deviation of the centre on the body that carries the camera, length; one value or x, y, z of the body"
    )
    on_path = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        return _mounted(camera, _path(camera).rotation, _path(camera).center + values)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.asarray(_path(other).center - _path(camera).center)

    def pulled(self, view: base.CameraView, pull: base.Pull, values: Array) -> Array:
        """Moving the camera on the body moves the point the other way, turned from the body's axes to the camera's."""
        return -pull.turned_force @ _path(view.camera).rotation

    def _entry(self, camera: Camera) -> base.Entry:
        return {"pose": {"mount": {"center": _path(camera).center.tolist()}}}


class MountRotation(base.Quantity):
    """How a body of known trajectory carries a camera: a turn v about the camera's own axes (hand-eye).

    The rotation from body to camera axes is exp([v]_x) times that of the prior mean.
    """

    name = "mount_rotation"
    components = ("mount_rotation_x", "mount_rotation_y", "mount_rotation_z")
    unit, affects = base.RADIANS, base.MOVES
    prior, prior_unit, largest_std = "mount_rotation_std_deg", np.pi / 180.0, LARGEST_DEGREES
    description = (
        "standard deviation of the rotation on the body that carries the camera, degrees; one value or about "
        "the camera's own x, y, z"
    )
    on_path = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        return _mounted(camera, rotation_from_vector(values) @ _path(camera).rotation, _path(camera).center)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return rotation_to_vector(_path(other).rotation @ _path(camera).rotation.T)

    def pulled(self, view: base.CameraView, pull: base.Pull, values: Array) -> Array:
        """d (point in the camera) / d v = -[point]_x J_left(v)."""
        return np.asarray(pull.torque @ left_jacobians(values[None])[0])

    def _entry(self, camera: Camera) -> base.Entry:
        return {"pose": {"mount": {"rotation_matrix": _path(camera).rotation.tolist(), "rotation_vector_deg": None}}}
