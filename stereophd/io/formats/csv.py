"""Tables, as text (CSV) or Parquet: detections of any columns in, tracks out.

Detections: one row per detection, with a header or as Parquet. Tabs, semicolons and spaces separate columns as well.
Columns of the native names (``time_s``, ``camera``, ``frame``, ``u_px``, ``v_px``, ``sigma_u_px``, ``sigma_v_px``,
``width_px``, ``height_px``, ``score``, ``object_id``) or of usual other names are found by themselves; any others by
`columns`. A row without u and v is a frame without detections. Without a column of cameras, each file is a camera,
named as the file. Pixels are native (pixel (0, 0) is the centre of the top-left pixel) unless an option changes that.

Points in space (`truth`): columns x, y and z, times or frames as the detections have them (also those of `columns`, and
of `time_unit`), and where there are several objects their numbers (``object_id``, ``track_id``, ``id``).

Tracks: the columns of ``tracks.parquet``; the covariance as its upper triangle, ``cov_x_x``, ``cov_x_y``, ..., after
``existence`` ``status`` and ``std_x``, ``std_y``, ``std_z`` where the table has them. Numbers have 17 digits, which is
exact; names of cameras are quoted where they need it, and one that begins like a formula gets an apostrophe before it.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from stereophd.errors import InputError
from stereophd.io.interchange.base import EXTRA_COLUMNS, ExportOptions, ForeignRecording, Format, ImportOptions, Piece
from stereophd.io.interchange.documents.text_tables import header_of, read_batches
from stereophd.io.interchange.pixels import native_pixels
from stereophd.io.interchange.truth import in_seconds, long_truth

#: Native column -> names by which other programs call it, in lower case; the first that is there is taken.
USUAL_NAMES: Mapping[str, tuple[str, ...]] = {
    "time_s": ("time_s", "time", "t", "timestamp", "seconds"),
    "camera": ("camera", "cam", "cam_id", "camera_id", "view", "camera_name"),
    "frame": ("frame", "frame_id", "frame_number", "frame_idx", "frame_index", "framenumber", "image"),
    "u_px": ("u_px", "u", "x_px", "x", "px", "img_x", "col", "pixel_x"),
    "v_px": ("v_px", "v", "y_px", "y", "py", "img_y", "row", "pixel_y"),
    "sigma_u_px": ("sigma_u_px",),
    "sigma_v_px": ("sigma_v_px",),
    "width_px": ("width_px",),
    "height_px": ("height_px",),
    "score": ("score", "confidence", "likelihood", "conf", "probability"),
    "object_id": ("object_id",),
}
#: The same of points in space.
NAMES_IN_SPACE: Mapping[str, tuple[str, ...]] = {
    "x": ("x", "x_m", "x_mm", "x_world"),
    "y": ("y", "y_m", "y_mm", "y_world"),
    "z": ("z", "z_m", "z_mm", "z_world"),
    "time": USUAL_NAMES["time_s"],
    "frame": USUAL_NAMES["frame"],
    "object": ("object_id", "track_id", "object", "track", "id", "label"),
}
#: Columns of a log that points in space have too; `columns` names them in both tables.
LOG_NAMES = {"time": "time_s", "frame": "frame", "object": "object_id"}
# A spreadsheet evaluates text that begins with one of these.
FORMULA = ("=", "+", "-", "@", "\t", "\r")
AXES = ("x", "y", "z", "vx", "vy", "vz")


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read tables of detections."""
    recording = ForeignRecording(files=list(sources))
    recording.pieces = _pieces(recording, sources, options)
    if options.truth is not None:
        stated = {key: (options.columns[name],) for key, name in LOG_NAMES.items() if name in options.columns}
        names = {key: (*stated.get(key, ()), *usual) for key, usual in NAMES_IN_SPACE.items()}
        recording.truth = long_truth(options.truth, names, options)
    return recording


