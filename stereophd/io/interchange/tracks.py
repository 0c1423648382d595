"""Tracks for export: read in pieces, chosen by identity, resampled to a rate."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyarrow import RecordBatch, compute

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.interchange.base import ExportOptions
from stereophd.io.outputs.provenance import length_unit as unit_of
from stereophd.io.tables import reading
from stereophd.io.tables.schemas import CONFIRMED, EXTENTS, STD, STRING, TRACKS

# Columns that a table of tracks may lack.
OPTIONAL = {"status": STRING, **{field.name: field.type for field in (*STD, *EXTENTS)}}
COLUMNS = ("time_s", "camera", "frame", "track_id", "x", "y", "z", "vx", "vy", "vz", "covariance", "existence")
# Times within this share of the period count as multiples of it.
REGULAR = 1e-3
# Most times of a file at a fixed rate: days at hundreds per second.
MOST_TIMES = 50_000_000


def optional_columns(path: Path) -> list[str]:
    """Return the names of the columns that a table of tracks has beside `COLUMNS`: status, standard deviations."""
    with reading.open_parquet(path, "table of tracks") as parquet:
        return [name for name in OPTIONAL if name in parquet.schema_arrow.names]


def batches(path: Path, options: ExportOptions) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the rows of ``tracks.parquet`` in pieces: arrays by column, the covariance (n, 36).

    Raises InputError when it is not a table of tracks, or the chosen identities are not in it.
    """
    kinds = {name: TRACKS.field(name).type for name in COLUMNS}
    wanted = None if options.tracks is None else [track for track in options.tracks if abs(track) < 1 << 63]
    seen: set[int] = set()
    with reading.open_parquet(path, "table of tracks") as parquet:
        present = reading.check_columns(parquet.schema_arrow, kinds, OPTIONAL, path)
    kinds |= {name: OPTIONAL[name] for name in present}
    start = 0
    for batch in reading.read_pieces(path, list(kinds), "table of tracks"):
        reading.finite_column(batch, "time_s", path, start)
        start += len(batch)
        if "status" in kinds and not options.tentative:
            batch = batch.filter(compute.equal(batch.column("status"), CONFIRMED))
        columns = [reading.cast_column(batch.column(name), name, kinds[name], path) for name in kinds]
        for name, column in zip(kinds, columns, strict=True):
            if column.null_count and name == "track_id":
                raise InputError(f"{path}: column {name}: expected a value in every row, found a row without")
        rows = reading.arrays_of(RecordBatch.from_arrays(columns, list(kinds)))
        if wanted is not None:
            keep = np.isin(rows["track_id"], wanted)
            rows = {name: values[keep] for name, values in rows.items()}
        seen.update(np.unique(rows["track_id"]).tolist())
        if len(rows["time_s"]):
            yield rows
    if wanted is not None and (missing := set(options.tracks or ()) - seen):
        raise InputError(f"{path}: expected the tracks {sorted(missing)}, found none of that identity")


def trajectories(path: Path, options: ExportOptions) -> dict[int, tuple[Array, Array]]:
    """Return each track's times (n,) and states (n, 6), by identity; at each time its last row.

    Errors are those of `batches`, and an InputError when there is no track.
    """
    times: dict[int, list[Array]] = {}
    states: dict[int, list[Array]] = {}
    for rows in batches(path, options):
        state = np.stack([rows[axis] for axis in ("x", "y", "z", "vx", "vy", "vz")], axis=1)
        for track in np.unique(rows["track_id"]).tolist():
            mine = rows["track_id"] == track
            times.setdefault(track, []).append(rows["time_s"][mine])
            states.setdefault(track, []).append(state[mine])
    if not times:
        raise InputError(f"{path}: expected tracks to export, found none")
    result = {}
    for track in sorted(times):
        time, state = np.concatenate(times[track]), np.concatenate(states[track])
        order = np.argsort(time, kind="stable")
        time, state = time[order], state[order]
        last = np.append(np.diff(time) != 0, True)
        result[track] = time[last], state[last]
    return result


def on_grid(path: Path, options: ExportOptions) -> tuple[float, Array, dict[int, Array]]:
    """Return tracks at a fixed rate, Hz, as motion-capture formats need them: the rate, times (n,), s, and positions.

    Positions (n, 3), by identity, are NaN where the track does not exist. Raises InputError when the reported times
    have no fixed rate, and the options state none.
    """
    tracks = trajectories(path, options)
    every = np.unique(np.concatenate([time for time, _ in tracks.values()]))
    if options.rate_hz is not None:
        rate = options.rate_hz
        first, last = np.ceil(float(every[0]) * rate - REGULAR), np.floor(float(every[-1]) * rate + REGULAR)
        _check_count(last - first, path)
        times = (np.arange(first, last + 1) + 0.0) / rate
        if not len(times):
            raise InputError(f"rate: expected a rate at which the tracks have a frame, found {rate:g} Hz")
    else:
        rate, times = _regular(every, path)
    result = {}
    for track, (time, state) in tracks.items():
        positions = np.full((len(times), 3), np.nan)
        inside = (times >= time[0] - REGULAR / rate) & (times <= time[-1] + REGULAR / rate)
        for axis in range(3):
            positions[inside, axis] = np.interp(times[inside], time, state[:, axis])
        result[track] = positions
    return rate, times, result


def _check_count(count: float, path: Path) -> None:
    if not count <= MOST_TIMES:
        raise InputError(
            f"{path}: expected at most {MOST_TIMES} times at the rate, found {count:.3g}: too long a pause?"
        )


def _regular(every: Array, path: Path) -> tuple[float, Array]:
    """Return the rate of times that are multiples of a period, and all multiples between the first and the last."""
    steps = np.diff(every)
    if len(steps):
        count = np.rint(steps / steps.min())
        period = float(steps.sum() / count.sum())
        if np.abs(steps - count * period).max() <= REGULAR * period:
            _check_count(count.sum(), path)
            return 1.0 / period, every[0] + np.arange(int(count.sum()) + 1) * period
    raise InputError(
        f"{path}: expected reports at a fixed rate for this format, found irregular times; state `rate_hz` to "
        "resample to, or track with report.times: {grid: SECONDS}"
    )


def length_unit(path: Path) -> str:
    """Return the unit of length of a table of tracks; metres where it names none."""
    return unit_of(reading.read_metadata(path, "table of tracks")) or "m"
