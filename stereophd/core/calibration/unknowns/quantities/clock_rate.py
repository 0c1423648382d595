"""The rate of a camera's clock: true seconds in a second of its log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import RATIO, TIMES, CameraView, Quantity, all_of
from stereophd.core.geometry.camera import Camera, Clock

RATE = ("clock_rate",)


def apply(camera: Camera, values: Array) -> Camera:
    """Add a value to the rate."""
    return replace(camera, clock=Clock(camera.clock.offset_s, camera.clock.rate + float(values[0])))


def difference(camera: Camera, other: Camera) -> Array:
    """Return the difference of the two."""
    return np.array([other.clock.rate - camera.clock.rate])


def derivative(view: CameraView, values: Array) -> Array:
    """The true time changes by the time in the log."""
    return np.asarray((view.log_times[:, None] * view.by_time)[:, :, None])


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the rate."""
    return {"clock": {"rate": camera.clock.rate}}


QUANTITY = Quantity(
    name="clock_rate",
    components=RATE,
    unit=RATIO,
    prior="clock_rate_std",
    largest_std=1e12,
    description="standard deviation of the rate of the clock, seconds per second",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=TIMES,
    available=all_of(RATE),
    of_the_frame=True,
)
