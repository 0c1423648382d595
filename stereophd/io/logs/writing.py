"""Detection logs, written frame by frame."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from stereophd.core.arrays import Array
from stereophd.io.tables.schemas import DETECTIONS, FLOAT, INTEGER
from stereophd.io.tables.writing import TableWriter


def log_schema(optional: Iterable[str]) -> pa.Schema:
    """Return the columns of a log: those of every log, and optional ones by name, which are null without detection."""
    kinds = {name: INTEGER if name == "object_id" else FLOAT for name in optional}
    return pa.schema([*DETECTIONS, *(pa.field(name, kind, nullable=True) for name, kind in kinds.items())])


class LogWriter(TableWriter):
    """Write a detection log, with some `optional` columns, frame by frame, in the order of its times.

    The file is usually a temporary one of `stereophd.io.outputs.atomic.OutputFolder`; the metadata are those of
    `stereophd.io.outputs.provenance.to_metadata`.
    """

    def __init__(
        self, path: Path | str, metadata: Mapping[Any, Any] | None = None, optional: Sequence[str] = ()
    ) -> None:
        super().__init__(path, log_schema(optional), metadata)
        self._optional = tuple(optional)

    def write(
        self, time_s: float, camera: str, frame: int, pixels: Array, optional: Mapping[str, Any] | None = None
    ) -> None:
        """Write one frame, at the time of the camera's own clock, s.

        Detections (m, 2) are in distorted px; with m = 0 the frame becomes one row of nulls. An optional column without
        values (m,) is null.
        """
        columns: dict[str, Any] = {"time_s": time_s, "camera": camera, "frame": frame}
        columns |= {"u_px": pixels[:, 0], "v_px": pixels[:, 1]} if len(pixels) else {"u_px": [None], "v_px": [None]}
        for name in self._optional:
            values = (optional or {}).get(name) if len(pixels) else None
            columns[name] = [None] * max(len(pixels), 1) if values is None else values
        self.append(columns)
