"""The word ``none``: a pinhole camera."""

import math
from typing import Literal

from stereophd.core.geometry.layout import LENS_NONE
from stereophd.core.geometry.lenses.base import LensModel
from stereophd.core.settings import parameter, settings


@settings
class NoDistortion:
    """No lens distortion."""

    model: Literal["none"] = parameter("the lens model", default="none")


# Nothing folds back.
LENS = LensModel(NoDistortion, LENS_NONE, lambda _: math.inf)
