"""The offset of a camera's clock: true time at time 0 of its log."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import SECONDS, TIMES, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.settings import LARGEST_TIME_S

OFFSET = ("clock_offset",)


class _ClockOffset(Quantity):
    components = OFFSET
    unit, affects = SECONDS, TIMES
    prior, largest_std = "clock_offset_std_s", LARGEST_TIME_S
    description = "standard deviation of the offset of the clock, s"
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add a value to the offset, s."""
        return replace(camera, clock=Clock(camera.clock.offset_s + float(values[0]), camera.clock.rate))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.clock.offset_s - camera.clock.offset_s])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """A later true time moves the objects on."""
        return np.asarray(view.by_time[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"clock": {"offset_s": camera.clock.offset_s}}


QUANTITY = _ClockOffset()
