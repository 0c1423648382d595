"""Projections with their derivatives: of points in a camera's axes, and by projective matrices; and where rays meet.

These are the parts. `calibration.unknowns.quantities.pixel_derivatives.view_of` is the whole derivative of the
distorted pixel: through the lens, and by the pose, the motion of object and camera, and time.
"""

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers


def pinhole(points: Array, focal: Array) -> tuple[Array, Array]:
    """Project points (n, 3) in a camera's axes onto the plane at depth 1, with the derivative of their pixels.

    Returns the slopes (n, 2), x / z and y / z, and the derivative (n, 2, 3) of the undistorted pixel with focal lengths
    (2,), px per unit of the points, at the scale given. Defined behind the camera too; infinite or NaN at depth 0.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / points[:, 2]
        slopes = points[:, :2] * inverse[:, None]
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0], by_point[:, 1, 1] = focal[0] * inverse, focal[1] * inverse
        by_point[:, :, 2] = -focal * slopes * inverse[:, None]
    return slopes, by_point


def projective(matrix: Array, points: Array) -> tuple[Array, Array]:
    """Map points (n, 3) by a projective matrix, with the derivative (n, k, 3) of the images (n, k).

    The matrix (k + 1, 4), or one for each point, leads from homogeneous points to homogeneous images: a camera's
    projection, or a map between spaces. With its rows P and p the image is ``y = P (x, 1) / s``, ``s = p (x, 1)``, and
    its derivative ``(P - y p) / s``. Images are infinite or NaN where s is 0.
    """
    if matrix.ndim == 2:
        homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
        matrix = matrix[None]
    else:
        homogeneous = np.einsum("nij,nj->ni", matrix[:, :, :3], points) + matrix[:, :, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        images = homogeneous[:, :-1] / homogeneous[:, -1:]
        slopes = matrix[:, :-1, :3] - images[:, :, None] * matrix[:, -1, None, :3]
        return images, np.asarray(slopes / homogeneous[:, -1, None, None])


def nearest_points(rays: Array, centers: Array, owners: Integers, count: int, worst: float = 1e9) -> Array:
    """Points (p, 3) nearest to all of their rays: those through centres (n, 3) in the directions (n, 3) of some length.

    The point of each ray is one of `owners` (n,), from 0 to `count` less one. A row has NaN where a ray has, or where
    the rays leave the point open: where the condition number is above the worst.
    """
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays) / (rays**2).sum(axis=1)[:, None, None]
    matrix, vector = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(matrix, owners, across)
    np.add.at(vector, owners, np.einsum("nij,nj->ni", across, centers))
    points = np.full((count, 3), np.nan)
    meet: Booleans = np.asarray(np.isfinite(matrix).all(axis=(1, 2)), dtype=np.bool_)
    sizes = np.linalg.eigvalsh(matrix[meet])
    meet[meet] = sizes[:, 0] * worst > sizes[:, 2]
    points[meet] = np.linalg.solve(matrix[meet], vector[meet, :, None])[:, :, 0]
    return points
