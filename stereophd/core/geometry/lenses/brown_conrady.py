"""Distortion model ``brown_conrady``, OpenCV's rational model.

Source: D. C. Brown, "Decentering distortion of lenses", 1966.
"""

import math
from typing import Literal

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.layout import LENS_BROWN_CONRADY
from stereophd.core.geometry.lenses.base import FOLD_MARGIN, Coefficient, LensModel, smallest_positive_root
from stereophd.core.settings import parameter, settings


@settings
class BrownConradyDistortion:
    """OpenCV's rational model: k1..k6 radial, p1, p2 tangential."""

    model: Literal["brown_conrady"] = parameter("the lens model", default="brown_conrady")
    k1: Coefficient = parameter("radial, of r^2 in the numerator", default=0.0)
    k2: Coefficient = parameter("radial, of r^4 in the numerator", default=0.0)
    p1: Coefficient = parameter("tangential", default=0.0)
    p2: Coefficient = parameter("tangential", default=0.0)
    k3: Coefficient = parameter("radial, of r^6 in the numerator", default=0.0)
    k4: Coefficient = parameter("radial, of r^2 in the denominator", default=0.0)
    k5: Coefficient = parameter("radial, of r^4 in the denominator", default=0.0)
    k6: Coefficient = parameter("radial, of r^6 in the denominator", default=0.0)


def scale(c: Array, start: int, s: float) -> tuple[float, float]:
    """Return g = r_d / r and dg/ds at the squared radius s, with the coefficients at c[start : start + 8]."""
    k1, k2, k3 = c[start], c[start + 1], c[start + 4]
    k4, k5, k6 = c[start + 5], c[start + 6], c[start + 7]
    denominator = 1.0 + s * (k4 + s * (k5 + s * k6))
    g = (1.0 + s * (k1 + s * (k2 + s * k3))) / denominator
    numerator_slope = k1 + s * (2.0 * k2 + s * 3.0 * k3)
    denominator_slope = k4 + s * (2.0 * k5 + s * 3.0 * k6)
    return g, (numerator_slope - g * denominator_slope) / denominator


def max_radius(coefficients: Array) -> float:
    """Return the radius of the first fold, where the radial map stops to increase.

    A radius at which the slope of the map is zero without a change of sign is also taken as the limit, and so is a pole
    that the numerator cancels.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    # r_d = r N(s) / D(s), s = r^2: the slope is (N D + 2 s (N' D - N D')) / D^2.
    numerator = np.array([k3, k2, k1, 1.0])
    denominator = np.array([k6, k5, k4, 1.0])
    wronskian: Array = np.polysub(
        np.polymul(np.polyder(numerator), denominator), np.polymul(numerator, np.polyder(denominator))
    )
    slope = np.polyadd(np.polymul(numerator, denominator), np.polymul([2.0, 0.0], wronskian))
    squared = min(smallest_positive_root(slope), smallest_positive_root(denominator))
    return math.sqrt(squared) * (1 - FOLD_MARGIN)


LENS = LensModel(BrownConradyDistortion, LENS_BROWN_CONRADY, max_radius)
