"""Times of tables, in the unit that the user states."""

from stereophd.core.arrays import Array
from stereophd.core.settings import LATEST_S
from stereophd.errors import InputError
from stereophd.io.interchange.base import ImportOptions
from stereophd.wording import instant

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def in_seconds(times: Array, options: ImportOptions, where: str) -> Array:
    """Return times in s; InputError, which names `where` they are, for those that can only be of a smaller unit."""
    for time in times[abs(times) * TIME_UNITS[options.time_unit] > LATEST_S][:1]:
        for unit, factor in TIME_UNITS.items():
            if abs(time) * factor <= LATEST_S:
                raise InputError(
                    f"{where}: expected times in {options.time_unit}, found {time:.0f}; `time_unit` {unit} says that "
                    f"it is {instant(time * factor)} s"
                )
    return times * TIME_UNITS[options.time_unit]
