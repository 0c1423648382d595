"""Objects without a size (``object.shape: point``): a detection is a place in the image."""

from typing import Literal

from stereophd.core.settings import parameter, settings


@settings
class PointSettings:
    """Objects without a size: boxes in the log are not read."""

    shape: Literal["point"] = parameter("the shape", default="point")


SETTINGS = PointSettings
