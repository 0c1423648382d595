"""Where a body of known trajectory carries a camera: the optical centre in the body's axes (hand-eye)."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import LENGTH, MOVES, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose
from stereophd.core.geometry.trajectory import MountedPath


class _MountCenter(Quantity):
    components = ("mount_center_x", "mount_center_y", "mount_center_z")
    unit, affects = LENGTH, MOVES
    prior = "mount_center_std"
    description = (
        "standard deviation of the centre on the body that carries the camera, length; one value or x, y, z of the body"
    )
    on_path = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Move the camera on its body by values (3,); nothing of a camera without a known path."""
        path = camera.pose.path
        if path is None:
            return camera
        moved = MountedPath(path.trajectory, path.rotation, path.center + values)
        return replace(camera, pose=Pose.following(moved, camera.pose.time_s))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        if camera.pose.path is None or other.pose.path is None:
            return np.zeros(3)
        return np.asarray(other.pose.path.center - camera.pose.path.center)

    def derivative(self, view: CameraView, values: Array) -> Array:
        """Moving the camera on the body moves the point the other way, turned from the body's axes to the camera's."""
        path = view.camera.pose.path
        if path is None:
            return np.zeros((len(view.points), 2, 3))
        return -view.by_point @ path.rotation

    def _entry(self, camera: Camera) -> Entry:
        path = camera.pose.path
        return {} if path is None else {"pose": {"mount": {"center": path.center.tolist()}}}


QUANTITY = _MountCenter()
