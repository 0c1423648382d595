"""`track` for bodies (``object.shape: ellipsoid``): the filter of boxes, and what it cannot be combined with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereophd.core.bodies.filter import BodyFilter
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.disparity.events import make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.errors import InputError
from stereophd.pipeline.build import build_motion, build_region

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


def build_bodies(loaded: LoadedConfig, shape: EllipsoidSettings, cameras: tuple[Camera, ...]) -> BodyFilter:
    """Return the filter of bodies that a configuration describes.

    Raises
    ------
    InputError
        The filter is not `pmb`; objects do not move; estimates are smoothed; or a camera has a rolling shutter.
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
            f"{path}: report.smooth: expected none (--no-smooth) {where}: tracks of points are smoothed only"
        )
    for camera in cameras:
        if camera.readout_s != 0.0:
            raise InputError(f"{path}: cameras.{camera.name}.readout_s: expected 0 {where}, found {camera.readout_s:g}")
    rig = make_rig(cameras, config.disparity.baseline, config.disparity.rectification, build_region(config.region))
    return BodyFilter(rig, motion, shape, config.filter)
