"""Control: where one of the objects truly was, on a clock of its own, or points of known place in the images."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from stereophd.core.alignment.to_points import ControlPoints, reprojection_errors
from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import Alignment
from stereophd.errors import InputError, unknown_camera
from stereophd.io.outputs.provenance import length_unit
from stereophd.io.tables.native_tables import column_names, read_native_table
from stereophd.io.tables.schemas import FLOAT
from stereophd.pipeline.evaluation.scoring import registration_report
from stereophd.wording import LOGGER

PLACE, GEOGRAPHIC = ("x", "y", "z"), ("latitude_deg", "longitude_deg", "altitude_m")
PIXEL = ("u_px", "v_px")
WHAT = "control track"
POINTS = {"camera": pa.string(), **dict.fromkeys(PIXEL, FLOAT)}
POINTS_OPTIONAL = {**dict.fromkeys((*PLACE, "std", "sigma_px"), FLOAT), "point": pa.string()}
# A pixel that misses its point by this many deviations, and medians of all, was probably given another's name.
MISTAKEN = 6.0
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


def read_control(path: Path, cameras: Sequence[Camera]) -> Control | ControlPoints:
    """Read a control track, or the points of known place that some cameras see: a Parquet or CSV table.

    A track has ``time_s, x, y, z`` or ``time_s, latitude_deg, longitude_deg, altitude_m``, and ``std`` if it is there;
    geographic places (WGS 84) become metres east, down and north of their middle. Points have ``camera, u_px, v_px, x,
    y, z``, and ``point`` (its name), ``std`` and ``sigma_px`` if they are there; a coordinate may be empty. Raises
    InputError when the table is not usable: columns, values that are not finite, times that do not increase, several
    objects, fewer than six rows, names that no camera has, cameras that move.
    """
    names = column_names(path, WHAT)
    if "u_px" in names:
        if lost := [name for name in PLACE if name not in names]:
            raise InputError(f"{path}: missing columns {', '.join(lost)} of points, or {', '.join(PLACE)} of a track")
        return _points(path, read_native_table(path, POINTS, POINTS_OPTIONAL, WHAT), cameras)
    columns = GEOGRAPHIC if set(GEOGRAPHIC) <= set(names) else PLACE
    optional = {"std": FLOAT, "object_id": pa.int64()}
    table = read_native_table(path, dict.fromkeys(("time_s", *columns), FLOAT), optional, WHAT)
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


def _points(path: Path, table: pa.Table, cameras: Sequence[Camera]) -> ControlPoints:
    """Return the points of a table, one of each name, or of each place where they have none."""
    by_name = {camera.name: number for number, camera in enumerate(cameras)}
    seen_by, count = table["camera"].to_pylist(), table.num_rows
    for row, name in enumerate(seen_by):
        if name not in by_name:
            raise InputError(f"{path}: row {row}: column camera: {unknown_camera(name, list(by_name))}")
        if not cameras[by_name[name]].pose.is_static:
            raise InputError(f"{path}: row {row}: expected a camera that stands still, found {name}, which moves")
    values = {name: np.full(count, np.nan) for name in (*PIXEL, *PLACE, "std")} | {"sigma_px": np.ones(count)}
    for name in values.keys() & set(table.column_names):
        values[name] = np.array(table[name].fill_null(np.nan), dtype=np.float64)
    for name in (*PIXEL, "sigma_px", "std"):
        is_bad = ~np.isfinite(values[name]) if name != "std" else np.zeros(count, dtype=np.bool_)
        bad = np.flatnonzero(is_bad | (values[name] <= 0.0 if name in ("sigma_px", "std") else False))
        if len(bad):
            raise InputError(f"{path}: row {bad[0]}: column {name}: expected a number, found {values[name][bad[0]]}")
    places = np.column_stack([values[name] for name in PLACE])
    if "point" not in table.column_names and np.isnan(places).any():
        raise InputError(f"{path}: expected a column point, the name of each point, where a coordinate is not known")
    keys = table["point"].to_pylist() if "point" in table.column_names else [f"{place.tolist()}" for place in places]
    names, first, point = np.unique(np.array(keys, dtype=str), return_index=True, return_inverse=True)
    unlike = np.flatnonzero(~((places == places[first][point]) | np.isnan(places + places[first][point])).all(axis=1))
    if len(unlike):
        row = unlike[0]
        raise InputError(f"{path}: row {row}: expected point {keys[row]} at one place, found another than before")
    camera = np.array([by_name[name] for name in seen_by], dtype=np.int64)
    pixels = np.column_stack([values[name] for name in PIXEL])
    stated = values["std"][first], tuple(names.tolist()), length_unit(table.schema.metadata)
    return ControlPoints(camera, pixels, values["sigma_px"], point, places[first], *stated)


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


def points_report(points: ControlPoints, cameras: Sequence[Camera], where: str) -> dict[str, Any]:
    """Return how far, px, cameras in the world see known places from their pixels; warn of what seems mistaken."""
    errors = reprojection_errors(points, cameras)
    known = np.isfinite(errors)
    median, p90 = np.quantile(errors[known], [0.5, 0.9]).tolist()
    for row in np.flatnonzero(known & (errors > MISTAKEN * np.maximum(points.sigma_px, median))):
        name, camera = points.names[points.point[row]], cameras[points.camera[row]].name
        LOGGER.warning(
            "%s: point %s in camera %s is %.1f px from its place, others %.1f px: is it another point?",
            where, name, camera, errors[row], median,
        )  # fmt: skip
    return {"residual_px": {"median": median, "p90": p90, "n": int(known.sum())}}
