"""caliscope: its cameras (``camera_array.toml``) and 2-D points (``xy.csv``) with the times of all frames.

Sources: the TOML file, ``xy.csv`` and ``timestamps.csv`` (or ``frame_time_history.csv``), a folder with them, or the
folder of a session, whose points are in ``calibration/extrinsic``, one of its folders (``CHARUCO/xy_CHARUCO.csv``),
``recordings``, or ``recording_...`` (older versions). Cameras are named ``cam0``, ``cam1``, ... after their id (older
versions: port). A frame is a ``sync_index`` of a camera, or the number of its row where the times have none; a frame in
the list of times without points is empty, and one that the list lacks was not recorded. Points are numbered by object
and keypoint. Points in space (``xyz_....csv``) are the truth.

Conventions: pixels and camera axes are the native ones; points are as detected, lens distortion included; ``x_camera
= rotation x_world + translation``, the rotation a matrix or a rotation vector. Lengths are in metres, times in
seconds (or `time_unit`) of the recording computer's clock.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.documents.text_tables import header_of, number_batches
from stereophd.io.interchange.documents.toml_cameras import read_toml, toml_camera
from stereophd.io.interchange.truth import POINTS_OF_A_GROUP, in_seconds, long_truth, read_columns

CAMERA_FILES = ("camera_array.toml", "config.toml")
POINT_FILES = "xy*.csv"
#: Where a session has its points: the first of these with one table.
POINT_FOLDERS = ("calibration/extrinsic", "calibration/extrinsic/*", "recordings/*", "recordings/*/*", "recording_*")
TIME_FILES = ("timestamps.csv", "frame_time_history.csv", "frametimes.csv")
#: Meaning -> column, that of the newest version first.
CAMERA, SYNC, TIME = ("cam_id", "port"), ("sync_index", "frame_index"), ("frame_time",)
POINT, U, V, OBJECT = ("keypoint_id", "point_id"), ("img_loc_x",), ("img_loc_y",), ("object_id",)
IN_SPACE = {
    "x": ("x_coord",),
    "y": ("y_coord",),
    "z": ("z_coord",),
    "time": TIME,
    "frame": SYNC,
    "object": POINT,
    "group": OBJECT,
}


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read cameras, points with their times, or both."""
    recording = ForeignRecording()
    files = [file for source in sources for file in (_files_of(source, recording) if source.is_dir() else [source])]
    recording.files = files
    tables = [path for path in files if path.suffix.lower() == ".csv"]
    for path in files:
        if path not in tables:
            _read_cameras(path, options, recording)
    points = [path for path in tables if _column(path, U, None) is not None]
    times = [path for path in tables if path not in points]
    if points:
        if len(points) > 1:
            raise InputError(f"expected one table of points, found {', '.join(map(str, points))}")
        recording.pieces, recording.lists_frames = _pieces(points[0], times, options), bool(times)
        if not times:
            recording.assumed.append("frames without points are not in the log, because no table of times lists them")
    elif tables:
        raise InputError(f"{tables[0]}: expected a table with img_loc_x, img_loc_y, found none")
    if options.truth is not None:
        recording.truth = long_truth(options.truth, IN_SPACE, options)
    return recording


def _files_of(folder: Path, recording: ForeignRecording) -> list[Path]:
    """Return the cameras, points and times of a session, or of a folder of it."""
    cameras = [path for name in CAMERA_FILES if (path := folder / name).is_file() and recognises_cameras(path)][:1]
    places = [folder, *(place for pattern in POINT_FOLDERS for place in sorted(folder.glob(pattern)))]
    files = [path for place in places for path in sorted(place.glob(POINT_FILES)) if path.is_file()]
    tables = [path for path in files if _column(path, U, None) is not None]
    if not tables:
        # a table of points whose columns have other names is not left out; those of points in space may have any
        for path in files:
            if not path.name.startswith("xyz"):
                _column(path, U, U[0])
        if not cameras:
            raise InputError(
                f"{folder}: expected {' or '.join(CAMERA_FILES)}, or points ({POINT_FILES}) there or in "
                f"{', '.join(POINT_FOLDERS)}; found none of them"
            )
        recording.assumed.append(
            f"{folder}: cameras only: no points ({POINT_FILES}) there or in {', '.join(POINT_FOLDERS)}"
        )
        return cameras
    points = tables[0]
    if others := [str(path.relative_to(folder)) for path in tables[1:]]:
        chosen = points.relative_to(folder)
        recording.assumed.append(f"{folder}: the points are those of {chosen}, not of {', '.join(others)}")
    near = [
        path
        for place in (points.parent, points.parent.parent)
        for name in TIME_FILES
        if (path := place / name).is_file()
    ]
    return [*cameras, points, *near[:1]]


