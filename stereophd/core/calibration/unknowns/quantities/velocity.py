"""The velocity of a moving camera's centre in the world."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import (
    LENGTH_PER_SECOND,
    MOVES,
    CameraView,
    Quantity,
    without_path,
)
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose

VELOCITY = ("velocity_x", "velocity_y", "velocity_z")


def apply(camera: Camera, values: Array) -> Camera:
    """Add values (3,) to the velocity, length/s; not one on a known path."""
    if camera.pose.path is not None:
        return camera
    pose = camera.pose
    moved = Pose(pose.rotation, pose.center, pose.velocity + values, pose.rotation_rate, pose.time_s)
    return replace(camera, pose=moved)


def difference(camera: Camera, other: Camera) -> Array:
    """Return the difference of the velocities."""
    if camera.pose.path is not None:
        return np.zeros(3)
    return np.asarray(other.pose.velocity - camera.pose.velocity)


def derivative(view: CameraView, values: Array) -> Array:
    """The centre moves by the velocity times the time since that of the pose."""
    return -view.elapsed[:, None, None] * view.by_world


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the velocity; nothing of a camera on a known path."""
    if camera.pose.path is not None:
        return {}
    return {"pose": {"velocity": camera.pose.velocity.tolist(), "time_s": camera.pose.time_s}}


QUANTITY = Quantity(
    name="velocity",
    components=VELOCITY,
    unit=LENGTH_PER_SECOND,
    prior="velocity_std",
    description="standard deviation of the velocity of a camera that moves, length/s; one value or x, y, z",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=MOVES,
    available=without_path(VELOCITY),
    of_the_frame=True,
)
