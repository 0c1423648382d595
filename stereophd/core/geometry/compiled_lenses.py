"""Compiled scalar kernels of the lens models and of the in-view test (numba).

They compile the formulas of `stereophd.core.geometry.lenses`, and invert them. Other compiled kernels call them, and
LLVM inlines them there; `distort_points` and `undistort_points` loop over points for `stereophd.core.geometry.lens`.
Points are normalised image coordinates (x / z, y / z) in the camera's axes. All lens models are written as one family,

    x_d = x g(s) + 2 p1 x y + p2 (s + 2 x^2),    y_d = y g(s) + p1 (s + 2 y^2) + 2 p2 x y,

with s = x^2 + y^2 and g the ratio r_d / r of the model: the rational polynomial of Brown-Conrady (of which
one-parameter radial is the case k1), or theta_d / r of the fisheye model, which has p1 = p2 = 0.

Sources: OpenCV, camera calibration module and fisheye module; D. C. Brown, "Decentering distortion of
lenses", 1966; J. Kannala and S. Brandt, "A generic camera model", IEEE TPAMI 28 (8), 2006.
"""

import math

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.layout import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    LENS_CODE,
    LENS_COEFFICIENTS,
    LENS_FISHEYE,
    LENS_NONE,
    MAX_RADIUS,
    WIDTH,
)
from stereophd.core.geometry.lenses import brown_conrady, fisheye
from stereophd.core.numerics.compilation.compiled import compiled

# An inverse beyond this radius is 89.99999 degrees off the axis: as good as not invertible.
LARGEST_RADIUS = 1e8
MAX_ITERATIONS = 100
MAX_HALVINGS = 40
# Relative change of the solution at which Newton's iteration ends: a few units in the last place.
STEP_TOLERANCE = 1e-15
# Largest residual of an accepted inverse, relative to 1 + |distorted point|.
RESIDUAL_TOLERANCE = 1e-12


# The formulas, by lens: `_scale` chooses among them.
_fisheye = compiled(fisheye.scale)
_brown_conrady = compiled(brown_conrady.scale)


@compiled
def _scale(code: int, c: Array, start: int, s: float) -> tuple[float, float]:
    """Return g = r_d / r and dg/ds at the squared radius s, with the coefficients at c[start : start + 8]."""
    if code == LENS_FISHEYE:
        return _fisheye(c, start, s)
    return _brown_conrady(c, start, s)


@compiled
def _tangential(code: int, c: Array, start: int) -> tuple[float, float]:
    """Return p1 and p2 (zero for the fisheye model, which keeps k3 and k4 in their places)."""
    if code == LENS_FISHEYE:
        return 0.0, 0.0
    return c[start + 2], c[start + 3]


@compiled
def _distort(code: int, c: Array, start: int, x: float, y: float) -> tuple[float, float]:
    """Distort one normalised point; whether it lies within the lens's max_radius is not checked.

    The lens has a model, a ``LENS_`` constant of `stereophd.core.geometry.layout`, and coefficients c[start : start +
    8] (no slice, hence no reference count): k1, k2, p1, p2, k3, k4, k5, k6; of a fisheye k1, k2, k3, k4 in the first
    four.
    """
    if code == LENS_NONE:
        return x, y
    s = x * x + y * y
    g, _ = _scale(code, c, start, s)
    p1, p2 = _tangential(code, c, start)
    x_d = x * g + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    y_d = y * g + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    return x_d, y_d


@compiled
def distort_point_jacobian(
    code: int, coefficients: Array, x: float, y: float
) -> tuple[float, float, float, float, float, float]:
    """Distort one normalised point as `_distort`; return it with the rows of d(x_d, y_d) / d(x, y)."""
    s = x * x + y * y
    g, g_slope = _scale(code, coefficients, 0, s)
    p1, p2 = _tangential(code, coefficients, 0)
    x_d = x * g + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
    y_d = y * g + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
    j00 = g + 2.0 * x * x * g_slope + 2.0 * p1 * y + 6.0 * p2 * x
    j01 = 2.0 * x * y * g_slope + 2.0 * p1 * x + 2.0 * p2 * y
    j11 = g + 2.0 * y * y * g_slope + 6.0 * p1 * y + 2.0 * p2 * x
    # The Jacobian of this family is symmetric: the map is the gradient of a potential.
    return x_d, y_d, j00, j01, j01, j11


@compiled
def _undistort_radius(code: int, c: Array, max_radius: float, r_d: float) -> float:
    """Invert r -> r_d on [0, max_radius] by Newton's iteration kept inside a bracket; NaN beyond it."""
    if not r_d > 0.0:
        return 0.0 if r_d == 0.0 else math.nan
    low, high = 0.0, min(max_radius, 1.0)
    while high * _scale(code, c, 0, high * high)[0] < r_d:
        low = high
        high = 2.0 * high
        if low >= max_radius or high > LARGEST_RADIUS:
            return math.nan
        high = min(high, max_radius)
    r = min(max(r_d, low), high)
    for _ in range(MAX_ITERATIONS):
        g, g_slope = _scale(code, c, 0, r * r)
        residual = r * g - r_d
        if residual > 0.0:
            high = r
        else:
            low = r
        following = r - residual / (g + 2.0 * r * r * g_slope)
        if not (low <= following <= high):
            following = 0.5 * (low + high)
        step = abs(following - r)
        r = following
        if step <= STEP_TOLERANCE * r:
            break
    return r


