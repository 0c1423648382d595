"""The messages of a live run as documents of JSON: frames that come in, records and events that go out.

Version 1. `schema` is published as ``docs/reference/messages.schema.json``; a change that a reader could trip over is a
new version.
"""

from typing import Annotated, Any

import msgspec

from stereophd.io.documents import MAX_DETECTIONS_AT_ONCE

VERSION = 1
# Optional columns of a log that a message may carry; others are ignored.
FURTHER = ("sigma_u_px", "sigma_v_px", "score", "object_id", "width_px", "height_px")
# The largest numbers that a log can hold.
_INT64 = msgspec.Meta(ge=-(2**63), le=2**63 - 1, description="number of the frame; rises with time")
_TIME = msgspec.Meta(description="true time, s")


class FrameDocument(msgspec.Struct):
    """A frame of a camera."""

    camera: Annotated[str, msgspec.Meta(description="name of the camera, as in the configuration")]
    frame: Annotated[int, _INT64]
    time_s: Annotated[float, msgspec.Meta(description="time of the frame on the camera's own clock, s")]
    detections: Annotated[
        list[list[float | None]],
        msgspec.Meta(
            max_length=MAX_DETECTIONS_AT_ONCE,
            description="u_px, v_px and the values that `columns` names, of each detection",
        ),
    ]
    columns: Annotated[
        list[str],
        msgspec.Meta(description=f"names of the values of a detection after u_px and v_px: {', '.join(FURTHER)}"),
    ] = []


class ReportedTrack(msgspec.Struct, omit_defaults=True):
    """An object of a record, with the columns of ``tracks.parquet``."""

    track_id: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    position_covariance: Annotated[list[float], msgspec.Meta(description="xx, xy, xz, yy, yz, zz")]
    existence: float
    status: Annotated[str, msgspec.Meta(description="confirmed or tentative")]
    height: Annotated[float | None, msgspec.Meta(description="of a body")] = None
    width: float | None = None
    height_std: float | None = None
    width_std: float | None = None


class RecordDocument(msgspec.Struct, omit_defaults=True):
    """The objects after a frame."""

    time_s: Annotated[float, _TIME]
    camera: str
    frame: int
    revised: Annotated[bool, msgspec.Meta(description="whether it replaces the earlier record of this frame")]
    tracks: list[ReportedTrack]


class CameraPlace(msgspec.Struct):
    """Where a camera stands and looks."""

    name: str
    center: list[float]
    looks_along: list[float]


class LiveEvent(msgspec.Struct, tag_field="event", tag=str.lower, omit_defaults=True):
    """What happens beside the records."""


class Ready(LiveEvent):
    """Frames are taken from now on."""

    cameras: list[CameraPlace]


class Status(LiveEvent):
    """How the run goes, every two seconds."""

    frames: int
    late: Annotated[int, msgspec.Meta(description="frames that took the filter back")]
    too_late: int
    residuals: Annotated[dict[str, float], msgspec.Meta(description="of each camera, in the deviations expected")]
    latency_ms: Annotated[dict[str, float], msgspec.Meta(description="percentiles so far")]


class Checkpoint(LiveEvent):
    """The files of the output hold so many frames of the recording, or an error kept them as they were."""

    frames: int | None = None
    error: str | None = None


class Knocked(LiveEvent):
    """A camera has been knocked."""

    camera: str
    time_s: Annotated[float, msgspec.Meta(description="when it was noticed, s")]
    since_s: Annotated[float, msgspec.Meta(description="when it happened, s")]
    turn_deg: float
    shift_px: list[float]
    others: Annotated[list[str], msgspec.Meta(description="cameras that may be the one in its place")] = []


class Recalibrated(LiveEvent):
    """A try to solve the pose of a camera that was knocked has ended."""

    camera: str
    time_s: Annotated[float, _TIME]
    status: Annotated[str, msgspec.Meta(description="as of `calibrate`")]
    pose: Annotated[dict[str, Any] | None, msgspec.Meta(description="where it is determined")] = None


def schema() -> dict[str, Any]:
    """Return the JSON Schema of all messages."""
    kinds = (FrameDocument, RecordDocument, Ready, Status, Checkpoint, Knocked, Recalibrated)
    each, definitions = msgspec.json.schema_components(kinds, ref_template="#/$defs/{name}")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"stereophd messages, version {VERSION}",
        "oneOf": list(each),
        "$defs": definitions,
    }
