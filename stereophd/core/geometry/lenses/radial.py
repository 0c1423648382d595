"""Distortion model ``radial``: one coefficient (paper section VIII-F)."""

from typing import Literal

from stereophd.core.geometry.layout import LENS_RADIAL
from stereophd.core.geometry.lenses.base import Coefficient, LensModel
from stereophd.core.geometry.lenses.brown_conrady import max_radius
from stereophd.core.settings import parameter, settings


@settings
class RadialDistortion:
    """One-parameter radial distortion: x_distorted = x (1 + k1 r^2)."""

    model: Literal["radial"] = parameter("the lens model", default="radial")
    k1: Coefficient = parameter("coefficient of r^2, where r is the distance from the axis at depth 1")


# The formula is that of brown_conrady, of which all other coefficients are 0.
LENS = LensModel(RadialDistortion, LENS_RADIAL, max_radius)
