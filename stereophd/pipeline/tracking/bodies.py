"""`track` for bodies (``object.shape: ellipsoid``): the filter of boxes, its input, and what it does not go with."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.bodies.filter import BodyFilter
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.disparity.events import Event, make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.errors import InputError
from stereophd.io.logs.reading import LogReader
from stereophd.pipeline.build import build_motion
from stereophd.pipeline.stream import EventStream


def build_bodies(loaded: LoadedConfig, shape: EllipsoidSettings, cameras: tuple[Camera, ...]) -> BodyFilter:
    """Return the filter of bodies that a configuration describes.

    Raises InputError unless the filter is `pmb`, objects move, nothing is smoothed and no camera has a rolling shutter.
    """
    config, path = loaded.config, loaded.path
    where = "where object.shape is ellipsoid"
    if not isinstance(config.filter, PmbSettings):
        kind = "none" if config.filter is None else config.filter.kind
        raise InputError(f"{path}: filter.kind: expected pmb {where}, found {kind}")
    motion = build_motion(config, path)
    if not motion.moves:
        raise InputError(f"{path}: motion.model: expected one whose objects move {where}, found {config.motion.model}")
    if config.report.smooth is not None:
        raise InputError(
            f"{path}: report.smooth: expected none {where}: only tracks of points are smoothed, found some"
        )
    for camera in cameras:
        if camera.readout_s != 0.0:
            raise InputError(f"{path}: cameras.{camera.name}.readout_s: expected 0 {where}, found {camera.readout_s:g}")
    rig = make_rig(
        cameras,
        config.disparity.baseline,
        config.disparity.rectification,
        None if config.region is None else config.region.packed(),
    )
    return BodyFilter(rig, motion, shape, config.filter)


def with_boxes(stream: EventStream) -> Iterator[Event]:
    """Yield the events of a log of boxes; InputError if ``width_px, height_px`` or a detection's box is missing."""
    if isinstance(stream.frames, LogReader) and not stream.frames.has_boxes:
        raise InputError(
            f"{stream.source}: expected the columns width_px and height_px (object.shape is ellipsoid), found none"
        )
    for event in stream:
        if event.sizes is None or np.isnan(event.sizes).any():
            raise InputError(
                f"{stream.source}: frame {event.frame} of {stream.cameras[event.camera].name} at {event.time_s:g} s: "
                "expected a box (width_px, height_px) for each detection (object.shape is ellipsoid), found none"
            )
        yield event
