"""Clock and readout of a camera."""

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import RATIO, SECONDS, TIMES, CameraView, Offset, Pull
from stereophd.core.settings import LARGEST_TIME_S


class ClockOffset(Offset):
    """The offset of a camera's clock: true time at time 0 of its log."""

    name = "clock_offset"
    components, place = ("clock_offset",), ("clock", "offset_s")
    unit, affects = SECONDS, TIMES
    prior, largest_std = "clock_offset_std_s", LARGEST_TIME_S
    description = "standard deviation of the offset of the clock, s"
    of_the_frame = True

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """A later true time moves the objects on."""
        return view.by_time(pull)


class ClockRate(Offset):
    """The rate of a camera's clock: true seconds in a second of its log."""

    name = "clock_rate"
    components, place = ("clock_rate",), ("clock", "rate")
    unit, affects = RATIO, TIMES
    prior, largest_std = "clock_rate_std", 1e12
    description = "standard deviation of the rate of the clock, seconds per second"
    of_the_frame = True

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """The true time changes by the time in the log."""
        return view.log_times[:, None] * view.by_time(pull)


class Readout(Offset):
    """The readout time of a rolling shutter."""

    name = "readout"
    components, place = ("readout",), ("readout_s",)
    unit, affects = SECONDS, TIMES
    prior, largest_std = "readout_std_s", 1e3
    description = "standard deviation of the readout time of a rolling shutter, s"

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """The time of a detection changes by its row over the height."""
        return view.rows[:, None] * view.by_time(pull)
