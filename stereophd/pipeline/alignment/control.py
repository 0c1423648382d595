"""Control tracks: where one of the objects truly was, on a clock of its own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from stereophd.core.alignment.to_track import Alignment
from stereophd.core.arrays import Array
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.errors import InputError
from stereophd.io.outputs.provenance import length_unit
from stereophd.io.tables.reading import open_parquet, read_table
from stereophd.io.tables.schemas import FLOAT
from stereophd.pipeline.evaluation.registering import registration_report

PLACE, GEOGRAPHIC = ("x", "y", "z"), ("latitude_deg", "longitude_deg", "altitude_m")
# Fewer rows hold no motion.
LEAST_ROWS = 6
# Equatorial radius, m, and squared eccentricity of the ellipsoid of WGS 84.
RADIUS_M, ECCENTRICITY = 6_378_137.0, 6.69437999014e-3


@dataclass(frozen=True)
class Control:
    """A control track of one object."""

    track: Truth
    std: Array | None  # (n,): Standard deviations of the places along each axis, length
    length_unit: str | None
    origin: dict[str, float] | None  # Of geographic places: where x (east), y (down) and z (north) are 0


def read_control(path: Path) -> Control:
    """Read ``time_s, x, y, z`` or ``time_s, latitude_deg, longitude_deg, altitude_m``, and ``std`` if it is there.

    Geographic places (WGS 84) become metres east, down and north of their middle. Raises InputError when the table is
    not usable: columns, values that are not finite, times that do not increase, several objects, fewer than six rows.
    """
    with open_parquet(path, "control track") as parquet:
        names = parquet.schema_arrow.names
    columns = GEOGRAPHIC if set(GEOGRAPHIC) <= set(names) else PLACE
    optional = {"std": FLOAT, "object_id": pa.int64()}
    table = read_table(path, dict.fromkeys(("time_s", *columns), FLOAT), optional, "control track")
    values = {name: np.array(table[name], dtype=np.float64) for name in table.column_names}
    for name in ("time_s", *columns, *(["std"] if "std" in values else [])):
        bad = np.flatnonzero(~np.isfinite(values[name]) | (values[name] <= 0.0 if name == "std" else False))
        if len(bad):
            raise InputError(f"{path}: row {bad[0]}: column {name}: expected a number, found {values[name][bad[0]]}")
    if "object_id" in values and len(np.unique(values["object_id"])) > 1:
        raise InputError(f"{path}: column object_id: expected one object, found {len(np.unique(values['object_id']))}")
    times = values["time_s"]
    backwards = np.flatnonzero(np.diff(times) <= 0.0)
    if len(backwards):
        raise InputError(
            f"{path}: row {backwards[0] + 1}: expected times that increase, found {times[backwards[0] + 1]}"
        )
    if len(times) < LEAST_ROWS:
        raise InputError(f"{path}: expected {LEAST_ROWS} or more rows, found {len(times)}")
    place, origin, unit = np.column_stack([values[name] for name in columns]), None, length_unit(table.schema.metadata)
    if columns == GEOGRAPHIC:
        middle = np.median(place, axis=0)
        place, unit = local_places(place, middle), "m"
        origin = dict(zip(columns, middle.tolist(), strict=True))
    return Control(Truth(times, np.zeros(len(times), dtype=np.int64), place), values.get("std"), unit, origin)


def local_places(geographic: Array, origin: Array) -> Array:
    """Metres east, down and north (n, 3) of an origin; latitudes and longitudes (degrees) and altitudes (m) (n, 3)."""
    latitude, longitude = np.deg2rad(origin[:2])
    sines, cosines = (np.array([f(longitude), f(latitude)]) for f in (np.sin, np.cos))
    (so, sa), (co, ca) = sines, cosines
    axes = np.array([[-so, co, 0.0], [-ca * co, -ca * so, -sa], [-sa * co, -sa * so, ca]])
    return np.asarray((_earth_centred(geographic) - _earth_centred(origin[None])) @ axes.T)


def _earth_centred(geographic: Array) -> Array:
    latitude, longitude = np.deg2rad(geographic[:, :2]).T
    normal = RADIUS_M / np.sqrt(1.0 - ECCENTRICITY * np.sin(latitude) ** 2)
    across = (normal + geographic[:, 2]) * np.cos(latitude)
    along = (normal * (1.0 - ECCENTRICITY) + geographic[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), along])


def alignment_report(found: Alignment, unit: str) -> dict[str, Any]:
    """Return what an alignment states, with its standard deviations, for ``report.json``."""
    std, registered = found.std, registration_report(found.registration) or {}
    clock = {**registered["clock"], "shift_std_s": float(std[7]), "rate_std": float(std[8])}
    out: dict[str, Any] = {
        **registered,
        "length_unit": unit,
        "scale_std": found.registration.scale * float(std[6]),
        "rotation_std_deg": np.rad2deg(std[:3]).tolist(),
        "translation_std": std[3:6].tolist(),
        "translation_std_at": found.center.tolist(),
        "clock": clock,
        "tracks": found.members.tolist(),
    }
    if len(found.distances):
        median, p90 = np.quantile(found.distances, [0.5, 0.9]).tolist()
        out["residual"] = {"median": median, "p90": p90, "n": len(found.distances)}
    return out
