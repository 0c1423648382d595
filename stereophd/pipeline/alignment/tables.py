"""The tables of a run in the frame and on the clock of a world."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.linalg import block_diag

from stereophd.core.metrics.truth.registration import Registration
from stereophd.io.tables.reading import damaged_is_input_error, open_parquet
from stereophd.io.tables.schemas import EXTENTS, STD
from stereophd.io.tables.writing import TableWriter


def write_moved(path: Path, target: Path, found: Registration, metadata: Mapping[bytes, bytes]) -> None:
    """Write a table of a run (tracks, scans, associations) with its times, and the states it holds, in the world."""
    turn = found.scale * found.rotation
    jacobian = block_diag(turn, turn / found.rate)
    with open_parquet(path) as parquet, damaged_is_input_error(path):
        schema = parquet.schema_arrow.remove_metadata()
        with TableWriter(target, schema, metadata) as writer:
            for batch in parquet.iter_batches():
                columns = {name: _values(batch.column(name)) for name in schema.names}
                columns["time_s"] = found.times(columns["time_s"])
                for names, move in ((("x", "y", "z"), found.positions), (("vx", "vy", "vz"), found.velocities)):
                    if set(names) <= columns.keys():
                        moved = move(np.column_stack([columns[name] for name in names]))
                        columns.update(zip(names, moved.T, strict=True))
                for name in [name for name in ("covariance", "covariance_cameras") if name in columns]:
                    columns[name] = jacobian @ columns[name].reshape(-1, 6, 6) @ jacobian.T
                if STD[0].name in columns:
                    variances = np.diagonal(columns["covariance"][:, :3, :3], axis1=1, axis2=2)
                    columns.update(zip((field.name for field in STD), np.sqrt(variances).T, strict=True))
                for field in EXTENTS:
                    if field.name in columns:
                        columns[field.name] = found.scale * columns[field.name]
                if batch.num_rows:
                    writer.append(columns)


def _values(column: pa.Array) -> Any:
    """Return the values of a column as `TableWriter` takes them."""
    if pa.types.is_fixed_size_list(column.type):
        return np.asarray(column.flatten(), dtype=np.float64).reshape(len(column), -1)
    if pa.types.is_string(column.type) or column.null_count:
        return column.to_pylist()
    return np.asarray(column)
