"""Projection matrices, as direct linear transformations and others state them, taken apart into cameras.

``(u, v, 1) ~ P (X, Y, Z, 1)`` with ``P = K [R | -R C]``. A matrix is defined up to a factor: its sign decides which
side of the camera is the front, and for a world that is left-handed no rotation R has the scene in front.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.projection import nearest_points
from stereophd.errors import InputError

#: Turns a left-handed world into a right-handed one.
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Decomposed:
    """A projection matrix in parts: K (3, 3) with skew K[0, 1] and K[2, 2] = 1, rotation, and centre."""

    matrix: Array
    rotation: Array
    center: Array

    @property
    def skew_slope(self) -> float:
        """Shift of u by the skew per row below the principal point, px per px."""
        return float(self.matrix[0, 1] / self.matrix[1, 1])

    def upright(self, pixels: Array) -> Array:
        """Return pixels (..., 2) as the camera without its skew would have them."""
        result = pixels.copy()
        result[..., 0] -= self.skew_slope * (result[..., 1] - self.matrix[1, 2])
        return result

    def depth(self, points: Array) -> Array:
        """Return the depths (n,) of world points (n, 3)."""
        return np.asarray((points - self.center) @ self.rotation[2], dtype=np.float64)


def decompose(projection: Array, where: str) -> Decomposed:
    """Take a projection matrix (3, 4) apart, with positive focal lengths and a proper rotation.

    Raises InputError when the matrix has no centre of projection.
    """
    from scipy.linalg import rq

    left = projection[:, :3]
    if not np.isfinite(projection).all() or np.linalg.cond(left) > 1e15:
        raise InputError(f"{where}: expected a camera's projection, found a singular matrix")
    matrix, rotation = rq(left * np.sign(np.linalg.det(left)))
    signs = np.sign(np.diag(matrix))
    matrix, rotation = matrix * signs, signs[:, None] * rotation
    center: Array = -np.linalg.solve(left, projection[:, 3]).astype(np.float64)
    return Decomposed(matrix / matrix[2, 2], rotation, center)


def is_left_handed(cameras: Sequence[Decomposed], points: Array | None) -> bool:
    """Whether the world of some cameras (with proper rotations) is left-handed: the scene lies behind most of them.

    The scene are the world points (n, 3) that they see; without them it is the point nearest to all optical axes, or
    the origin if they are parallel.
    """
    if points is None or not len(points):
        centers, axes = np.array([c.center for c in cameras]), np.array([c.rotation[2] for c in cameras])
        scene = nearest_points(axes, centers, np.zeros(len(axes), dtype=np.int64), 1, 1e3)
        points = np.nan_to_num(scene)
    behind = [float(np.median(np.sign(camera.depth(points)))) for camera in cameras]
    return sum(behind) < 0


def triangulate(projections: Sequence[Array], pixels: Array) -> Array:
    """Return world points of pixels (n, cameras, 2); those that fewer than two cameras see are left out."""
    inverses = np.linalg.inv([projection[:, :3] for projection in projections])
    centers = -np.einsum("kij,kj->ki", inverses, [projection[:, 3] for projection in projections])
    row, camera = np.nonzero(np.isfinite(pixels).all(axis=2))
    seen = np.column_stack([pixels[row, camera], np.ones(len(row))])
    points = nearest_points(np.einsum("nij,nj->ni", inverses[camera], seen), centers[camera], row, len(pixels))
    return points[np.isfinite(points).all(axis=1)]
