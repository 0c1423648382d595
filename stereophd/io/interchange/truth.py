"""Points in space of other programs, which become a truth: wide tables and long ones; the unit of their times."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.settings import LATEST_S
from stereophd.errors import InputError
from stereophd.io.file_kinds import CSV, PARQUET, kind_of_file
from stereophd.io.interchange.base import ImportOptions, TruePoints
from stereophd.io.interchange.documents.text_tables import header_of, number_batches
from stereophd.wording import instant

#: Numbers of the points of one object; the second object's are beyond.
POINTS_OF_A_GROUP = 1000
# Columns of a native truth.
NATIVE = ("time_s", "object_id", "x", "y", "z")
# Header of a column of a wide table: the point and the axis.
_COORDINATE = re.compile(r"(?P<point>.+?)_(?P<axis>[xyz])", re.IGNORECASE)


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


def read_columns(path: Path, columns: Sequence[str]) -> Array:
    """Return columns of a table with a header as numbers (n, columns); InputError for one that it lacks."""
    separator, header = header_of(path)
    if missing := [name for name in columns if name not in header]:
        raise InputError(f"{path}: expected a column {missing[0]}, found {', '.join(header)[:200] or 'an empty file'}")
    batches = number_batches(path, separator, columns, str(path), header, skip=1)
    rows = [np.stack([batch[name] for name in columns], axis=1) for batch in batches]
    return np.concatenate([np.empty((0, len(columns))), *rows])


def wide_truth(path: Path, frame_column: str | None = None) -> TruePoints:
    """Return the points of a table with a row for each frame, and columns such as ``pt1_X``, ``pt1_Y``, ``pt1_Z``.

    The frame is the number in `frame_column`, else the number of the row. Raises InputError for a table without such
    columns.
    """
    _, header = header_of(path)
    axes: dict[str, dict[str, str]] = {}
    for name in header:
        if match := _COORDINATE.fullmatch(name):
            axes.setdefault(match["point"], {})[match["axis"].lower()] = name
    points = [by_axis for by_axis in axes.values() if len(by_axis) == 3]
    if not points:
        raise InputError(f"{path}: expected columns such as pt1_X, pt1_Y, pt1_Z, found {', '.join(header)[:200]}")
    has_frames = frame_column in header
    columns = [by_axis[axis] for by_axis in points for axis in "xyz"] + ([str(frame_column)] if has_frames else [])
    rows = read_columns(path, columns)
    return stacked(rows[:, : 3 * len(points)], rows[:, -1] if has_frames else None)


def native_truth(path: Path, options: ImportOptions) -> TruePoints | None:
    """Return the points of a table with the columns of a native truth, or None for any other table or file.

    Its times are in seconds. Raises InputError for a native truth as a Parquet file, which needs no import.
    """
    kind = kind_of_file(path)
    is_native = kind in (CSV, PARQUET) and set(NATIVE) <= set(header_of(path)[1])
    if is_native and kind == PARQUET:
        raise InputError(
            f"{path}: expected a table of text, found a Parquet file; a truth in that form needs no import: "
            "`stereophd evaluate` takes it as it is"
        )
    if not is_native:
        return None
    return long_truth(
        path,
        {"time": ("time_s",), "object": ("object_id",), **{axis: (axis,) for axis in "xyz"}},
        replace(options, time_unit="s"),
    )


def stacked(rows: Array, frames: Array | None = None) -> TruePoints:
    """Return the points of rows (n, 3 points), one row for each frame (its number, or those given); NaN is left out."""
    positions = rows.reshape(len(rows), -1, 3)
    row, point = np.nonzero(np.isfinite(positions).all(axis=2))
    number = np.arange(len(rows), dtype=np.float64) if frames is None else frames
    return TruePoints(point.astype(np.int64), positions[row, point], frame=number[row])


def long_truth(path: Path, names: Mapping[str, Sequence[str]], options: ImportOptions) -> TruePoints:
    """Return the points of a table with a row for each point.

    `names` has, for each of ``x``, ``y``, ``z``, ``object``, ``group`` and ``frame`` or ``time``, the columns that may
    hold it. A table without objects has one; those of a group count on from `POINTS_OF_A_GROUP` times its number.
    Raises InputError for a table that lacks another.
    """
    _, header = header_of(path)
    by_lower = {name.lower(): name for name in reversed(header)}
    columns = {
        key: next(by_lower[name.lower()] for name in usual if name.lower() in by_lower)
        for key, usual in names.items()
        if any(name.lower() in by_lower for name in usual)
    }
    for key in ("x", "y", "z"):
        if key not in columns:
            raise InputError(f"{path}: expected a column {names[key][0]}, found {', '.join(header)[:200] or 'none'}")
    if not {"frame", "time"} & columns.keys():
        raise InputError(f"{path}: expected a column of times or frames, found {', '.join(header)[:200]}")
    rows = dict(zip(columns, read_columns(path, list(columns.values())).T, strict=True))
    position = np.stack([rows["x"], rows["y"], rows["z"]], axis=1)
    seen = np.isfinite(position).all(axis=1)
    none = np.zeros(len(seen))
    label = (rows.get("object", none) + POINTS_OF_A_GROUP * rows.get("group", none))[seen].astype(np.int64)
    if "time" not in rows:
        return TruePoints(label, position[seen], frame=rows["frame"][seen])
    times = in_seconds(rows["time"][seen], options, f"{path}: column {columns['time']}")
    return TruePoints(label, position[seen], time_s=times)
