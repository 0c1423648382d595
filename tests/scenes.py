"""Cameras of tests: one builder, and the places of cameras around a stage that several tests share."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector

#: Centre and rotation vector (rad) of three cameras around a stage in front of them, 8 m away.
AROUND = (
    ((-4.0, 0.0, -8.0), (0.0, -0.4, 0.0)),
    ((4.0, -1.0, -8.0), (0.1, 0.4, 0.0)),
    ((0.0, -4.0, -8.0), (0.4, 0.0, 0.0)),
)


def build_camera(
    name: str, center: ArrayLike = (0.0, 0.0, 0.0), turn: ArrayLike = (0.0, 0.0, 0.0), *,
    size: tuple[int, int] = (800, 600), focal: float | tuple[float, float] = 700.0,
    middle: tuple[float, float] | None = None, noise: float | Sequence[float] = 1.0, p_detect: float = 0.9,
    clutter: float = 1.0, pose: Pose | None = None, **more: Any,
) -> Camera:  # fmt: skip
    """A camera at a place, turned by a rotation vector (rad) or matrix (world to camera), or with a pose of its own.

    The principal point is the middle of the image unless another is stated; `more` goes to `Camera`.
    """
    turn = np.asarray(turn, dtype=np.float64)
    rotation = turn if turn.shape == (3, 3) else rotation_from_vector(turn) if turn.any() else np.eye(3)
    cx, cy = ((size[0] - 1) / 2, (size[1] - 1) / 2) if middle is None else middle
    fx, fy = np.broadcast_to(focal, 2).tolist()
    u, v = np.broadcast_to(noise, 2).tolist()
    pose = Pose(rotation, np.asarray(center, dtype=np.float64)) if pose is None else pose
    values = {"lens": Lens(), "detector": Detector((u, v), p_detect, clutter), **more}
    return Camera(name, *size, fx, fy, cx, cy, pose, **values)
