"""The angular velocity w of a moving camera about its own axes: rotation(t) = exp(-[w]_x (t - t_0)) rotation(t_0)."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import MOVES, RADIANS_PER_SECOND, CameraView, Entry, Quantity
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import left_jacobians, turned
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose


class _RotationRate(Quantity):
    components = ("rotation_rate_x", "rotation_rate_y", "rotation_rate_z")
    unit, affects = RADIANS_PER_SECOND, MOVES
    prior, prior_unit, largest_std = "rotation_rate_std_deg_s", np.pi / 180.0, 1e9
    description = (
        "standard deviation of the angular velocity of a camera that moves, deg/s; one value or about the "
        "camera's own x, y, z"
    )
    on_path = False
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add values (3,) to the angular velocity, rad/s."""
        pose = camera.pose
        moved = Pose(pose.rotation, pose.center, pose.velocity, pose.rotation_rate + values, pose.time_s)
        return replace(camera, pose=moved)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.asarray(other.pose.rotation_rate - camera.pose.rotation_rate)

    def derivative(self, view: CameraView, values: Array) -> Array:
        """d (point in the camera) / d w = (t - t_0) [point]_x J_left(-(t - t_0) w)."""
        elapsed = view.elapsed[:, None]
        axes = left_jacobians(-elapsed * view.camera.pose.rotation_rate)
        return turned(view, -elapsed[:, :, None] * axes)

    def _entry(self, camera: Camera) -> Entry:
        rate = np.degrees(camera.pose.rotation_rate).tolist()
        return {"pose": {"rotation_rate_deg_s": rate, "time_s": camera.pose.time_s}}


QUANTITY = _RotationRate()
