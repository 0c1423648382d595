"""The optical centre of a camera: an offset in the world's axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import LENGTH, MOVES, CameraView, Quantity, without_path
from stereophd.core.geometry import layout
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose

CENTER = ("center_x", "center_y", "center_z")


def apply(camera: Camera, values: Array) -> Camera:
    """Move the centre by values (3,); not one on a known path."""
    if camera.pose.path is not None:
        return camera
    pose = camera.pose
    moved = Pose(pose.rotation, pose.center + values, pose.velocity, pose.rotation_rate, pose.time_s)
    return replace(camera, pose=moved)


def difference(camera: Camera, other: Camera) -> Array:
    """Return what moves one centre to the other, both at the time of the first pose."""
    if camera.pose.path is not None:
        return np.zeros(3)
    return np.asarray(other.pose.at(camera.pose.time_s).center - camera.pose.center)


def derivative(view: CameraView, values: Array) -> Array:
    """Moving the camera moves the point the other way."""
    return -view.by_world


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the centre; nothing of a camera on a known path."""
    if camera.pose.path is not None:
        return {}
    return {"pose": {"center": camera.pose.center.tolist()}}


def pack(spaces: Array, camera: Camera, values: Array) -> None:
    """Move the centres of packed cameras."""
    spaces[:, layout.CENTER : layout.CENTER + 3] += values


QUANTITY = Quantity(
    name="center",
    components=CENTER,
    unit=LENGTH,
    prior="center_std",
    description="standard deviation of the centre, length; one value or x, y, z",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=MOVES,
    available=without_path(CENTER),
    of_the_frame=True,
    pack=pack,
)
