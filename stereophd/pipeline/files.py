"""Logs and camera files for programs: read into objects, and written from them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from stereophd.config.loading import load_cameras
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.cameras import writing as camera_files
from stereophd.io.cameras.writing import camera_config
from stereophd.io.logs.reading import LogReader
from stereophd.io.logs.rows import OPTIONAL, REQUIRED, log_schema
from stereophd.io.outputs.atomic import atomic_write
from stereophd.io.tables.writing import TableWriter

# Columns that a log may have; no filter reads the score.
_OPTIONAL = {**OPTIONAL, "score": pa.float64()}
# Columns that a frame without detections leaves empty.
_OF_DETECTIONS = frozenset({"u_px", "v_px", *_OPTIONAL})


def read_cameras(path: Path | str) -> tuple[Camera, ...]:
    """Read a ``cameras.yaml``: its cameras in the order of the file, with lengths in the unit of the file.

    Raises InputError when it cannot be read or is not valid.
    """
    return tuple(camera.build(name) for name, camera in load_cameras(path).cameras.items())


def write_cameras(path: Path | str, cameras: Sequence[Camera], length_unit: str, force: bool = False) -> None:
    """Write a ``cameras.yaml``, whose centres are in ``m``, ``cm``, ``mm`` and so on; reading it gives equal cameras.

    Raises InputError when the file exists and `force` does not allow to replace it, or a camera has a value that a
    configuration does not allow.
    """
    with atomic_write(path, replace=force) as temporary:
        described = {camera.name: camera_config(camera) for camera in cameras}
        camera_files.write_cameras(temporary, described, length_unit)


def read_log(
    path: Path | str,
    cameras: Sequence[Camera],
    on_bad_row: Literal["error", "drop"] = "error",
    image_margin_px: float = 10.0,
) -> LogReader:
    """Open a detection log.

    Parameters
    ----------
    path : path
    cameras : sequence of Camera
        Cameras that the log names.
    on_bad_row : {"error", "drop"}
        Whether the first bad row raises, or bad rows are dropped and counted (`LogReader.counts`).
    image_margin_px : float
        A detection further than this outside the image is a bad row.

    Returns
    -------
    LogReader
        Iterating over it yields the frames (`Frame`) in order of true time; every iteration reads the file anew,
        in pieces, so that memory does not depend on its length.

    Raises
    ------
    InputError
        The file is not a detection log.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"log: expected a path, found {type(path).__name__}; `write_log` writes a table")
    return LogReader(path, cameras, on_bad_row, image_margin_px)


def write_log(path: Path | str, table: Any, force: bool = False) -> None:
    """Write a detection log from columns in memory.

    Parameters
    ----------
    path : path
    table : mapping of str to array_like, pandas.DataFrame or similar
        The columns of a detection log: ``time_s, camera, frame, u_px, v_px``, and optionally
        ``sigma_u_px, sigma_v_px, width_px, height_px, score, object_id``. A frame without detections is one row with
        NaN in the other columns than the first three. Rows may be in any order: they are sorted by time.
    force : bool
        Whether an existing file may be replaced.

    Raises
    ------
    InputError
        The file exists, a column is missing or unknown, columns differ in length or do not hold numbers.
    """
    target = Path(path)
    names = [str(name) for name in (table.keys() if hasattr(table, "keys") else table.column_names)]
    missing, unknown = [n for n in REQUIRED if n not in names], [n for n in names if n not in {**REQUIRED, **_OPTIONAL}]
    if missing or unknown:
        found = f"no {', '.join(missing)}" if missing else f"also {', '.join(unknown)}"
        known = f"{', '.join(REQUIRED)} and perhaps {', '.join(_OPTIONAL)}"
        raise InputError(f"{target}: expected the columns {known}, found {found}")
    columns = {name: _column(table[name], name, target) for name in names}
    if len({len(column) for column in columns.values()}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
        raise InputError(f"{target}: expected columns of one length, found {lengths}")
    order = np.argsort(np.ma.getdata(columns["time_s"]), kind="stable")
    schema = log_schema(name for name in _OPTIONAL if name in names)
    with atomic_write(target, replace=force) as temporary, TableWriter(temporary, schema) as writer:
        writer.append({name: columns[name][order] for name in schema.names})


def _column(values: Any, name: str, path: Path) -> Any:
    """Return a column as an array of its type; NaN and None become nulls where a frame may have no detection."""
    if name == "camera":
        return np.array([str(value) for value in values], dtype=object)
    kind = {**REQUIRED, **_OPTIONAL}[name]
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: column {name}: expected numbers, found another value ({error})") from None
    if name in _OF_DETECTIONS:
        masked = np.ma.masked_invalid(numbers)
        return masked if kind == pa.float64() else np.ma.array(masked.filled(0).astype(np.int64), mask=masked.mask)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: column {name}: expected a number in every row, found NaN")
    return numbers if kind == pa.float64() else numbers.astype(np.int64)
