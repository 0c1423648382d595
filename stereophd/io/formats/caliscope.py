"""caliscope: its cameras (``camera_array.toml``) and 2-D points (``xy.csv``) with the times of all frames.

Sources: the TOML file, ``xy.csv`` and ``timestamps.csv`` (or ``frame_time_history.csv``), or a folder with them.
Cameras are named ``cam0``, ``cam1``, ... after their id (older versions: port). A frame is a ``sync_index`` of a
camera; a frame in the list of times without points is empty. Points are numbered by object and keypoint.

Conventions: pixels and camera axes are the native ones; points are as detected, lens distortion included; ``x_camera
= rotation x_world + translation``, the rotation a matrix or a rotation vector. Lengths are in metres, times in
seconds of the recording computer's clock.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.documents.text_tables import first_lines, numbers, read_batches, split_line
from stereophd.io.interchange.documents.toml_cameras import read_toml, toml_camera

CAMERA_FILES = ("camera_array.toml", "config.toml")
POINT_FILES = ("xy.csv",)
TIME_FILES = ("timestamps.csv", "frame_time_history.csv", "frametimes.csv")
#: Meaning -> column, that of the newest version first.
CAMERA, SYNC, TIME = ("cam_id", "port"), ("sync_index", "frame_index"), ("frame_time",)
POINT, U, V, OBJECT = ("keypoint_id", "point_id"), ("img_loc_x",), ("img_loc_y",), ("object_id",)
# Numbers of keypoints of one object; the second object's are beyond.
KEYPOINTS_OF_AN_OBJECT = 1000


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read cameras, points with their times, or both."""
    files = [file for source in sources for file in (_files_of(source) if source.is_dir() else [source])]
    recording = ForeignRecording(files=files)
    tables = [path for path in files if path.suffix.lower() == ".csv"]
    for path in files:
        if path not in tables:
            _read_cameras(path, options, recording)
    points = [path for path in tables if _column(path, U, None) is not None]
    times = [path for path in tables if path not in points]
    if points:
        if len(points) > 1:
            raise InputError(f"expected one table of points, found {', '.join(map(str, points))}")
        recording.pieces = _pieces(points[0], times, options)
        if not times:
            recording.assumed.append("frames without points are not in the log, because no table of times lists them")
    elif tables:
        raise InputError(f"{tables[0]}: expected a table with img_loc_x, img_loc_y, found none")
    return recording


def _files_of(folder: Path) -> list[Path]:
    found = [folder / name for names in (CAMERA_FILES, POINT_FILES, TIME_FILES) for name in names]
    kept = [path for path in found if path.is_file() and (path.suffix != ".toml" or recognises_cameras(path))]
    if not kept:
        raise InputError(f"{folder}: expected {', '.join(path.name for path in found)}, found none of them")
    return kept


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
    if path.is_dir() or path.suffix.lower() != ".toml":
        return False
    try:
        tables = _camera_tables(read_toml(path))
    except InputError:
        return False
    return any("matrix" in values for values in tables.values())


def _column(path: Path, names: Sequence[str], expected: str | None) -> str | None:
    """Return which of some columns a table has."""
    lines = first_lines(path, 1)
    header = split_line(lines[0]) if lines else []
    found = next((name for name in names if name in header), None)
    if found is None and expected is not None:
        raise InputError(f"{path}: expected a column {expected}, found {', '.join(header) or 'an empty file'}")
    return found


def _pieces(points: Path, times: Sequence[Path], options: ImportOptions) -> Iterator[Piece]:
    """Yield the points, and an empty row for every listed frame (those of frames with points are dropped later)."""
    yield from _rows(points, options, True)
    for path in times:
        yield from _rows(path, options, False)


def _rows(path: Path, options: ImportOptions, has_points: bool) -> Iterator[Piece]:
    import pyarrow as pa

    wanted: dict[str, Sequence[str]] = {"camera": CAMERA, "frame": SYNC, "time": TIME}
    if has_points:
        wanted |= {"u": U, "v": V, "point": POINT}
    column = {key: _column(path, names, names[0]) or "" for key, names in wanted.items()}
    objects = _column(path, OBJECT, None)
    if has_points and objects is not None:
        column["object"] = objects
    for batch in read_batches(path, ",", dict.fromkeys(column.values(), pa.float64()), str(path)):
        values = {key: numbers(batch, name) for key, name in column.items()}
        for camera in np.unique(values["camera"]):
            mine = {key: value[values["camera"] == camera] for key, value in values.items()}
            extra: dict[str, Array] = {}
            pixels = np.full((len(mine["frame"]), 2), np.nan)
            if has_points:
                pixels = np.stack([mine["u"], mine["v"]], axis=1)
                extra["object_id"] = mine["point"] + KEYPOINTS_OF_AN_OBJECT * mine.get("object", np.zeros(1))
            yield Piece(options.name(f"cam{camera:.0f}"), pixels, mine["frame"], mine["time"], extra)


FORMAT = Format(
    "caliscope: cameras (TOML), points (xy.csv) and times",
    read=read,
    recognises_cameras=recognises_cameras,
)
