"""The velocity of a moving camera's centre in the world."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import LENGTH_PER_SECOND, MOVES, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose


class _Velocity(Quantity):
    components = ("velocity_x", "velocity_y", "velocity_z")
    unit, affects = LENGTH_PER_SECOND, MOVES
    prior = "velocity_std"
    description = "standard deviation of the velocity of a camera that moves, length/s; one value or x, y, z"
    on_path = False
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add values (3,) to the velocity, length/s."""
        pose = camera.pose
        moved = Pose(pose.rotation, pose.center, pose.velocity + values, pose.rotation_rate, pose.time_s)
        return replace(camera, pose=moved)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.asarray(other.pose.velocity - camera.pose.velocity)

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The centre moves by the velocity times the time since that of the pose."""
        return -view.elapsed[:, None, None] * view.by_world

    def _entry(self, camera: Camera) -> Entry:
        return {"pose": {"velocity": camera.pose.velocity.tolist(), "time_s": camera.pose.time_s}}


QUANTITY = _Velocity()
