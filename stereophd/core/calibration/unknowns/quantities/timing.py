"""Clock and readout of a camera."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import RATIO, SECONDS, TIMES, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera
from stereophd.core.settings import LARGEST_TIME_S


class ClockOffset(Quantity):
    """The offset of a camera's clock: true time at time 0 of its log."""

    name = "clock_offset"
    components = ("clock_offset",)
    unit, affects = SECONDS, TIMES
    prior, largest_std = "clock_offset_std_s", LARGEST_TIME_S
    description = "standard deviation of the offset of the clock, s"
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add a value to the offset, s."""
        return replace(camera, clock=replace(camera.clock, offset_s=camera.clock.offset_s + float(values[0])))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.clock.offset_s - camera.clock.offset_s])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """A later true time moves the objects on."""
        return np.asarray(view.by_time[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"clock": {"offset_s": camera.clock.offset_s}}


class ClockRate(Quantity):
    """The rate of a camera's clock: true seconds in a second of its log."""

    name = "clock_rate"
    components = ("clock_rate",)
    unit, affects = RATIO, TIMES
    prior, largest_std = "clock_rate_std", 1e12
    description = "standard deviation of the rate of the clock, seconds per second"
    of_the_frame = True

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add a value to the rate."""
        return replace(camera, clock=replace(camera.clock, rate=camera.clock.rate + float(values[0])))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.clock.rate - camera.clock.rate])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The true time changes by the time in the log."""
        return np.asarray((view.log_times[:, None] * view.by_time)[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"clock": {"rate": camera.clock.rate}}


class Readout(Quantity):
    """The readout time of a rolling shutter."""

    name = "readout"
    components = ("readout",)
    unit, affects = SECONDS, TIMES
    prior, largest_std = "readout_std_s", 1e3
    description = "standard deviation of the readout time of a rolling shutter, s"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add a value to the readout time, s."""
        return replace(camera, readout_s=camera.readout_s + float(values[0]))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.readout_s - camera.readout_s])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The time of a detection changes by its row over the height."""
        return np.asarray((view.rows[:, None] * view.by_time)[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"readout_s": camera.readout_s}
