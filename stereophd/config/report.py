"""Reading and writing in a configuration: how a log is read, and which estimates are written."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stereophd.config.base import Model, NonNegative, Positive


class SmoothConfig(Model):
    """Fixed-interval smoothing (``track --smooth``)."""

    max_gap_s: NonNegative = Field(
        1.0,
        description="s; tracks that end and begin within this time, and fit, are stitched into one, and detections of "
        "an object are looked for this long before its first known one",
    )


class CameraTimes(Model):
    """Estimates after every frame of one camera."""

    camera: str = Field(description="name of the camera")


class GridTimes(Model):
    """Estimates on a fixed grid of times."""

    grid: Positive = Field(description="step of the grid, s: its times are the multiples of it")


# A finer grid would repeat times that are written to the nanosecond, and fill the disk.
SHORTEST_GRID_S = 1e-6


def _parse_times(value: Any) -> Any:
    """Turn the short forms ``camera NAME`` and ``grid DT`` into mappings; refuse what is neither, in a sentence."""
    if value == "events":
        return value
    found = value
    if isinstance(value, str):
        kind, _, rest = value.partition(" ")
        value = {kind: rest.strip()}
        if kind == "grid":
            with suppress(ValueError):
                value = {kind: float(rest)}
    if isinstance(value, dict) and len(value) == 1:
        camera, grid = value.get("camera"), value.get("grid")
        if isinstance(camera, str) and camera:
            return value
        if isinstance(grid, int | float) and not isinstance(grid, bool):
            if SHORTEST_GRID_S <= grid < np.inf:
                return value
            raise ValueError(f"expected a grid of at least {SHORTEST_GRID_S:g} s, found {grid:g}")
    raise ValueError(f"expected events, camera NAME or grid DT (in seconds), found {json.dumps(found)}")


TimesSetting = Annotated[
    Literal["events"] | CameraTimes | GridTimes,
    BeforeValidator(
        _parse_times,
        json_schema_input_type=Literal["events"]
        | Annotated[str, Field(pattern=r"^(camera|grid) +\S")]
        | CameraTimes
        | GridTimes,
    ),
]


class ReportConfig(Model):
    """Which estimates are written."""

    times: TimesSetting = Field(
        "events",
        description="when estimates are written: events (after every event), camera NAME (after every frame of that "
        "camera) or grid DT (at the multiples of DT seconds, predicted from the last event before each)",
    )
    max_position_std: Positive | None = Field(
        None,
        description="leave out estimates whose position is less certain (square root of the trace of its "
        "covariance), length: depth is not seen while one camera alone sees an object",
    )
    smooth: SmoothConfig | None = Field(
        None, description="smooth every track over the whole log, which is then held in memory; default off"
    )


class InputConfig(Model):
    """How a detection log is read."""

    on_bad_row: Literal["error", "drop"] = Field(
        "error",
        description="error: the first bad row ends the run; drop: bad rows are dropped, counted and reported",
    )
    image_margin_px: NonNegative = Field(
        10.0,
        description="a detection further than this outside the image is a bad row (noise may reach over the edge)",
    )