def _pieces(recording: ForeignRecording, sources: Sequence[Path], options: ImportOptions) -> Iterator[Piece]:
    for path in sources:
        separator, header = header_of(path)
        if not any(header):
            raise InputError(f"{path}: expected a table with a header, found an empty first line")
        columns = _find_columns(path, header, options)
        named = ", ".join(f"{name} from {column}" for name, column in columns.items() if name != column)
        if named:
            recording.assumed.append(f"{path.name}: {named}")
        if "time_s" not in columns:
            recording.untimed = (
                f" in the columns {', '.join(header)} of {path.name}; `columns` time_s=COLUMN names that of the times"
            )
        if "camera" not in columns:
            recording.assumed.append(
                f"{path.name}: all rows are of one camera, {options.name(path.stem)}, named as the file"
            )
            recording.unnamed = f", or `columns` camera=COLUMN if one of {', '.join(header)} names it"
        kinds = {column: pa.string() if name == "camera" else pa.float64() for name, column in columns.items()}
        taken = ", ".join(f"{name} from {column}" for name, column in columns.items())
        for batch in read_batches(path, separator, kinds, f"{path} ({taken})", list(header), skip=1):
            yield from _split(path, batch, columns, options, recording)


def _find_columns(path: Path, header: Sequence[str], options: ImportOptions) -> dict[str, str]:
    """Return native column -> column of the table."""
    by_lower = {name.lower(): name for name in reversed(header)}
    columns: dict[str, str] = {}
    for name, stated in options.columns.items():
        if name not in USUAL_NAMES:
            raise InputError(f"column {name}: expected a column of a log ({', '.join(USUAL_NAMES)}), found {name}")
        if stated not in header:
            raise InputError(f"{path}: expected a column {stated} (for {name}), found {', '.join(header)}")
        columns[name] = stated
    for name, usual in USUAL_NAMES.items():
        found = next((by_lower[candidate] for candidate in usual if candidate in by_lower), None)
        if name not in columns and found is not None and found not in columns.values():
            columns[name] = found
    missing = [name for name in ("u_px", "v_px") if name not in columns]
    missing += [] if {"time_s", "frame"} & columns.keys() else ["time_s or frame"]
    if missing:
        raise InputError(
            f"{path}: expected columns for {', '.join(missing)}, found {', '.join(filter(None, header))}; state which "
            f"they are by `columns` {missing[0].split()[-1]}=COLUMN"
        )
    return {name: columns[name] for name in USUAL_NAMES if name in columns}


def _split(
    path: Path, batch: pa.RecordBatch, columns: Mapping[str, str], options: ImportOptions, recording: ForeignRecording
) -> Iterator[Piece]:
    """Yield the rows of a batch camera by camera."""
    values = {
        name: batch.column(column).to_numpy(zero_copy_only=False)
        for name, column in columns.items()
        if name != "camera"
    }
    if "camera" in columns:
        encoded = batch.column(columns["camera"]).dictionary_encode()
        codes = encoded.indices.to_numpy(zero_copy_only=False)
        names = encoded.dictionary.to_pylist()
    else:
        codes, names = np.zeros(len(batch), dtype=int), [path.stem]
    for code, name in enumerate(names):
        mine = {key: column[codes == code] for key, column in values.items()}
        camera = options.name(name.strip())
        pixels = np.stack([mine["u_px"], mine["v_px"]], axis=1)
        where = f"{path}: column {columns.get('time_s')}"
        time = in_seconds(mine["time_s"], options, where) if "time_s" in mine else None
        extra = {key: mine[key] for key in EXTRA_COLUMNS if key in mine}
        yield Piece(path, camera, native_pixels(pixels, camera, options, recording), mine.get("frame"), time, extra)


def _inert(cell: Any) -> Any:
    """Return a cell that no spreadsheet evaluates: text that begins like a formula gets an apostrophe before it."""
    return f"'{cell}" if isinstance(cell, str) and cell[:1] in FORMULA else cell


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write tracks as a table."""
    from stereophd.io.interchange.tracks import batches, optional_columns

    upper = [(i, j) for i in range(6) for j in range(i, 6)]
    plain, more = ("time_s", "camera", "frame", "track_id", *AXES), optional_columns(tracks)
    names = [*plain, *(f"cov_{AXES[i]}_{AXES[j]}" for i, j in upper), "existence", *more]
    with open(target, "w", encoding="utf-8", newline="\n") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(names)
        for rows in batches(tracks, options):
            columns = [rows[name] for name in plain]
            columns += [rows["covariance"][:, 6 * i + j] for i, j in upper]
            columns += [rows[name] for name in ("existence", *more)]
            cells = [map(_inert, c.tolist()) if c.dtype == object else c.tolist() for c in columns]
            table.writerows(zip(*cells, strict=True))
    return []


FORMAT = Format(
    "a table of detections, any columns; tracks as a table", read=read, write_tracks=write_tracks, reads_parquet=True
)
