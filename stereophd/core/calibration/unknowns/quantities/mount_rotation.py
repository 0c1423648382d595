"""How a body of known trajectory carries a camera: a turn v about the camera's own axes (hand-eye).

The rotation from body to camera axes is exp([v]_x) times that of the prior mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import MOVES, RADIANS, CameraView, Quantity, on_path
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import left_jacobians, turned
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector
from stereophd.core.geometry.trajectory import MountedPath
from stereophd.core.settings import LARGEST_DEGREES

MOUNT_ROTATION = ("mount_rotation_x", "mount_rotation_y", "mount_rotation_z")


def apply(camera: Camera, values: Array) -> Camera:
    """Turn the camera on its body by a rotation vector (3,), rad; nothing of a camera without a known path."""
    path = camera.pose.path
    if path is None:
        return camera
    moved = MountedPath(path.trajectory, rotation_from_vector(values) @ path.rotation, path.center)
    return replace(camera, pose=Pose.following(moved, camera.pose.time_s))


def difference(camera: Camera, other: Camera) -> Array:
    """Return what turns one camera to the other on the body."""
    if camera.pose.path is None or other.pose.path is None:
        return np.zeros(3)
    return rotation_to_vector(other.pose.path.rotation @ camera.pose.path.rotation.T)


def derivative(view: CameraView, values: Array) -> Array:
    """d (point in the camera) / d v = -[point]_x J_left(v)."""
    if view.camera.pose.path is None:
        return np.zeros((len(view.points), 2, 3))
    return turned(view, left_jacobians(values[None])[0])


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the rotation matrix from body to camera axes; nothing of a camera without a known path."""
    path = camera.pose.path
    if path is None:
        return {}
    return {"pose": {"mount": {"rotation_matrix": path.rotation.tolist(), "rotation_vector_deg": None}}}


QUANTITY = Quantity(
    name="mount_rotation",
    components=MOUNT_ROTATION,
    unit=RADIANS,
    prior="mount_rotation_std_deg",
    largest_std=LARGEST_DEGREES,
    prior_unit=np.pi / 180.0,
    description="standard deviation of the rotation on the body that carries the camera, degrees; one value or about "
    "the camera's own x, y, z",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=MOVES,
    available=on_path(MOUNT_ROTATION),
)
