"""The box around the image of an ellipsoid, in closed form, and its derivative.

An ellipsoid of centre p and shape matrix S (the squares of its half axes along its axes) has the dual quadric
Q* = [[p p^T - S, p], [p^T, 1]]: a plane l touches it if l^T Q* l = 0. Its image under P = [M | m] has the dual conic
C* = P Q* P^T = q q^T - M S M^T with q = M p + m, and a line touches the image if l^T C* l = 0 (R. Hartley and
A. Zisserman, "Multiple View Geometry", 2004, result 8.9). For the vertical line (1, 0, -u) that is
C33 u^2 - 2 C13 u + C11 = 0, whose two roots are the sides of the box; rows likewise. The ellipsoid lies wholly before
the camera where C33 > 0 and q3 > 0.
"""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera

# Columns of a state: position, velocity, logarithms of the half axes along and across the vertical.
POSITION, VELOCITY, LOG_AXES = slice(0, 3), slice(3, 6), slice(6, 8)
STATE_SIZE = 8
# Columns of a box.
U, TOP, BOTTOM, WIDTH = range(4)


def outline_boxes(states: Array, camera: Camera, up: Array) -> tuple[Array, Array]:
    """Project ellipsoids of revolution about `up` (3,), a unit vector in the world, into boxes.

    States (n, 8) are in the world frame, length, length/s and logarithms of lengths; the camera is that at their time.
    Returns boxes (n, 4), middle u, top v, bottom v and width in undistorted px, NaN for a body that is not wholly
    before the camera, and their derivative (n, 4, 8) with respect to the states.
    """
    matrix = camera.projection_matrix
    m = matrix[:, :3]
    q = states[:, POSITION] @ m.T + matrix[:, 3]
    squares = np.exp(2.0 * states[:, LOG_AXES])
    along = np.outer(m @ up, m @ up)
    across = m @ m.T - along
    conic = q[:, :, None] * q[:, None, :] - squares[:, 0, None, None] * along - squares[:, 1, None, None] * across
    # derivatives of the conic with respect to position and half axes: (n, 3, 3, 5)
    slopes = np.empty((len(states), 3, 3, 5))
    by_position = q[:, :, None, None] * m[None, None, :, :]
    slopes[..., :3] = by_position + by_position.swapaxes(1, 2)
    slopes[..., 3] = -2.0 * squares[:, 0, None, None] * along
    slopes[..., 4] = -2.0 * squares[:, 1, None, None] * across
    before = (q[:, 2] > 0.0) & (conic[:, 2, 2] > 0.0)
    scale = np.where(before, conic[:, 2, 2], np.nan)
    scale_slope = slopes[:, 2, 2]
    middle = conic[:, :2, 2] / scale[:, None]
    middle_slope = (slopes[:, :2, 2] - middle[:, :, None] * scale_slope[:, None]) / scale[:, None, None]
    diagonal = conic[:, [0, 1], [0, 1]] / scale[:, None]
    diagonal_slope = (slopes[:, [0, 1], [0, 1]] - diagonal[:, :, None] * scale_slope[:, None]) / scale[:, None, None]
    half = np.sqrt(np.maximum(middle**2 - diagonal, 1e-12))
    half_slope = (2.0 * middle[:, :, None] * middle_slope - diagonal_slope) / (2.0 * half[:, :, None])
    boxes = np.stack([middle[:, 0], middle[:, 1] - half[:, 1], middle[:, 1] + half[:, 1], 2.0 * half[:, 0]], axis=1)
    slope = np.stack(
        [
            middle_slope[:, 0],
            middle_slope[:, 1] - half_slope[:, 1],
            middle_slope[:, 1] + half_slope[:, 1],
            2.0 * half_slope[:, 0],
        ],
        axis=1,
    )
    jacobian = np.zeros((len(states), 4, STATE_SIZE))
    jacobian[:, :, POSITION], jacobian[:, :, LOG_AXES] = slope[:, :, :3], slope[:, :, 3:]
    return boxes, jacobian
