"""The word ``none``: a pinhole camera."""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stereophd.core.geometry.layout import LENS_NONE
from stereophd.core.geometry.lenses.base import LensModel
from stereophd.core.settings import parameter, settings


@settings
class NoDistortion:
    """No lens distortion."""

    model: Literal["none"] = parameter("the lens model", default="none")


def max_radius(coefficients: NDArray[np.float64]) -> float:
    """Return inf: nothing folds back."""
    return math.inf


LENS = LensModel(NoDistortion, LENS_NONE, max_radius)