@compiled
def _undistort_newton(code: int, c: Array, x_d: float, y_d: float, x: float, y: float) -> tuple[float, float]:
    """Refine an undistorted point by Newton's iteration in the plane, halving steps that do not help."""
    for _ in range(MAX_ITERATIONS):
        a, b, j00, j01, j10, j11 = distort_point_jacobian(code, c, x, y)
        residual_x, residual_y = a - x_d, b - y_d
        determinant = j00 * j11 - j01 * j10
        step_x = (j11 * residual_x - j01 * residual_y) / determinant
        step_y = (j00 * residual_y - j10 * residual_x) / determinant
        error = residual_x * residual_x + residual_y * residual_y
        factor = 1.0
        improved = False
        for _ in range(MAX_HALVINGS):
            a, b = _distort(code, c, 0, x - factor * step_x, y - factor * step_y)
            if (a - x_d) ** 2 + (b - y_d) ** 2 < error:
                improved = True
                break
            factor *= 0.5
        if not improved:
            break
        x -= factor * step_x
        y -= factor * step_y
        if math.hypot(step_x, step_y) <= STEP_TOLERANCE * math.hypot(x, y):
            break
    return x, y


@compiled
def undistort_point(code: int, coefficients: Array, max_radius: float, x_d: float, y_d: float) -> tuple[float, float]:
    """Undistort one normalised point of a lens as that of `_distort`.

    The result lies within `max_radius`, up to which the radial map is monotone (`Lens.max_radius`); NaN if there is
    none.
    """
    if code == LENS_NONE:
        return x_d, y_d
    r_d = math.hypot(x_d, y_d)
    r = _undistort_radius(code, coefficients, max_radius, r_d)
    p1, p2 = _tangential(code, coefficients, 0)
    if r == 0.0 or (p1 == 0.0 and p2 == 0.0):
        scale = r / r_d if r > 0.0 else r
        return x_d * scale, y_d * scale
    if not math.isfinite(r_d):
        return math.nan, math.nan
    # Tangential distortion can bring a point back whose radius alone has no inverse: start inside.
    scale = (r if r > 0.0 else 0.99 * min(max_radius, LARGEST_RADIUS)) / r_d
    x, y = _undistort_newton(code, coefficients, x_d, y_d, x_d * scale, y_d * scale)
    a, b, j00, j01, j10, j11 = distort_point_jacobian(code, coefficients, x, y)
    accepted = (
        math.hypot(a - x_d, b - y_d) <= RESIDUAL_TOLERANCE * (1.0 + r_d)
        and x * x + y * y <= max_radius * max_radius
        and j00 > 0.0
        and j00 * j11 - j01 * j10 > 0.0
    )
    if accepted:
        return x, y
    return math.nan, math.nan


@compiled
def pixel_in_view(camera: Array, u: float, v: float) -> bool:
    """Whether a packed camera (28,) sees a point of positive depth, given its undistorted pixel (u, v).

    It does if the distorted pixel is inside the image, ``-0.5 <= u_d <= width - 0.5`` and likewise v, and the point is
    within the lens's max_radius; not for NaN.
    """
    code = int(camera[LENS_CODE])
    if code != LENS_NONE:
        x = (u - camera[CX]) / camera[FX]
        y = (v - camera[CY]) / camera[FY]
        if not x * x + y * y <= camera[MAX_RADIUS] * camera[MAX_RADIUS]:
            return False
        x, y = _distort(code, camera, LENS_COEFFICIENTS, x, y)
        u = camera[FX] * x + camera[CX]
        v = camera[FY] * y + camera[CY]
    # Without short circuits: the outcome is hard to predict at the edge of an image, four branches cost more.
    inside = (u >= -0.5) & (u <= camera[WIDTH] - 0.5) & (v >= -0.5) & (v <= camera[HEIGHT] - 0.5)
    return bool(inside)


@compiled
def distort_points(code: int, coefficients: Array, xy: Array) -> tuple[Array, Array]:
    """Distort points (n, 2); returns the distorted points (n, 2) and the Jacobians (n, 2, 2)."""
    n = xy.shape[0]
    result = np.empty((n, 2))
    jacobian = np.empty((n, 2, 2))
    for i in range(n):
        x_d, y_d, j00, j01, j10, j11 = distort_point_jacobian(code, coefficients, xy[i, 0], xy[i, 1])
        result[i, 0], result[i, 1] = x_d, y_d
        jacobian[i, 0, 0], jacobian[i, 0, 1] = j00, j01
        jacobian[i, 1, 0], jacobian[i, 1, 1] = j10, j11
    return result, jacobian


@compiled
def undistort_points(code: int, coefficients: Array, max_radius: float, xy_d: Array) -> tuple[Array, Array]:
    """Undistort points (n, 2); returns the points (n, 2) and the Jacobians d xy / d xy_d (n, 2, 2)."""
    n = xy_d.shape[0]
    result = np.empty((n, 2))
    jacobian = np.empty((n, 2, 2))
    for i in range(n):
        x, y = undistort_point(code, coefficients, max_radius, xy_d[i, 0], xy_d[i, 1])
        _, _, j00, j01, j10, j11 = distort_point_jacobian(code, coefficients, x, y)
        determinant = j00 * j11 - j01 * j10
        result[i, 0], result[i, 1] = x, y
        jacobian[i, 0, 0], jacobian[i, 0, 1] = j11 / determinant, -j01 / determinant
        jacobian[i, 1, 0], jacobian[i, 1, 1] = -j10 / determinant, j00 / determinant
    return result, jacobian
