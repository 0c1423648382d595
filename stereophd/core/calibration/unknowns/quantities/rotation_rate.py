"""The angular velocity w of a moving camera about its own axes: rotation(t) = exp(-[w]_x (t - t_0)) rotation(t_0)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import (
    MOVES,
    RADIANS_PER_SECOND,
    CameraView,
    Quantity,
    without_path,
)
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import left_jacobians, turned
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose

ROTATION_RATE = ("rotation_rate_x", "rotation_rate_y", "rotation_rate_z")


def apply(camera: Camera, values: Array) -> Camera:
    """Add values (3,) to the angular velocity, rad/s; not one on a known path."""
    if camera.pose.path is not None:
        return camera
    pose = camera.pose
    moved = Pose(pose.rotation, pose.center, pose.velocity, pose.rotation_rate + values, pose.time_s)
    return replace(camera, pose=moved)


def difference(camera: Camera, other: Camera) -> Array:
    """Return the difference of the angular velocities."""
    if camera.pose.path is not None:
        return np.zeros(3)
    return np.asarray(other.pose.rotation_rate - camera.pose.rotation_rate)


def derivative(view: CameraView, values: Array) -> Array:
    """d (point in the camera) / d w = (t - t_0) [point]_x J_left(-(t - t_0) w)."""
    elapsed = view.elapsed[:, None]
    axes = left_jacobians(-elapsed * view.camera.pose.rotation_rate)
    return turned(view, -elapsed[:, :, None] * axes)


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the angular velocity in degrees; nothing of a camera on a known path."""
    if camera.pose.path is not None:
        return {}
    rate = np.degrees(camera.pose.rotation_rate).tolist()
    return {"pose": {"rotation_rate_deg_s": rate, "time_s": camera.pose.time_s}}


QUANTITY = Quantity(
    name="rotation_rate",
    components=ROTATION_RATE,
    unit=RADIANS_PER_SECOND,
    prior="rotation_rate_std_deg_s",
    largest_std=1e9,
    prior_unit=np.pi / 180.0,
    description="standard deviation of the angular velocity of a camera that moves, deg/s; one value or about the "
    "camera's own x, y, z",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=MOVES,
    available=without_path(ROTATION_RATE),
    of_the_frame=True,
)
