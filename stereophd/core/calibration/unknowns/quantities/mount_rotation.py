"""How a body of known trajectory carries a camera: a turn v about the camera's own axes (hand-eye).

The rotation from body to camera axes is exp([v]_x) times that of the prior mean.
"""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import MOVES, RADIANS, CameraView, Entry, Quantity
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import left_jacobians, turned
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.trajectory import MountedPath
from stereophd.core.settings import LARGEST_DEGREES


class _MountRotation(Quantity):
    components = ("mount_rotation_x", "mount_rotation_y", "mount_rotation_z")
    unit, affects = RADIANS, MOVES
    prior, prior_unit, largest_std = "mount_rotation_std_deg", np.pi / 180.0, LARGEST_DEGREES
    description = (
        "standard deviation of the rotation on the body that carries the camera, degrees; one value or about "
        "the camera's own x, y, z"
    )
    on_path = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Turn the camera on its body by a rotation vector (3,), rad; nothing of a camera without a known path."""
        path = camera.pose.path
        if path is None:
            return camera
        moved = MountedPath(path.trajectory, rotation_from_vector(values) @ path.rotation, path.center)
        return replace(camera, pose=Pose.following(moved, camera.pose.time_s))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        if camera.pose.path is None or other.pose.path is None:
            return np.zeros(3)
        return rotation_to_vector(other.pose.path.rotation @ camera.pose.path.rotation.T)

    def derivative(self, view: CameraView, values: Array) -> Array:
        """d (point in the camera) / d v = -[point]_x J_left(v)."""
        if view.camera.pose.path is None:
            return np.zeros((len(view.points), 2, 3))
        return turned(view, left_jacobians(values[None])[0])

    def _entry(self, camera: Camera) -> Entry:
        path = camera.pose.path
        if path is None:
            return {}
        return {"pose": {"mount": {"rotation_matrix": path.rotation.tolist(), "rotation_vector_deg": None}}}


QUANTITY = _MountRotation()
