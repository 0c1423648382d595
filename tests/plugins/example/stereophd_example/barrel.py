"""A lens with two radial coefficients: a case of ``brown_conrady``, whose formula it shares."""

from typing import Literal

from stereophd.core.geometry.lenses.base import Coefficient, LensModel
from stereophd.core.geometry.lenses.brown_conrady import max_radius
from stereophd.core.settings import parameter, settings


@settings
class BarrelDistortion:
    """x_distorted = x (1 + k1 r^2 + k2 r^4)."""

    model: Literal["barrel"] = parameter("the lens model", default="barrel")
    k1: Coefficient = parameter("coefficient of r^2")
    k2: Coefficient = parameter("coefficient of r^4", default=0.0)


LENS = LensModel(BarrelDistortion, 100, max_radius)
