"""The optical centre of a camera: an offset in the world's axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import LENGTH, MOVES, CameraView, Entry, Quantity
from stereophd.core.geometry import layout
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose

CENTER = ("center_x", "center_y", "center_z")


class _Center(Quantity):
    components = CENTER
    unit, affects = LENGTH, MOVES
    prior = "center_std"
    description = "standard deviation of the centre, length; one value or x, y, z"
    on_path = False
    of_the_frame = True
    has_pack = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Move the centre by values (3,)."""
        pose = camera.pose
        moved = Pose(pose.rotation, pose.center + values, pose.velocity, pose.rotation_rate, pose.time_s)
        return replace(camera, pose=moved)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        """Return what moves one centre to the other, both at the time of the first pose."""
        return np.asarray(other.pose.at(camera.pose.time_s).center - camera.pose.center)

    def derivative(self, view: CameraView, values: Array) -> Array:
        """Moving the camera moves the point the other way."""
        return -view.by_world

    def _entry(self, camera: Camera) -> Entry:
        return {"pose": {"center": camera.pose.center.tolist()}}

    def pack(self, spaces: Array, camera: Camera, values: Array) -> None:
        """Move the centres of packed cameras."""
        spaces[:, layout.CENTER : layout.CENTER + 3] += values


QUANTITY = _Center()
