"""Tracking in a configuration: disparity space, motion, region, and the filter."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import model_validator

from stereophd.core.bodies.shapes import DEFAULT, shapes
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.bodies.shapes.point import PointSettings
from stereophd.core.multi.filter_settings import filters
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.settings import Duration, Length, PositiveDuration, PositiveLength, parameter
from stereophd.core.single.settings import SingleSettings
from stereophd.validated import Model, OneOf, Range3


class DisparityConfig(Model):
    """Disparity space of every camera (paper eq. 3): d = f * baseline / z."""

    baseline: PositiveLength = parameter(
        "baseline of the abstract rectified companion",
        default=1.0,
        unit="length",
        advice="it scales disparities: the distance between neighbouring cameras is a natural choice.",
    )
    rectification: Literal["horizontal", "vertical"] = parameter(
        "whether the companion is beside (f = fx) or below (f = fy) the camera", default="horizontal"
    )


class RegionConfig(Model):
    """Where objects can be: a box in the world, a range of depth before the cameras, or both."""

    box: Range3 | None = parameter(
        "a box in the axes of the world",
        default=None,
        advice="the room or the arena, with a margin of the position noise.",
    )
    depth: tuple[Length, PositiveLength] | None = parameter(
        "nearest and farthest depth in front of the camera that saw the object last",
        default=None,
        unit="length",
        advice="from the nearest to somewhat beyond the farthest object.",
    )

    @model_validator(mode="after")
    def _order(self) -> RegionConfig:
        if self.depth is not None and self.depth[0] >= self.depth[1]:
            raise ValueError(f"depth: expected near < far, found {list(self.depth)}")
        return self


Shape = Annotated[PointSettings | EllipsoidSettings, OneOf(shapes, "shape", DEFAULT)]


def _filters() -> dict[str, Any]:
    return {**filters(), "single": SingleSettings}


Filter = Annotated[FilterSettings | SingleSettings, OneOf(_filters, "kind")]


class LiveConfig(Model):
    """How frames that arrive late are taken in."""

    wait_s: Duration = parameter(
        "longest time for which a frame waits for earlier frames of other cameras, in the time of the recording and in "
        "that of the clock on the wall",
        unit="s",
        default=0.0,
        advice="0: every frame is worked as it comes, and a late one takes the filter back; more: fewer rows are "
        "revised, and all come later.",
    )
    span_s: PositiveDuration = parameter(
        "a frame may be this much older than the newest one: the filter goes back to the state before it and works "
        "what followed again, exactly; an older frame is too late",
        unit="s",
        default=2.0,
        advice="the longest delay of a camera; states of this span are kept in memory.",
    )
    recalibrate: bool = parameter(
        "solve the pose of a camera that was knocked anew from the frames since, as calibrate does; until the data "
        "determine it, its frames are recorded and not tracked",
        default=False,
    )
