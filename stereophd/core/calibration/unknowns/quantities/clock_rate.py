"""The rate of a camera's clock: true seconds in a second of its log."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import RATIO, TIMES, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera, Clock


class _ClockRate(Quantity):
    components = ("clock_rate",)
    unit, affects = RATIO, TIMES
    prior, largest_std = "clock_rate_std", 1e12
    description = "standard deviation of the rate of the clock, seconds per second"
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add a value to the rate."""
        return replace(camera, clock=Clock(camera.clock.offset_s, camera.clock.rate + float(values[0])))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.clock.rate - camera.clock.rate])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The true time changes by the time in the log."""
        return np.asarray((view.log_times[:, None] * view.by_time)[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"clock": {"rate": camera.clock.rate}}


QUANTITY = _ClockRate()
