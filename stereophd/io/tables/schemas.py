"""Parquet tables: the schemas of the native files (`docs/reference/formats.md`)."""

from collections.abc import Mapping, Sequence

import pyarrow as pa

FLOAT, INTEGER, STRING = pa.float64(), pa.int64(), pa.string()
COVARIANCE = pa.list_(pa.field("item", FLOAT, nullable=False), 36)


def _schema(columns: Mapping[str, pa.DataType], nullable: Sequence[str] = ()) -> pa.Schema:
    return pa.schema([pa.field(name, kind, nullable=name in nullable) for name, kind in columns.items()])


def kinds_of(schema: pa.Schema, *names: str) -> dict[str, pa.DataType]:
    """Return the types of columns of a schema by their names; without names, of all."""
    return {name: schema.field(name).type for name in names or schema.names}


KEY = {"time_s": FLOAT, "camera": STRING, "frame": INTEGER}
POSITION = {"x": FLOAT, "y": FLOAT, "z": FLOAT}
VELOCITY = {"vx": FLOAT, "vy": FLOAT, "vz": FLOAT}

#: One row a detection; a frame without detections is one row with null u_px, v_px.
DETECTIONS = _schema({**KEY, "u_px": FLOAT, "v_px": FLOAT}, nullable=("u_px", "v_px"))
#: One row a true object and time.
TRUTH = _schema({"time_s": FLOAT, "object_id": INTEGER, **POSITION, **VELOCITY})
#: One row a reported object and event; the covariance is 6x6, row-major, in the world frame; status is one of the two.
TRACKS = _schema(
    {**KEY, "track_id": INTEGER, **POSITION, **VELOCITY, "covariance": COVARIANCE, "existence": FLOAT, "status": STRING}
)
#: Status of an estimate; tables without the column hold confirmed ones only.
CONFIRMED, TENTATIVE = "confirmed", "tentative"
#: Optional columns of tracks: standard deviations of the position along the axes of the world.
STD = tuple(pa.field(name, FLOAT, nullable=False) for name in ("std_x", "std_y", "std_z"))
#: Optional column of tracks: the part of the covariance that comes from the cameras, where these are uncertain.
CAMERAS_PART = pa.field("covariance_cameras", COVARIANCE, nullable=False)
#: Optional columns of tracks of bodies: extent along and across the vertical, and their standard deviations.
EXTENTS = tuple(pa.field(name, FLOAT, nullable=False) for name in ("height", "width", "height_std", "width_std"))
#: One row a detection and reported track that it may belong to.
ASSOCIATIONS = _schema({**KEY, "u_px": FLOAT, "v_px": FLOAT, "track_id": INTEGER, "probability": FLOAT})
#: One row an event.
SCANS = _schema(
    {
        **KEY,
        "n_detections": INTEGER,
        "cardinality_mean": FLOAT,
        "cardinality_estimate": INTEGER,
        "log_likelihood": FLOAT,
        "n_components": INTEGER,
    }
)
CASE = {"experiment": STRING, "method": STRING, "case": STRING}
#: One row a value of a run of an experiment; time_s is null for what belongs to the whole run.
RUNS = _schema(
    {**CASE, "run": INTEGER, "seed": INTEGER, "time_s": FLOAT, "quantity": STRING, "unit": STRING, "value": FLOAT},
    nullable=("time_s",),
)
#: One row a method, case, time and quantity of an experiment; null: not defined, or no bound known.
SUMMARY = _schema(
    {
        **CASE,
        "time_s": FLOAT,
        "quantity": STRING,
        "unit": STRING,
        "runs": INTEGER,
        **dict.fromkeys(("mean", "std", "ci_low", "ci_high", "bound"), FLOAT),
    },
    nullable=("time_s", "mean", "std", "ci_low", "ci_high", "bound"),
)


def posterior_schema(names: Sequence[str]) -> pa.Schema:
    """Schema of a posterior: one row a particle, one column a parameter (`names`), and its weight."""
    return _schema({"weight": FLOAT, **dict.fromkeys(names, FLOAT)})


def history_schema(names: Sequence[str]) -> pa.Schema:
    """Schema of a history: one row a time, the means of the parameters and their covariance, row-major."""
    covariance = pa.list_(pa.field("item", FLOAT, nullable=False), len(names) ** 2)
    return _schema({"time_s": FLOAT, **dict.fromkeys(names, FLOAT), "covariance": covariance})