def _read_cameras(path: Path, options: ImportOptions, recording: ForeignRecording) -> None:
    tables = _camera_tables(read_toml(path))
    if not tables:
        raise InputError(f"{path}: expected tables [cameras.N] or [cam_N] with a matrix, found none")
    for key, values in tables.items():
        if values.get("ignore"):
            recording.assumed.append(f"camera {key} is left out: the file marks it as ignored")
            continue
        name = options.name(f"cam{values.get('cam_id', values.get('port', key))}")
        recording.cameras[name] = toml_camera(name, values, options, str(path))
    recording.length_unit = options.length_unit or "m"


def _camera_tables(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    nested = document.get("cameras")
    if isinstance(nested, dict):
        return {str(key): value for key, value in nested.items() if isinstance(value, dict)}
    tables = {
        key.removeprefix("cam_"): v for key, v in document.items() if key.startswith("cam_") and isinstance(v, dict)
    }
    return {key: value for key, value in tables.items() if {"port", "cam_id"} & value.keys()}


def recognises_cameras(path: Path) -> bool:
    """Whether a file is TOML with tables ``[cameras.N]``, or ``[cam_N]`` with a port."""
    tables = _camera_tables(read_toml(path)) if path.suffix.lower() == ".toml" else {}
    return any("matrix" in values for values in tables.values())


def _column(path: Path, names: Sequence[str], expected: str | None) -> str | None:
    """Return which of some columns a table has."""
    _, header = header_of(path)
    found = next((name for name in names if name in header), None)
    if found is None and expected is not None:
        raise InputError(f"{path}: expected a column {expected}, found {', '.join(header) or 'an empty file'}")
    return found


def _pieces(points: Path, times: Sequence[Path], options: ImportOptions) -> Iterator[Piece]:
    """Yield the points, and an empty row for every listed frame (those of frames with points are dropped later)."""
    # without a common index the frames of a camera are the rows of its times
    is_counted = any(_column(path, SYNC, None) is None for path in times)
    yield from _rows(points, options, True, SYNC[::-1] if is_counted else SYNC)
    for path in times:
        yield from _counted(path, options) if is_counted else _rows(path, options, False, SYNC)


def _counted(path: Path, options: ImportOptions) -> Iterator[Piece]:
    """Yield an empty row for each time of a camera, numbered in order."""
    camera, time = read_columns(path, [_column(path, names, names[0]) or "" for names in (CAMERA, TIME)]).T
    for number in np.unique(camera):
        mine = np.sort(time[camera == number])
        frames, mine = np.arange(len(mine), dtype=np.float64), in_seconds(mine, options, f"{path}: column {TIME[0]}")
        yield Piece(path, options.name(f"cam{number:.0f}"), np.full((len(mine), 2), np.nan), frames, mine)


def _rows(path: Path, options: ImportOptions, has_points: bool, sync: Sequence[str]) -> Iterator[Piece]:
    wanted: dict[str, Sequence[str]] = {"camera": CAMERA, "frame": sync, "time": TIME}
    if has_points:
        wanted |= {"u": U, "v": V, "point": POINT}
    column = {key: _column(path, names, names[0]) or "" for key, names in wanted.items()}
    objects = _column(path, OBJECT, None)
    if has_points and objects is not None:
        column["object"] = objects
    for batch in number_batches(path, ",", column.values(), str(path)):
        values = {key: batch[name] for key, name in column.items()}
        values["time"] = in_seconds(values["time"], options, f"{path}: column {column['time']}")
        for camera in np.unique(values["camera"]):
            mine = {key: value[values["camera"] == camera] for key, value in values.items()}
            extra: dict[str, Array] = {}
            pixels = np.full((len(mine["frame"]), 2), np.nan)
            if has_points:
                pixels = np.stack([mine["u"], mine["v"]], axis=1)
                extra["object_id"] = mine["point"] + POINTS_OF_A_GROUP * mine.get("object", np.zeros(1))
            yield Piece(path, options.name(f"cam{camera:.0f}"), pixels, mine["frame"], mine["time"], extra)


FORMAT = Format(
    "caliscope: cameras (TOML), points (xy.csv) and times", read=read, recognises_cameras=recognises_cameras
)
