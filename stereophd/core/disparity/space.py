"""Disparity space of a camera and its abstract rectified companion (paper III, V-B).

A point is ``y = (u, v, d)``: the undistorted pixel of the camera and the disparity
``d = f * baseline / z`` towards a companion that differs from it only by the baseline, beside the
camera (horizontal rectification, ``f = fx``) or below it (vertical, ``f = fy``). With velocity the
state is ``(u, v, d, du, dv, dd)``, per second. ``d <= 0`` is at or beyond infinity.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.layout import PACKED_SIZE as CAMERA_SIZE
from stereophd.core.geometry.projection import projective

# Layout of a packed space: Camera.packed() first, then these two.
BASELINE = CAMERA_SIZE
VERTICAL = CAMERA_SIZE + 1
PACKED_SIZE = CAMERA_SIZE + 2


@dataclass(frozen=True)
class DisparitySpace:
    """Disparity space of one camera: the extension of its undistorted image, frozen at one time.

    `baseline` is the distance to the abstract companion, in the unit of length of the world; `rectification`
    (horizontal or vertical) is the direction of the baseline in the image.
    """

    camera: Camera
    baseline: float = 1.0
    rectification: Literal["horizontal", "vertical"] = "horizontal"

    @property
    def disparity_focal(self) -> float:
        """Focal length along the baseline, px."""
        return self.camera.fx if self.rectification == "horizontal" else self.camera.fy

    @property
    def projective_matrix(self) -> Array:
        """``P_d`` (4, 4) of eq. (3): homogeneous world (x, y, z, 1) to homogeneous (u, v, d, 1)."""
        u, v, depth = self.camera.projection_matrix
        # the companion, K [I | t] with t the baseline along its axis, sees a point d further along it
        return np.stack([u, v, [0.0, 0.0, 0.0, self.disparity_focal * self.baseline], depth])

    @property
    def inverse_projective_matrix(self) -> Array:
        """Inverse of `projective_matrix`, in closed form."""
        camera = self.camera
        scale = 1.0 / (self.disparity_focal * self.baseline)
        # (u, v, d, 1) -> camera coordinates (x, y, z, 1) up to scale: rays on top, inverse depth below
        to_camera = np.array(
            [
                [1.0 / camera.fx, 0.0, 0.0, -camera.cx / camera.fx],
                [0.0, 1.0 / camera.fy, 0.0, -camera.cy / camera.fy],
                [0.0, 0.0, 0.0, 1.0],
                [0.0, 0.0, scale, 0.0],
            ]
        )
        to_world = np.eye(4)
        to_world[:3, :3] = camera.pose.rotation.T
        to_world[:3, 3] = camera.pose.center
        return np.asarray(to_world @ to_camera)

    def from_world(self, states: Array) -> Array:
        """Map world states (n, 3) or (n, 6) to this space (eq. 2).

        Returns states of the same shape; the position is undefined (infinite) only at depth 0.
        """
        return _project(self.projective_matrix, np.atleast_2d(states))

    def to_world(self, states: Array) -> Array:
        """Map states of this space (n, 3) or (n, 6) to the world; infinite where d = 0."""
        return _project(self.inverse_projective_matrix, np.atleast_2d(states))

    def packed(self) -> Array:
        """Return the space as the flat array (30,) that the compiled kernels read."""
        vertical = float(self.rectification == "vertical")
        return np.concatenate([self.camera.packed(), [self.baseline, vertical]])


def _project(matrix: Array, states: Array) -> Array:
    """Apply a homography (4, 4) to points (n, 3), and its differential to velocities, if (n, 6)."""
    mapped, derivative = projective(matrix, states[:, :3])
    if states.shape[1] == 3:
        return mapped
    return np.concatenate([mapped, np.einsum("nij,nj->ni", derivative, states[:, 3:])], axis=1)
