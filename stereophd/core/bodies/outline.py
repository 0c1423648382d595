"""The box around the image of an ellipsoid, in closed form, and its derivative.

An ellipsoid of centre p and shape matrix S (the squares of its half axes along its axes) has the dual quadric
Q* = [[p p^T - S, p], [p^T, 1]]: a plane l touches it if l^T Q* l = 0. Its image under P = [M | m] has the dual conic
C* = P Q* P^T = q q^T - M S M^T with q = M p + m, and a line touches the image if l^T C* l = 0 (R. Hartley and
A. Zisserman, "Multiple View Geometry", 2004, result 8.9). For the vertical line (1, 0, -u) that is
C33 u^2 - 2 C13 u + C11 = 0, whose two roots are the sides of the box; rows likewise. The ellipsoid lies wholly before
the camera where C33 > 0 and q3 > 0.
"""

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.compilation.compiled import compiled

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
    boxes, jacobian = np.full((len(states), 4), np.nan), np.zeros((len(states), 4, STATE_SIZE))
    _outline(np.ascontiguousarray(states), camera.projection_matrix, up, boxes, jacobian)
    return boxes, jacobian


@compiled
def _outline(states: Array, matrix: Array, up: Array, boxes: Array, jacobian: Array) -> None:
    """Fill in boxes (n, 4) and their derivatives (n, 4, 8); `matrix` (3, 4) projects."""
    slopes = np.empty((3, 5))
    middles, halves = np.empty((2, 6)), np.empty((2, 6))
    for n in range(len(states)):
        along, across = math.exp(2.0 * states[n, 6]), math.exp(2.0 * states[n, 7])
        q, axis = np.empty(3), np.empty(3)
        for i in range(3):
            q[i], axis[i] = matrix[i, 3], 0.0
            for k in range(3):
                q[i] += matrix[i, k] * states[n, k]
                axis[i] += matrix[i, k] * up[k]
        scale = _conic(2, 2, q, matrix, axis, along, across, slopes[2])
        if not (q[2] > 0.0 and scale > 0.0):
            continue
        for a in range(2):
            middle = _conic(a, 2, q, matrix, axis, along, across, slopes[0]) / scale
            square = _conic(a, a, q, matrix, axis, along, across, slopes[1]) / scale
            half = math.sqrt(max(middle**2 - square, 1e-12))
            middles[a, 0], halves[a, 0] = middle, half
            for k in range(5):
                middles[a, k + 1] = (slopes[0, k] - middle * slopes[2, k]) / scale
                by_square = (slopes[1, k] - square * slopes[2, k]) / scale
                halves[a, k + 1] = (2.0 * middle * middles[a, k + 1] - by_square) / (2.0 * half)
        for k in range(6):
            values = middles[0, k], middles[1, k] - halves[1, k], middles[1, k] + halves[1, k], 2.0 * halves[0, k]
            for row in range(4):
                if k == 0:
                    boxes[n, row] = values[row]
                else:
                    jacobian[n, row, k - 1 if k < 4 else k + 2] = values[row]


@compiled
def _conic(i: int, j: int, q: Array, matrix: Array, axis: Array, along: float, across: float, slopes: Array) -> float:
    """Entry of the dual conic; its derivatives (5,) by position and logarithms of the half axes into `slopes`."""
    both = 0.0
    for k in range(3):
        both += matrix[i, k] * matrix[j, k]
        slopes[k] = q[i] * matrix[j, k] + q[j] * matrix[i, k]
    upright = axis[i] * axis[j]
    slopes[3], slopes[4] = -2.0 * along * upright, -2.0 * across * (both - upright)
    return float(q[i] * q[j] + (slopes[3] + slopes[4]) / 2.0)
