"""The rotation of a camera: a rotation vector v in the camera's own axes, rotation = exp([v]_x) rotation_0.

So rotation_x is pitch, rotation_y yaw and rotation_z roll.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import MOVES, RADIANS, CameraView, Quantity, without_path
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import left_jacobians, turned
from stereophd.core.geometry import layout
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.rotations import rotations
from stereophd.core.settings import LARGEST_DEGREES

ROTATION = ("rotation_x", "rotation_y", "rotation_z")


def apply(camera: Camera, values: Array) -> Camera:
    """Turn the camera by a rotation vector (3,), rad; not one on a known path."""
    if camera.pose.path is not None:
        return camera
    pose = camera.pose
    turn = rotation_from_vector(values)
    moved = Pose(turn @ pose.rotation, pose.center, pose.velocity, pose.rotation_rate, pose.time_s)
    return replace(camera, pose=moved)


def difference(camera: Camera, other: Camera) -> Array:
    """Return what turns one camera to the other, both at the time of the first pose."""
    if camera.pose.path is not None:
        return np.zeros(3)
    return rotation_to_vector(other.pose.at(camera.pose.time_s).rotation @ camera.pose.rotation.T)


def derivative(view: CameraView, values: Array) -> Array:
    """d (point in the camera) / d v = -[point]_x turn J_left(v)."""
    axes = left_jacobians(values[None])[0]
    return turned(view, axes if view.turns is None else view.turns @ axes)


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the rotation matrix; nothing of a camera on a known path."""
    if camera.pose.path is not None:
        return {}
    return {"pose": {"rotation_matrix": camera.pose.rotation.tolist(), "rotation_vector_deg": None}}


def pack(spaces: Array, camera: Camera, values: Array) -> None:
    """Turn packed cameras."""
    turn = rotations(values)
    spaces[:, layout.ROTATION : layout.ROTATION + 9] = (turn @ camera.pose.rotation).reshape(-1, 9)


QUANTITY = Quantity(
    name="rotation",
    components=ROTATION,
    unit=RADIANS,
    prior="rotation_std_deg",
    largest_std=LARGEST_DEGREES,
    prior_unit=np.pi / 180.0,
    description="standard deviation of the rotation, degrees; one value or about the camera's own x (pitch), y (yaw), "
    "z (roll)",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=MOVES,
    available=without_path(ROTATION),
    of_the_frame=True,
    pack=pack,
)
