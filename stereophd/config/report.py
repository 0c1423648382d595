"""Sections ``report``, ``input`` and ``evaluation`` of a configuration: what is written, read and scored."""

import json
from contextlib import suppress
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from stereophd.core.settings import Duration, Pixel, Pixels, PositiveDuration, PositiveLength, PositivePixels, parameter
from stereophd.validated import Model


class SmoothConfig(Model):
    """Fixed-interval smoothing of every track."""

    max_gap_s: Duration = parameter(
        "two tracks are joined if the second begins at most this long after the end of the first and continues it; and "
        "detections of an object are searched up to this long before its first known one",
        default=1.0,
        advice="the longest time for which an object is hidden.",
    )
    reassociate: bool = parameter(
        "smoothed tracks of a filter of many objects choose their detections anew, at the noise of the motion that "
        "they show, so that neighbours that the filter took for each other are exchanged; not with times on a grid",
        default=False,
        advice="true for many objects close together that are seldom seen, such as corners of a board.",
    )


class CameraTimes(Model):
    """Estimates after every frame of one camera."""

    camera: str = parameter("name of the camera")


class GridTimes(Model):
    """Estimates on a fixed grid of times."""

    grid: PositiveDuration = parameter("step of the grid: its times are the multiples of it", unit="s")


# Times are written to the nanosecond: a much finer grid would repeat them, and its estimates would fill the disk.
SHORTEST_GRID_S = 1e-6


def _parse_times(value: Any) -> Any:
    """Turn the short forms ``camera NAME`` and ``grid DT`` into mappings; refuse any other value in a full sentence."""
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

    times: TimesSetting = parameter(
        "when estimates are written: events (after every event), camera NAME (after every frame of that camera) or "
        "grid DT (at the multiples of DT seconds, predicted from the last event before each)",
        default="events",
        advice="grid for plots and comparisons, camera for one estimate a frame, events for everything.",
    )
    max_position_std: PositiveLength | None = parameter(
        "leave out estimates whose position has a larger standard deviation (square root of the trace of its "
        "covariance): while only one camera sees an object, its depth is not known",
        default=None,
        advice="the largest error that you can use; it hides tracks that only one camera sees.",
    )
    min_track_length: Duration = parameter(
        "leave out tracks whose first and last estimates are less than this apart, s",
        default=0.0,
        unit="s",
        advice="longer than false tracks last, and shorter than the objects that matter stay in view.",
    )
    associations: bool = parameter(
        "write associations.parquet: which detection belongs to which track, with which probability", default=False
    )
    std_columns: bool = parameter(
        "write columns std_x, std_y and std_z into tracks.parquet: standard deviations of the position along the "
        "axes of the world",
        default=False,
        advice="true for programs that cannot read the column covariance.",
    )
    smooth: SmoothConfig | None = parameter(
        "smooth every track over the whole log, which is then held in memory; by default tracks are not smoothed",
        default=None,
    )
    lag_s: PositiveDuration | None = parameter(
        "live runs: rows come this much later, smoothed with what the cameras have seen since; by default they come at "
        "once",
        default=None,
        unit="s",
        advice="about as long as an object takes to turn or to brake; more costs time and gains little.",
    )


class InputConfig(Model):
    """How a detection log is read."""

    on_bad_row: Literal["error", "drop"] = parameter(
        "error: the first bad row ends the run; drop: bad rows are dropped, counted and reported",
        default="error",
        advice="error, until you know why rows are bad.",
    )
    image_margin_px: Pixels = parameter(
        "a detection further than this outside the image is a bad row (noise may reach over the edge)",
        default=10.0,
        unit="px",
    )
    leave_out: dict[str, list[tuple[Pixel, Pixel, PositivePixels]]] = parameter(
        "by camera, places whose detections are left out: u, v and radius",
        default_factory=dict,
        unit="px",
        advice="dead pixels and lamps, as `check` names them.",
    )


class EvaluationConfig(Model):
    """The scale of the scene, for scores (evaluate)."""

    cutoff: PositiveLength | None = parameter(
        "default cutoff of the scores for tracks of this configuration: an error beyond it counts as a missed object "
        "and a false track",
        default=None,
        advice="the largest position error that still is a find, such as a tenth of the usual depth.",
    )
