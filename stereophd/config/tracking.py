"""Tracking in a configuration: disparity space, motion, region, and the filter."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import model_validator

from stereophd.core.arrays import Array
from stereophd.core.bodies.shapes import DEFAULT, shapes
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.bodies.shapes.point import PointSettings
from stereophd.core.geometry.region import box_half_spaces, pack_region, prism_half_spaces
from stereophd.core.multi.filter_settings import filters
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.settings import Coordinate, Duration, Length, PositiveDuration, PositiveLength, Vector3, parameter
from stereophd.core.single.settings import SingleSettings
from stereophd.validated import Model, OneOf, Range3, ascending


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


class PolygonConfig(Model):
    """What stands over a convex polygon in a plane, such as an annotated floor, between two heights.

    Objects can be between these heights beside the polygon too; only those over it are reported and scored.
    """

    corners: list[Vector3] = parameter("three or more corners, in order, in the axes of the world", unit="length")
    heights: Annotated[tuple[Coordinate, Coordinate], ascending("low < high", is_strict=True)] = parameter(
        "least and greatest height over the plane of the corners", unit="length"
    )
    up: Vector3 = parameter("the side of the plane on which heights are positive", default=(0.0, -1.0, 0.0))

    @model_validator(mode="after")
    def _shape(self) -> Self:
        self.half_spaces()
        return self

    def half_spaces(self) -> Array:
        """Return the half-spaces (h, 4) that the polygon and its heights are."""
        return prism_half_spaces(self.corners, self.up, self.heights)


class RegionConfig(Model):
    """Where objects can be, and where they are reported: in a box, over a polygon, in a range of depth, or in all."""

    box: Range3 | None = parameter(
        "a box in the axes of the world",
        default=None,
        advice="the room or the arena, with a margin of the position noise.",
    )
    polygon: PolygonConfig | None = parameter(
        "a convex polygon in a plane, with heights",
        default=None,
        advice="the annotated floor; people beside it are tracked, so that they are not taken for others, but not "
        "reported.",
    )
    depth: Annotated[tuple[Length, PositiveLength], ascending("near < far", is_strict=True)] | None = parameter(
        "nearest and farthest depth in front of the camera that saw the object last",
        default=None,
        unit="length",
        advice="from the nearest to somewhat beyond the farthest object.",
    )

    def half_spaces(self) -> Array:
        """Return the half-spaces (h, 4) of the world that the box and the polygon are: objects count inside."""
        box = np.empty((0, 4)) if self.box is None else box_half_spaces(self.box.model_dump())
        return box if self.polygon is None else np.concatenate([box, self.polygon.half_spaces()])

    def packed(self) -> Array:
        """Return where objects can be (`stereophd.core.geometry.region`): the box, the heights, and the depths."""
        sides = 0 if self.polygon is None else len(self.polygon.corners)
        spaces = self.half_spaces()
        spaces = np.delete(spaces, np.arange(len(spaces) - sides, len(spaces)), axis=0)
        return pack_region(self.depth or (-np.inf, np.inf), spaces)


Shape = Annotated[PointSettings | EllipsoidSettings, OneOf(shapes, "shape", DEFAULT)]


Filter = Annotated[FilterSettings | SingleSettings, OneOf(lambda: {**filters(), "single": SingleSettings}, "kind")]


class LiveConfig(Model):
    """How frames that arrive late are taken in."""

    wait_s: Duration = parameter(
        "longest time for which a frame waits for earlier frames of other cameras, in the time of the recording and in "
        "that of the clock on the wall",
        unit="s",
        default=0.0,
        advice="0: every frame is processed as it comes, and a late one takes the filter back; more: fewer rows are "
        "revised, and all come later.",
    )
    span_s: PositiveDuration = parameter(
        "a frame may be this much older than the newest one: the filter goes back to the state before it and "
        "processes what followed again, exactly; an older frame is too late",
        unit="s",
        default=2.0,
        advice="the longest delay of a camera; states of this span are kept in memory.",
    )
    recalibrate: bool = parameter(
        "solve the pose of a camera that was knocked anew from the frames since, as calibrate does; until the data "
        "determine it, its frames are recorded and not tracked",
        default=False,
    )
