"""Summaries of tracks, truth and any other table."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stereophd.core.geometry.trajectory import COLUMNS
from stereophd.errors import InputError
from stereophd.io.outputs.provenance import from_metadata, length_unit
from stereophd.io.tables.reading import open_parquet, read_metadata, read_table
from stereophd.io.tables.schemas import CONFIRMED, FLOAT, INTEGER, STRING

#: Kind of table -> columns by which it is recognised, the most particular first.
KINDS = (
    ("associations", ("track_id", "probability")),
    ("detections", ("time_s", "camera", "frame", "u_px", "v_px")),
    ("tracks", ("time_s", "track_id", "x", "y", "z")),
    ("trajectory", COLUMNS),
    ("truth", ("time_s", "object_id", "x", "y", "z")),
    ("scans", ("time_s", "n_detections", "cardinality_estimate")),
    ("scores", ("time_s", "ospa", "n_truth")),
    ("runs", ("experiment", "run", "quantity", "value")),
    ("summary", ("experiment", "quantity", "mean", "bound")),
)


def kind_of(path: Path) -> str:
    """Return what a table is, by its columns; one of none of `KINDS` is of kind ``table``."""
    with open_parquet(path) as parquet:
        names = set(parquet.schema_arrow.names)
    return next((kind for kind, columns in KINDS if names.issuperset(columns)), "table")


def summarise_table(path: Path) -> dict[str, Any]:
    """Return rows, columns with their types, and the period, of any table."""
    with open_parquet(path) as parquet:
        schema = parquet.schema_arrow
        rows = parquet.metadata.num_rows
    result: dict[str, Any] = {
        "rows": rows,
        "columns": {field.name: str(field.type) for field in schema},
        "length_unit": length_unit(schema.metadata),
    }
    if rows and "time_s" in schema.names:
        # null where a row belongs to a whole run, as in the tables of an experiment
        times = _column(read_table(path, {}, {"time_s": FLOAT}), "time_s")
        times = times[np.isfinite(times)]
        result |= {"first_s": float(times.min()), "last_s": float(times.max())} if len(times) else {}
    return result


def summarise_objects(path: Path, identity: str) -> dict[str, Any]:
    """Return a summary of tracks (``identity`` track_id) or truth (object_id), with a row for each object.

    Tentative estimates are counted, but not part of the summary. Raises InputError when the file is damaged, or has
    nulls where there must be values.
    """
    optional = {"existence": FLOAT, "status": STRING}
    required = {"time_s": FLOAT, identity: INTEGER, "x": FLOAT, "y": FLOAT, "z": FLOAT}
    table = read_table(path, required, optional)
    result = summarise_table(path)
    if "status" in table.schema.names:
        confirmed = pc.equal(table["status"], CONFIRMED)
        result["tentative_rows"] = table.num_rows - int(pc.sum(confirmed).as_py() or 0)
        table = table.filter(confirmed)
    if not table.num_rows:
        return {**result, "objects": 0, "rows_by_object": []}
    time, who = _column(table, "time_s"), _column(table, identity)
    position = np.stack([_column(table, axis) for axis in "xyz"], axis=1)
    ids, index, counts = np.unique(who, return_inverse=True, return_counts=True)
    first, last = np.full(len(ids), np.inf), np.full(len(ids), -np.inf)
    np.minimum.at(first, index, time)
    np.maximum.at(last, index, time)
    durations = last - first
    result |= {
        "objects": len(ids),
        "duration_s": {
            "shortest": float(durations.min()),
            "median": float(np.median(durations)),
            "longest": float(durations.max()),
        },
        "lowest": position.min(axis=0).tolist(),
        "highest": position.max(axis=0).tolist(),
        "rows_by_object": [
            {"id": int(ids[k]), "first_s": float(first[k]), "last_s": float(last[k]), "rows": int(counts[k])}
            for k in np.argsort(-durations, kind="stable")
        ],
    }
    if "existence" in table.schema.names:
        result["mean_existence"] = float(np.mean(_column(table, "existence")))
    return result


def _column(table: pa.Table, name: str) -> Any:
    return table.column(name).to_numpy()


def provenance_of(path: Path) -> dict[str, Any] | None:
    """Return the origin of a table according to its metadata."""
    try:
        return from_metadata(read_metadata(path))
    except InputError:
        return None
