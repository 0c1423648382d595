"""Files that `stereophd.commands.evaluate` reads: tracks and scans, truth, log, cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.truth.interpolation import Events, Truth
from stereophd.core.metrics.truth.registration import TrackedPlaces
from stereophd.core.metrics.truth.scored import Sightings
from stereophd.errors import InputError
from stereophd.io.file_kinds import LOG
from stereophd.io.outputs.provenance import from_metadata, length_unit
from stereophd.io.tables import schemas
from stereophd.io.tables.native_tables import read_native_table
from stereophd.io.tables.reading import check_columns, finite_column, open_parquet, read_pieces, read_table
from stereophd.wording import instant

# The table of events that `track` writes into the folder of its tracks.
SCANS_NAME = "scans.parquet"


@dataclass(frozen=True)
class Tracks:
    """Reported objects of a run, one row an estimate, in the order of the events."""

    events: Events  # Events of the run; without ``scans.parquet`` only those that reported an object
    all_events: bool  # Whether events that reported nothing are among them
    # `position`, `velocity`: (n, 3) arrays: In the world.
    position: Array
    velocity: Array
    covariance: Array  # (n, 3, 3) array: Covariance of the position
    track_id: Integers  # (n,) array: Identities, negative if the filter gives none
    confirmed: NDArray[np.bool_]  # (n,) bool array: Whether each estimate is confirmed, rather than tentative
    metadata: Mapping[str, Any] | None  # Provenance that the file carries
    length_unit: str | None  # Unit that the file names
    cameras_part: Array | None = None  # (n, 3, 3) array: The part of the covariance that comes from uncertain cameras

    def confirmed_estimates(self) -> TrackedPlaces:
        """Return the confirmed estimates, in order of time."""
        rows, starts = rows_of(self.events)
        times = np.repeat(self.events.time_s, np.diff(starts))
        every = TrackedPlaces(times, self.position[rows], self.covariance[rows], self.track_id[rows])
        return every.take(self.confirmed[rows])


def rows_of(events: Events) -> tuple[Integers, Integers]:
    """Return the rows of tracks that belong to events, one event after the other, and where each event starts."""
    count = events.row_end - events.row_start
    starts = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return np.arange(starts[-1]) + np.repeat(events.row_start - starts[:-1], count), starts


def read_tracks(path: Path) -> Tracks:
    """Read ``tracks.parquet`` and, where it is there, ``scans.parquet`` beside it.

    Raises InputError when a file is not what it should be: columns, types, values that are not finite, times out of
    order, an event in two pieces, or tracks of events that the scans do not have.
    """
    required = {**schemas.KEY, "track_id": schemas.INTEGER, **schemas.POSITION, **schemas.VELOCITY}
    table = read_table(path, required, {"status": schemas.STRING}, "table of tracks")
    position, velocity = _vectors(table, schemas.POSITION, path), _vectors(table, schemas.VELOCITY, path)
    cameras: dict[str, int] = {}
    rows = _keys(table, path, cameras)
    starts = np.flatnonzero(np.append(True, rows[1:] != rows[:-1])[: len(rows)]).astype(np.int64)
    ends = np.append(starts[1:], table.num_rows).astype(np.int64)[: len(starts)]
    keys = rows[starts]
    all_events = path.with_name(SCANS_NAME).exists()
    if all_events:
        events = _events_of_scans(keys, starts, ends, path, cameras)
    else:
        if (repeated := _first_repeated(keys)) is not None:
            raise _split_event(path, int(starts[repeated]))
        events = Events(keys["time_s"].copy(), starts, ends)
    with open_parquet(path) as parquet:
        has_part = schemas.CAMERAS_PART.name in parquet.schema_arrow.names
    return Tracks(
        events=events,
        all_events=all_events,
        position=position,
        velocity=velocity,
        covariance=_position_covariances(path, "covariance"),
        track_id=_integers(table, "track_id"),
        confirmed=_confirmed(table, path),
        metadata=from_metadata(table.schema.metadata),
        length_unit=length_unit(table.schema.metadata),
        cameras_part=_position_covariances(path, schemas.CAMERAS_PART.name) if has_part else None,
    )


def read_truth(path: Path) -> tuple[Truth, str | None]:
    """Read ``truth.parquet``, or a text with its columns: the true objects, and the unit of length that the file names.

    Raises InputError when it is not a table of truth, has no rows, values that are not finite, an object twice at one
    time, or only some of vx, vy, vz.
    """
    required = {"time_s": schemas.FLOAT, "object_id": schemas.INTEGER, **schemas.POSITION}
    table = read_native_table(path, required, schemas.VELOCITY, "table of true positions")
    if table.num_rows == 0:
        raise InputError(f"{path}: expected a table of true positions, found one without rows")
    given = [name for name in schemas.VELOCITY if name in table.column_names]
    if given and len(given) < len(schemas.VELOCITY):
        raise InputError(f"{path}: expected all or none of the columns vx, vy, vz, found {', '.join(given)}")
    time_s, object_id = finite_column(table, "time_s", path), _integers(table, "object_id")
    position = _vectors(table, schemas.POSITION, path)
    velocity = _vectors(table, schemas.VELOCITY, path) if given else None
    order = np.lexsort((time_s, object_id))
    time_s, object_id = time_s[order], object_id[order]
    twice = np.flatnonzero((np.diff(time_s) == 0) & (np.diff(object_id) == 0))
    if twice.size:
        row, other = sorted((int(order[twice[0]]), int(order[twice[0] + 1])))
        what = f"object {object_id[twice[0]]} at {instant(time_s[twice[0]])} s"
        raise InputError(f"{path}: row {other}: {what} is there already in row {row}")
    truth = Truth(time_s, object_id, position[order], None if velocity is None else velocity[order])
    return truth, length_unit(table.schema.metadata)


def is_truth(path: Path) -> bool:
    """Whether a file may be a truth: a table with its columns, or one that cannot be read."""
    try:
        with open_parquet(path) as parquet:
            return {"time_s", "object_id", *schemas.POSITION} <= set(parquet.schema_arrow.names)
    except InputError:
        return True


def read_sightings(path: Path, cameras: Sequence[Camera] | None) -> Sightings:
    """Read from a detection log when each camera detected something.

    The rows need not be in order: bad rows are the tracker's business. The clocks of the cameras turn times of the log
    into true times; without cameras the log is on true time. Raises InputError when it is not a detection log, times
    are not finite, or a camera is not among the cameras.
    """
    optional = {"u_px": schemas.FLOAT, "object_id": schemas.INTEGER}
    table = read_table(path, {"time_s": schemas.FLOAT, "camera": schemas.STRING}, optional, LOG)
    if "u_px" not in table.column_names:
        raise InputError(f"{path}: missing column u_px; expected a detection log")
    # A null pixel is an empty frame, which is not a sighting.
    table = table.filter(pc.is_valid(table["u_px"]))
    time_s = finite_column(table, "time_s", path)
    camera, names = _names(table)
    if cameras is not None:
        clocks = {one.name: one.clock for one in cameras}
        unknown = [name for name in names if name not in clocks]
        if unknown:
            raise InputError(f"{path}: expected the cameras {', '.join(clocks)}, found {unknown[0]}")
        offset = np.array([clocks[name].offset_s for name in names])
        rate = np.array([clocks[name].rate for name in names])
        time_s = offset[camera] + rate[camera] * time_s
    object_id = None
    if "object_id" in table.column_names:
        object_id = np.array(pc.fill_null(table["object_id"], -1), dtype=np.int64)
    return Sightings(time_s, camera, object_id)


def cameras_of_record(record: Mapping[str, Any] | None) -> list[Camera] | None:
    """Return the cameras of the configuration in a provenance, None if it holds none that can be read."""
    from pydantic import ValidationError

    from stereophd.io.cameras.models import CameraConfig

    try:
        described = ((record or {}).get("config") or {}).get("cameras") or {}
        return [CameraConfig.model_validate(value).build(name) for name, value in described.items()] or None
    except (AttributeError, ValidationError, ValueError):
        # Written by another version, or no mapping: the tracks can be scored all the same.
        return None


def _keys(table: pa.Table, path: Path, cameras: dict[str, int]) -> NDArray[Any]:
    """Return time, camera and frame of the rows (n,), compared as a whole; `cameras` numbers the names, and grows."""
    time_s = finite_column(table, "time_s", path)
    backwards = np.flatnonzero(np.diff(time_s) < 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        raise InputError(
            f"{path}: row {row}: expected times in order, found time_s {time_s[row]} after {time_s[row - 1]}"
        )
    camera, names = _names(table)
    number = np.array([cameras.setdefault(name, len(cameras)) for name in names], dtype=np.int64)
    columns = time_s, number[camera], _integers(table, "frame")
    kinds = [("time_s", np.float64), ("camera", np.int64), ("frame", np.int64)]
    return np.asarray(np.rec.fromarrays(columns, dtype=kinds))


def _first_repeated(keys: NDArray[Any]) -> int | None:
    """Return the first row whose key is that of an earlier row, None if all keys differ."""
    first: dict[Any, int] = {}
    return next((row for row, key in enumerate(keys.tolist()) if first.setdefault(key, row) != row), None)


def _events_of_scans(
    keys: NDArray[Any], starts: Integers, ends: Integers, path: Path, cameras: dict[str, int]
) -> Events:
    """Return the events of ``scans.parquet`` and the rows of tracks that belong to each."""
    scans_path = path.with_name(SCANS_NAME)
    scans = _keys(read_table(scans_path, schemas.KEY, what="table of scans"), scans_path, cameras)
    if (twice := _first_repeated(scans)) is not None:
        raise InputError(f"{scans_path}: row {twice}: this event (time_s, camera, frame) is there already")
    rows = {key: row for row, key in enumerate(scans.tolist())}
    event = np.array([rows.get(key, -1) for key in keys.tolist()], dtype=np.int64)
    unknown = np.flatnonzero(event < 0)
    if unknown.size:
        event_text = "its event (time_s, camera, frame)"
        raise InputError(f"{path}: row {starts[unknown[0]]}: {event_text} is not in {SCANS_NAME} beside it")
    disorder = np.flatnonzero(np.diff(event) <= 0)
    if disorder.size:
        raise _split_event(path, int(starts[disorder[0] + 1]))
    row_start, row_end = np.zeros((2, len(scans)), dtype=np.int64)
    row_start[event], row_end[event] = starts, ends
    return Events(scans["time_s"].copy(), row_start, row_end)


def _split_event(path: Path, row: int) -> InputError:
    return InputError(f"{path}: row {row}: expected all rows of an event together and in the order of the events")


def _integers(table: pa.Table, name: str) -> Integers:
    return np.array(table[name], dtype=np.int64)


def _confirmed(table: pa.Table, path: Path) -> NDArray[np.bool_]:
    """Return which estimates are confirmed: all of a table without the column ``status``."""
    if "status" not in table.column_names:
        return np.ones(table.num_rows, dtype=bool)
    status = table["status"]
    confirmed = np.asarray(pc.equal(status, schemas.CONFIRMED), dtype=bool)
    unknown = np.flatnonzero(~confirmed & ~np.asarray(pc.equal(status, schemas.TENTATIVE), dtype=bool))
    if unknown.size:
        found = status[int(unknown[0])].as_py()
        expected = f"{schemas.CONFIRMED} or {schemas.TENTATIVE}"
        raise InputError(f"{path}: row {unknown[0]}: column status: expected {expected}, found {found}")
    return confirmed


def _names(table: pa.Table) -> tuple[Integers, list[str]]:
    """Return the camera of each row as an index into a list of names."""
    chunks = table["camera"].chunks or [pa.array([], schemas.STRING)]
    encoded = pa.concat_arrays(chunks).dictionary_encode()
    return np.asarray(encoded.indices, dtype=np.int64), encoded.dictionary.to_pylist()


def _vectors(table: pa.Table, names: Mapping[str, Any], path: Path) -> Array:
    return np.stack([finite_column(table, name, path) for name in names], axis=1)


def _position_covariances(path: Path, name: str) -> Array:
    """Read the position part (n, 3, 3) of a column of covariances, piece by piece."""
    pieces = [np.zeros((0, 3, 3))]
    with open_parquet(path, "table of tracks") as parquet:
        check_columns(parquet.schema_arrow, {name: schemas.COVARIANCE}, {}, path)
    for batch in read_pieces(path, [name]):
        column = batch.column(0)
        if column.null_count or column.flatten().null_count:
            raise InputError(f"{path}: column {name}: expected values, found null")
        full = np.asarray(column.flatten(), dtype=np.float64).reshape(-1, 6, 6)
        pieces.append(full[:, :3, :3].copy())
    return np.concatenate(pieces)
