"""A foreign format: the result of its reader, the input of its writer, and the options that it makes use of.

An option that nothing reads would silently do nothing.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.errors import InputError, unknown_camera
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.interchange.options import ExportOptions as ExportOptions
from stereophd.io.interchange.options import ImportOptions as ImportOptions
from stereophd.io.interchange.options import PerCamera as PerCamera

#: Optional columns of a log that a format may fill.
EXTRA_COLUMNS = ("sigma_u_px", "sigma_v_px", "width_px", "height_px", "score", "object_id")

# Most files that a message names.
MOST_NAMED = 4


@dataclass(frozen=True)
class Piece:
    """Some detections of one camera."""

    file: Path  # The file that has them
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
    # `rates`, `frames`, `image_sizes`: Frames per second, first and last recorded frame, size of images (px),
    # of cameras for which the source states them beside the detections.
    rates: dict[str, float] = field(default_factory=dict)
    frames: dict[str, tuple[int, int]] = field(default_factory=dict)
    image_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    lists_frames: bool = False  # Whether it has a row for every recorded frame: what is missing was not recorded
    first_frame: int = 0  # Number of a frame at time 0, for times by rate
    # `untimed`, `unnamed`: Where a table has no times, or no cameras: how to name the column that has them.
    untimed: str = ""
    unnamed: str = ""
    sought: str = "detections"  # What was looked for, of a source without detections

    @property
    def source(self) -> str:
        """The names of its files, for messages."""
        return named_files(self.files)


def named_files(files: Iterable[Path]) -> str:
    """Name files in a message: the first ones, where there are many."""
    first, *others = dict.fromkeys(map(str, files)) or ["the source"]
    return ", ".join([first, *others]) if len(others) < MOST_NAMED else f"{first} and {len(others)} other files"


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
    reads_parquet: bool = False  # Whether tables of detections may be Parquet files
    folder_files: tuple[str, ...] = ()  # What `write_cameras` writes into a folder; of other formats it writes a file


Options = TypeVar("Options", ImportOptions, ExportOptions)


def consulted(options: Options) -> tuple[Options, set[str], list[str]]:
    """Return options that note what is read of them and which cameras of the source they name, and both so far."""
    read: set[str] = set()
    asked: list[str] = []

    class Noted(type(options)):  # type: ignore[misc]
        def __getattribute__(self, name: str) -> Any:
            read.add(name)
            return super().__getattribute__(name)

        def name(self, camera: str) -> str:
            asked.append(camera)
            return str(super().name(camera))

    noted: Options = Noted(**vars(options))
    return noted, read, asked


def refuse_unread(options: Options, read: set[str], what: str) -> None:
    """Refuse, by an InputError that names the first, options that differ from their defaults and that nothing has read.

    `read` has the names of those that were read, from `consulted`; `what` was read or written: "a source of format
    mot".
    """
    for name in options.plain():
        if name not in read:
            raise InputError(f"`{name}`: expected an option that has an effect on {what}, found one that has none")


def refuse_other_cameras(
    options: ImportOptions, cameras: Sequence[str], in_source: Sequence[str], sources: Sequence[Path]
) -> None:
    """Refuse, by an InputError that names the first, statements about cameras that a source does not have.

    `cameras` are the native names of those it has, `in_source` their names in the source, from `consulted`;
    `sources` are the files that the user stated.
    """
    known, files = list(dict.fromkeys(cameras)), str(sources[0])
    if len(sources) > 1:
        files += f" and {len(sources) - 1} more"
    for key in ("rates", "offsets", "frames", "image_sizes"):
        for name in getattr(options, key).named:
            if name not in known:
                raise InputError(f"`{key}`: {unknown_camera(name, known, files)}")
    originals = list(dict.fromkeys(in_source))
    for before in options.rename:
        if before not in originals:
            raise InputError(f"`rename`: {unknown_camera(before, originals, files)}")
