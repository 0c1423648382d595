"""The input of `track` for bodies (``object.shape: ellipsoid``): events whose detections all have boxes."""

from collections.abc import Iterator

import numpy as np

from stereophd.core.disparity.events import Event
from stereophd.errors import InputError
from stereophd.io.logs.reading import LogReader
from stereophd.pipeline.stream import EventStream
from stereophd.wording import instant


def with_boxes(stream: EventStream) -> Iterator[Event]:
    """Yield the events of a log of boxes; InputError if ``width_px, height_px`` or a detection's box is missing."""
    if isinstance(stream.frames, LogReader) and not stream.frames.has_boxes:
        raise InputError(
            f"{stream.source}: expected the columns width_px and height_px (object.shape is ellipsoid), found none"
        )
    for event in stream:
        if event.sizes is None or np.isnan(event.sizes).any():
            raise InputError(
                f"{stream.source}: frame {event.frame} of {stream.cameras[event.camera].name} at "
                f"{instant(event.time_s)} s: expected a box (width_px, height_px) for each "
                "detection (object.shape is ellipsoid), found none"
            )
        yield event
