"""How a parameter is declared, once: name, default, bounds, unit, meaning and advice.

The settings of an algorithm are a frozen dataclass in its module, written with `settings` and `parameter`::

    @settings
    class PruneSettings:
        \"\"\"Which components are dropped.\"\"\"

        weight: Positive = parameter("components below this weight are dropped", default=1e-6)

The configuration validates a YAML mapping against that class and gives the algorithm an instance of it; the JSON
schema and the page of the configuration read the same declaration. Bounds are part of the type: those of the
types below exclude only physically impossible values, in any unit of length from mm to km.

What exists in several kinds (filters, lenses, motion models) has a class of settings for each kind, whose field
`kind` (or `model`) holds its word; `members` finds them by the modules of a package and of its plug-ins.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, TypeVar, dataclass_transform

from annotated_types import Interval, Predicate

from stereophd.plugins import import_member, module_names

Class = TypeVar("Class")

FINITE = Predicate(math.isfinite)
NOT_NAN = Predicate(lambda value: not math.isnan(value))

# Limits of what any set-up can mean. The largest lengths are interplanetary distances in mm, the largest speeds
# beyond that of light in mm/s; times reach from milliseconds since 1970, taken for seconds, in both directions.
LARGEST_LENGTH = 1e15
SMALLEST_LENGTH = 1e-12
LARGEST_TIME_S = 1e13
# Times beyond the year 5000 are of a smaller unit than seconds.
LATEST_S = 1e11
SMALLEST_TIME_S = 1e-9
LARGEST_PX = 1e9
LARGEST_DEGREES = 36_000.0
SMALLEST_PX = 1e-9
LARGEST_COUNT = 1_000_000_000
# A detector that is better than a millionth of a pixel, or worse than a million pixels, is none.
SMALLEST_SIGMA_PX, LARGEST_SIGMA_PX = 1e-6, 1e6

#: A position or displacement along one axis, length.
Coordinate = Annotated[float, Interval(ge=-LARGEST_LENGTH, le=LARGEST_LENGTH), FINITE]
#: A distance, a speed or an acceleration: at least 0, length (per s, per s^2).
Length = Annotated[float, Interval(ge=0, le=LARGEST_LENGTH), FINITE]
#: The same above 0.
PositiveLength = Annotated[float, Interval(ge=SMALLEST_LENGTH, le=LARGEST_LENGTH), FINITE]
#: A time of a clock, s.
Time = Annotated[float, Interval(ge=-LARGEST_TIME_S, le=LARGEST_TIME_S), FINITE]
#: A span of time, at least 0, s.
Duration = Annotated[float, Interval(ge=0, le=LARGEST_TIME_S), FINITE]
#: A span of time above 0, s.
PositiveDuration = Annotated[float, Interval(ge=SMALLEST_TIME_S, le=LARGEST_TIME_S), FINITE]
#: A rate above 0, 1/s.
Rate = Annotated[float, Interval(ge=1 / LARGEST_TIME_S, le=1 / SMALLEST_TIME_S), FINITE]
#: A position or a velocity, length or length/s along the axes of the world.
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
#: A place in an image, px.
Pixel = Annotated[float, Interval(ge=-LARGEST_PX, le=LARGEST_PX), FINITE]
#: A focal length, a standard deviation or a disparity: above 0, px.
PositivePixels = Annotated[float, Interval(ge=SMALLEST_PX, le=LARGEST_PX), FINITE]
#: A margin in an image: at least 0, px.
Pixels = Annotated[float, Interval(ge=0, le=LARGEST_PX), FINITE]
#: A number without unit above 0: a weight, a factor, a squared distance in standard deviations.
Positive = Annotated[float, Interval(ge=1e-30, le=1e15), FINITE]
#: The same, or 0.
NonNegative = Annotated[float, Interval(ge=0, le=1e15), FINITE]
#: A probability, or another fraction, 0 and 1 included.
Fraction = Annotated[float, Interval(ge=0, le=1), FINITE]
#: A probability or fraction above 0.
PositiveFraction = Annotated[float, Interval(ge=1e-30, le=1), FINITE]
#: An angle, degrees: more than a hundred turns are a mistake.
Degrees = Annotated[float, Interval(ge=-LARGEST_DEGREES, le=LARGEST_DEGREES), FINITE]
#: The standard deviation of an angle, degrees.
DegreesSpread = Annotated[float, Interval(ge=0, le=LARGEST_DEGREES), FINITE]
#: An angular velocity, degrees/s.
DegreesPerSecond = Annotated[float, Interval(ge=-1e9, le=1e9), FINITE]
#: How many there are: at least 1.
Count = Annotated[int, Interval(ge=1, le=LARGEST_COUNT)]


def parameter(
    meaning: str,
    *,
    default: Any = MISSING,
    default_factory: Callable[[], Any] | Any = MISSING,
    unit: str = "",
    discriminator: str = "",
    advice: str = "",
) -> Any:
    """Declare a field of `settings`.

    The meaning is the description of the value in the schema and on the reference page, the advice how to choose it:
    printed on that page only. Without a default, or a factory of it for a section of its own, the value is required.
    The unit is ``length``, ``length/s``, ``px``, ``s``, ``deg``, ..., where ``length`` is the unit that the
    configuration names; empty for plain numbers and words. `discriminator` is the field that distinguishes the members
    of a union of settings.
    """
    extra = {key: value for key, value in (("unit", unit), ("advice", advice)) if value}
    # these are the names under which pydantic reads what it needs from the metadata of a dataclass
    metadata: dict[str, Any] = {"description": meaning, "json_schema_extra": extra}
    if discriminator:
        metadata["discriminator"] = discriminator
    if default_factory is not MISSING:
        return field(default_factory=default_factory, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(parameter,))
def settings(cls: type[Class]) -> type[Class]:
    """Make a class of parameters: a frozen dataclass whose fields are given by name.

    Checks that need several fields are in `__post_init__`, and raise `ValueError` with what they expected and
    found.
    """
    return dataclass(frozen=True, kw_only=True)(cls)


@cache
def members(package: str, attribute: str = "SETTINGS") -> Mapping[str, Any]:
    """Return what the modules of a package and of its plug-ins offer under one name, by the word of the module.

    This is how kinds are registered: a new module in the package is found without an entry in any list, and one of
    another distribution by its entry point (`stereophd.plugins`). Modules without the attribute are not members. The
    package is named in full, such as ``stereophd.core.multi.filter_settings``.
    """
    modules = {word: import_member(package, word) for word in module_names(package)}
    found = {name: getattr(module, attribute) for name, module in modules.items() if hasattr(module, attribute)}
    return MappingProxyType(found)
