"""The rotation of a camera: a rotation vector v in the camera's own axes, rotation = exp([v]_x) rotation_0.

So rotation_x is pitch, rotation_y yaw and rotation_z roll.
"""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import MOVES, RADIANS, CameraView, Entry, Quantity
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import left_jacobians, turned
from stereophd.core.geometry import layout
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.rotations import rotations
from stereophd.core.settings import LARGEST_DEGREES

ROTATION = ("rotation_x", "rotation_y", "rotation_z")


class _Rotation(Quantity):
    components = ROTATION
    unit, affects = RADIANS, MOVES
    prior, prior_unit, largest_std = "rotation_std_deg", np.pi / 180.0, LARGEST_DEGREES
    description = (
        "standard deviation of the rotation, degrees; one value or about the camera's own x (pitch), y (yaw), z (roll)"
    )
    on_path = False
    of_the_frame = True
    has_pack = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Turn the camera by a rotation vector (3,), rad."""
        pose = camera.pose
        turn = rotation_from_vector(values)
        moved = Pose(turn @ pose.rotation, pose.center, pose.velocity, pose.rotation_rate, pose.time_s)
        return replace(camera, pose=moved)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        """Return what turns one camera to the other, both at the time of the first pose."""
        return rotation_to_vector(other.pose.at(camera.pose.time_s).rotation @ camera.pose.rotation.T)

    def derivative(self, view: CameraView, values: Array) -> Array:
        """d (point in the camera) / d v = -[point]_x turn J_left(v)."""
        axes = left_jacobians(values[None])[0]
        return turned(view, axes if view.turns is None else view.turns @ axes)

    def _entry(self, camera: Camera) -> Entry:
        return {"pose": {"rotation_matrix": camera.pose.rotation.tolist(), "rotation_vector_deg": None}}

    def pack(self, spaces: Array, camera: Camera, values: Array) -> None:
        """Turn packed cameras."""
        turn = rotations(values)
        spaces[:, layout.ROTATION : layout.ROTATION + 9] = (turn @ camera.pose.rotation).reshape(-1, 9)


QUANTITY = _Rotation()
