"""A foreign format: the result of its reader, the input of its writer, and the options of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig

Value = TypeVar("Value")

#: Optional columns of a log that a format may fill.
EXTRA_COLUMNS = ("sigma_u_px", "sigma_v_px", "width_px", "height_px", "score", "object_id")


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


@dataclass(frozen=True)
class ImportOptions:
    """Statements of the user about a foreign source; each format uses those that it needs."""

    columns: Mapping[str, str] = field(default_factory=dict)  # Native column -> column of the source
    # Frames per second of each camera; times are then frame number over rate.
    rates: PerCamera[float] = field(default_factory=PerCamera)
    offsets: PerCamera[float] = field(default_factory=PerCamera)  # Seconds to add to the times of each camera
    # First and last frame recorded by each camera.
    frames: PerCamera[tuple[int, int]] = field(default_factory=PerCamera)
    # Width and height of each camera's image, px.
    image_sizes: PerCamera[tuple[int, int]] = field(default_factory=PerCamera)
    rename: Mapping[str, str] = field(default_factory=dict)  # Camera of the source -> native name
    length_unit: str | None = None  # Unit of length of the source's cameras; None: the unit of the format, or metres
    time_unit: str = "s"  # Unit of the source's times
    # What pixel (0, 0) of the source is: ``center`` or ``corner`` of the top-left pixel, or ``one`` where the centre
    # of the top-left pixel is (1, 1); None: as the format has it.
    pixel_origin: str | None = None
    # Whether rows count from the ``top`` of the image or from the ``bottom``; None: as the format has it.
    rows_from: str | None = None
    fill: bool = True  # Whether frames missing between those of a camera become empty frames
    # The point of a bounding box that is the detection: its ``center``, or the middle of its ``bottom``.
    box_point: str = "center"
    least_score: float | None = None  # Detections of a smaller score are left out
    # Whether the source's pixels are already undistorted: the cameras then lose their lens model.
    undistorted: bool = False
    truth: Path | None = None  # A file (or folder) of the program's points in space, which become a truth
    # ``sigma_px``, ``p_detect`` and ``clutter_per_frame`` of all cameras; None: to be estimated from the log.
    detector: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        # by `vars`, because options that note what a format reads must not note this
        least_score = vars(self)["least_score"]
        if least_score is not None and not math.isfinite(least_score):
            raise InputError(f"`least_score`: expected a finite number, found {least_score}")

    def name(self, camera: str) -> str:
        """Return the native name of a camera of the source."""
        return self.rename.get(camera, camera)

    def plain(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, JSON-able."""
        result: dict[str, Any] = {}
        for name, default in vars(ImportOptions()).items():
            value = getattr(self, name)
            if value != default:
                plain = value.plain() if isinstance(value, PerCamera) else value
                result[name] = plain.name if isinstance(plain, Path) else plain
        return result


@dataclass(frozen=True)
class Piece:
    """Some detections of one camera."""

    camera: str  # Native name
    pixels: Array  # Native pixels (n, 2); a row of NaN is a frame without detections
    frame: Array | None = None  # Frame numbers (n,), or None where the source has times only
    time_s: Array | None = None  # Times (n,), s, or None where the source has frame numbers only
    # Name of an optional column -> values (n,), NaN where there is none.
    extra: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class TruePoints:
    """Where objects were, in the unit of the source's cameras; times (s) or frame numbers, one of the two."""

    object_id: NDArray[np.int64]  # (n,)
    position: Array  # (n, 3)
    time_s: Array | None = None  # (n,)
    frame: Array | None = None  # (n,)


@dataclass
class ForeignRecording:
    """Contents of a foreign source."""

    # Its detections, in any order; None: it holds none. They may be consumed once.
    pieces: Iterable[Piece] | None = None
    cameras: dict[str, CameraConfig] = field(default_factory=dict)  # Its cameras, by native name
    truth: TruePoints | None = None  # Its points in space, where the options name a file of them
    # What the native cameras cannot hold, by native name, as the source has it; for the report.
    models: dict[str, Any] = field(default_factory=dict)
    length_unit: str | None = None  # Unit of the camera centres; None without cameras
    unit_is_assumed: bool = False  # Whether neither the source nor the user states that unit
    # Sentences: what the source does not state, and what was assumed instead. Complete once `pieces` are consumed.
    assumed: list[str] = field(default_factory=list)
    # Sentences: what is probably wrong. Complete once `pieces` are consumed.
    warnings: list[str] = field(default_factory=list)
    labels: dict[int, str] = field(default_factory=dict)  # Number in ``object_id`` -> name of the object in the source
    files: list[Path] = field(default_factory=list)  # Every file that is read
    # `rates`, `frames`: Frames per second, and first and last recorded frame, of cameras for which the source states
    # them.
    rates: dict[str, float] = field(default_factory=dict)
    frames: dict[str, tuple[int, int]] = field(default_factory=dict)
    first_frame: int = 0  # Number of a frame at time 0, for times by rate


@dataclass(frozen=True)
class ExportOptions:
    """Options of an exported file."""

    tracks: Sequence[int] | None = None  # Identities to write; None: all
    # Times are resampled to this rate, by linear interpolation within a track; None: as in the source.
    rate_hz: float | None = None
    tentative: bool = False  # Write tentative estimates too, not only confirmed ones

    def plain(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, JSON-able."""
        tracks = None if self.tracks is None else list(self.tracks)
        stated = {"tracks": tracks, "rate_hz": self.rate_hz, "tentative": self.tentative or None}
        return {name: value for name, value in stated.items() if value is not None}


Reader = Callable[[Sequence[Path], ImportOptions], ForeignRecording]
#: Writes tracks (a native file) to a path, and returns sentences about what the format cannot hold.
TracksWriter = Callable[[Path, Path, ExportOptions], list[str]]
#: Writes cameras in a unit of length to a path (a file, or a folder where the format is one).
CamerasWriter = Callable[[Mapping[str, CameraConfig], str, Path], list[str]]


@dataclass(frozen=True)
class Format:
    """A foreign format; each module of `stereophd.io.formats` has one, named ``FORMAT``."""

    title: str  # Description in one line
    read: Reader | None = None  # Reads files into a `ForeignRecording`; None: it is only written
    # Whether a file holds cameras in this format, decided by its content; None: never.
    recognises_cameras: Callable[[Path], bool] | None = None
    # `write_tracks`, `write_cameras`: Write files; None: the format has no such thing.
    write_tracks: TracksWriter | None = None
    write_cameras: CamerasWriter | None = None
    folder_files: tuple[str, ...] = ()  # What `write_cameras` writes into a folder; of other formats it writes a file


def need_package(package: str, purpose: str) -> InputError:
    """Return the error of a format whose optional package is not installed."""
    return InputError(f"{purpose} needs the package {package}; install it with: pip install {package}")
