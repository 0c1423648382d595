"""The offset of a camera's clock: true time at time 0 of its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import SECONDS, TIMES, CameraView, Quantity, all_of
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.settings import LARGEST_TIME_S

OFFSET = ("clock_offset",)


def apply(camera: Camera, values: Array) -> Camera:
    """Add a value to the offset, s."""
    return replace(camera, clock=Clock(camera.clock.offset_s + float(values[0]), camera.clock.rate))


def difference(camera: Camera, other: Camera) -> Array:
    """Return the difference of the two."""
    return np.array([other.clock.offset_s - camera.clock.offset_s])


def derivative(view: CameraView, values: Array) -> Array:
    """A later true time moves the objects on."""
    return np.asarray(view.by_time[:, :, None])


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the offset."""
    return {"clock": {"offset_s": camera.clock.offset_s}}


QUANTITY = Quantity(
    name="clock_offset",
    components=OFFSET,
    unit=SECONDS,
    prior="clock_offset_std_s",
    largest_std=LARGEST_TIME_S,
    description="standard deviation of the offset of the clock, s",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=TIMES,
    available=all_of(OFFSET),
    of_the_frame=True,
)
