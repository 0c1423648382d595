"""Options of an import and of an export, each declared once; see `stereophd.options`.

Nothing heavy may be imported here: the command line makes its help from these classes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from stereophd.errors import InputError
from stereophd.options import option, options

Value = TypeVar("Value")


@dataclass(frozen=True)
class PerCamera(Generic[Value]):
    """A value for each camera: those named, and one for all others (None: nothing is stated)."""

    named: Mapping[str, Value] = field(default_factory=dict)
    other: Value | None = None

    def get(self, camera: str) -> Value | None:
        """Return the value of a camera."""
        return self.named.get(camera, self.other)

    def plain(self) -> Any:
        """Return JSON-able values."""
        return {**self.named, **({} if self.other is None else {"*": self.other})}

    def __bool__(self) -> bool:
        return bool(self.named) or self.other is not None


def _pairs(flag: str, words: Sequence[str]) -> dict[str, str]:
    result = {}
    for word in words:
        name, separator, value = word.partition("=")
        if not separator or not name or not value or name in result:
            raise InputError(f"{flag}: expected NAME=VALUE, each name once, found {word}")
        result[name] = value
    return result


def _per_camera(meaning: str, metavar: str, flag: str, parse: Callable[[str], Any]) -> Any:
    """Declare an option that may be stated for each camera (CAM=VALUE) or for all (VALUE)."""

    def parse_words(flag: str, words: Sequence[str]) -> PerCamera[Any]:
        named: dict[str, Any] = {}
        other = None
        for word in words:
            name, separator, text = word.rpartition("=")
            try:
                value = parse(text)
            except ValueError:
                raise InputError(f"{flag}: expected [CAM=]VALUE, found {word}") from None
            if separator:
                named[name] = value
            else:
                other = value
        return PerCamera(named, other)

    return option(meaning, default_factory=PerCamera, metavar=f"[CAM=]{metavar}", flag=flag, parse=parse_words)


def _number(text: str) -> float:
    """Return a number, also a fraction such as 30000/1001."""
    above, separator, below = text.partition("/")
    value = float(above) / float(below) if separator and float(below) else float(above)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _range(text: str) -> tuple[int, int]:
    first, last = map(int, text.split(":"))
    return first, last


def _size(text: str) -> tuple[int, int]:
    width, height = map(int, text.lower().split("x"))
    if width <= 0 or height <= 0:
        raise ValueError(text)
    return width, height


class Stated:
    """What a user states about a file of another program; each format uses what it needs."""

    def plain(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, JSON-able."""
        result: dict[str, Any] = {}
        for name, default in vars(type(self)()).items():
            value = getattr(self, name)
            if value != default:
                plain = value.plain() if isinstance(value, PerCamera) else value
                result[name] = plain.name if isinstance(plain, Path) else plain
        return result


@options
class ImportOptions(Stated):
    """Statements of the user about a foreign source."""

    columns: Mapping[str, str] = option(
        "Read a native column from a column of the table: u_px=x (repeatable).",
        default_factory=dict,
        metavar="NAME=COLUMN",
        flag="column",
        parse=_pairs,
    )
    rates: PerCamera[float] = _per_camera("Frame rate: times are frame / rate.", "HZ", "fps", _number)
    offsets: PerCamera[float] = _per_camera("Seconds to add to the times of a camera.", "S", "offset", _number)
    frames: PerCamera[tuple[int, int]] = _per_camera(
        "Frames recorded; those without rows are empty.", "FIRST:LAST", "recorded-frames", _range
    )
    image_sizes: PerCamera[tuple[int, int]] = _per_camera("Width and height of the images.", "WxH", "image-size", _size)
    rename: Mapping[str, str] = option(
        "Another name for a camera.", default_factory=dict, metavar="OLD=NEW", parse=_pairs
    )
    length_unit: Literal["mm", "cm", "m", "km"] | None = option("Unit of the cameras.", default=None)
    time_unit: Literal["s", "ms", "us", "ns"] = option("Unit of the times.", default="s")
    pixel_origin: Literal["center", "corner", "one"] | None = option(
        "Pixel (0, 0) is the center or the corner of the top-left pixel; one: its center is (1, 1).", default=None
    )
    rows_from: Literal["top", "bottom"] | None = option("Rows count from the top or bottom.", default=None)
    fill: bool = option("Missing frame numbers become empty frames.", default=True, flag="fill-missing-frames")
    box_point: Literal["center", "bottom"] = option("Point of a box that is the detection.", default="center")
    least_score: float | None = option(
        "Leave out detections of a lower score.", default=None, metavar="S", flag="min-score"
    )
    undistorted: bool = option("The pixels are undistorted already.", default=False, flag="pixels-undistorted")
    truth: Path | None = option(
        "Points in space, as the program writes them or a CSV table of time_s, object_id, x, y, z: truth.parquet.",
        default=None,
        metavar="FILE",
    )
    # ``sigma_px``, ``p_detect`` and ``clutter_per_frame`` of all cameras; None: to be estimated from the log.
    detector: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        # by `vars`, because options that note what a format reads must not note this
        for each in fields(ImportOptions):
            value = vars(self)[each.name]
            if each.default_factory is PerCamera and not isinstance(value, PerCamera):
                stated = PerCamera(named=value) if isinstance(value, Mapping) else PerCamera(other=value)
                object.__setattr__(self, each.name, stated)

    def name(self, camera: str) -> str:
        """Return the native name of a camera of the source."""
        return self.rename.get(camera, camera)


@options
class ExportOptions(Stated):
    """Options of an exported file."""

    tracks: list[int] | None = option("Write this track only (repeatable).", default=None, metavar="ID", flag="track")
    rate_hz: float | None = option(
        "Resample the tracks to this rate.", default=None, metavar="HZ", flag="rate", above=0.0
    )
    tentative: bool = option("Write tentative estimates too, not only confirmed ones.", default=False)
