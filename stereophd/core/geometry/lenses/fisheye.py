"""Distortion model ``fisheye``: OpenCV's fisheye model (J. Kannala and S. Brandt, IEEE TPAMI 28 (8), 2006)."""

import math
from typing import Literal

from stereophd.core.arrays import Array
from stereophd.core.geometry.layout import LENS_FISHEYE
from stereophd.core.geometry.lenses.base import FOLD_MARGIN, Coefficient, LensModel, smallest_positive_root
from stereophd.core.settings import parameter, settings

# Below this squared radius theta_d / r is 1 + (k1 - 1/3) s to full double precision (next term s^2).
SERIES_LIMIT = 1e-8


@settings
class FisheyeDistortion:
    """OpenCV's fisheye model: theta_d = theta (1 + k1 theta^2 + ... + k4 theta^8)."""

    model: Literal["fisheye"] = parameter("the lens model", default="fisheye")
    k1: Coefficient = parameter("coefficient of theta^2, where theta is the angle from the axis", default=0.0)
    k2: Coefficient = parameter("coefficient of theta^4", default=0.0)
    k3: Coefficient = parameter("coefficient of theta^6", default=0.0)
    k4: Coefficient = parameter("coefficient of theta^8", default=0.0)


def scale(c: Array, start: int, s: float) -> tuple[float, float]:
    """Return g = theta_d / r and dg/ds at the squared radius s, with the coefficients at c[start : start + 4]."""
    k1, k2, k3, k4 = c[start], c[start + 1], c[start + 2], c[start + 3]
    if s < SERIES_LIMIT:
        return 1.0 + (k1 - 1.0 / 3.0) * s, k1 - 1.0 / 3.0
    r = math.sqrt(s)
    theta = math.atan(r)
    t = theta * theta
    g = theta * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) / r
    slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    return g, (slope / (1.0 + s) - g) / (2.0 * s)


def max_radius(coefficients: Array) -> float:
    """Return the radius at which theta_d stops growing."""
    k1, k2, k3, k4 = coefficients[:4]
    # d theta_d / d theta as a polynomial in theta^2, highest power first.
    angle = math.sqrt(smallest_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]))
    return math.tan(angle) * (1 - FOLD_MARGIN) if angle < math.pi / 2 else math.inf


LENS = LensModel(FisheyeDistortion, LENS_FISHEYE, max_radius)
