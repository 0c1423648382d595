"""Tracking in a configuration: disparity space, motion, region, and the filter."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from stereophd.config.base import Model, NonNegative, OneOf, Positive, Range3
from stereophd.core.motion.settings import DEFAULT, MotionSettings, motion_models
from stereophd.core.multi.kinds import filters
from stereophd.core.multi.settings import FilterSettings
from stereophd.core.single.settings import SingleSettings


class DisparityConfig(Model):
    """Disparity space of every camera (paper eq. 3): d = f * baseline / z."""

    baseline: Positive = Field(1.0, description="baseline of the abstract rectified companion, length")
    rectification: Literal["horizontal", "vertical"] = Field(
        "horizontal", description="whether the companion is beside (f = fx) or below (f = fy) the camera"
    )


class RegionConfig(Model):
    """Where objects can be: a box in the world, a range of depth before the cameras, or both."""

    box: Range3 | None = Field(None, description="in the world")
    depth: tuple[NonNegative, Positive] | None = Field(
        None, description="nearest and farthest depth before the camera that saw the object last, length"
    )

    @model_validator(mode="after")
    def _order(self) -> RegionConfig:
        if self.depth is not None and self.depth[0] >= self.depth[1]:
            raise ValueError(f"depth: expected near < far, found {list(self.depth)}")
        return self


def _filters() -> dict[str, Any]:
    return {**filters(), "single": SingleSettings}


Filter = Annotated[FilterSettings | SingleSettings, OneOf(_filters, "kind")]
Motion = Annotated[MotionSettings, OneOf(motion_models, "model", DEFAULT)]
