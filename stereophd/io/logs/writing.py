"""Detection logs, written frame by frame."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import pyarrow as pa

from stereophd.core.arrays import Array, Integers
from stereophd.io.tables.schemas import BOX, DETECTIONS, OBJECT_ID
from stereophd.io.tables.writing import TableWriter


class LogWriter:
    """Write a detection log frame by frame, in the order of its times.

    The file is usually a temporary one of `stereophd.io.outputs.atomic.OutputFolder`; the metadata are those of
    `stereophd.io.outputs.provenance.to_metadata`. The log may have the columns ``object_id`` and ``width_px,
    height_px`` (`boxes`).
    """

    def __init__(
        self,
        path: Path | str,
        metadata: Mapping[Any, Any] | None = None,
        object_id: bool = False,
        boxes: bool = False,
    ) -> None:
        self._object_id, self._boxes = object_id, boxes
        more = (*(BOX if boxes else ()), *((OBJECT_ID,) if object_id else ()))
        self._table = TableWriter(path, functools.reduce(pa.Schema.append, more, DETECTIONS), metadata)

    def write(
        self,
        time_s: float,
        camera: str,
        frame: int,
        pixels: Array,
        object_id: Integers | None = None,
        sizes: Array | None = None,
    ) -> None:
        """Write one frame, at the time of the camera's own clock, s.

        Detections (m, 2) are in distorted px; with m = 0 the frame becomes one row of nulls. True objects (m,), -1
        clutter, are required with ``object_id=True``; width and height (m, 2) of the boxes, px, with ``boxes=True``.
        """
        columns: dict[str, Any] = {"time_s": time_s, "camera": camera, "frame": frame}
        if len(pixels):
            columns |= {"u_px": pixels[:, 0], "v_px": pixels[:, 1]}
        else:
            columns |= {"u_px": [None], "v_px": [None]}
        if self._boxes:
            if sizes is None:
                raise ValueError("this log has the columns width_px and height_px: expected a size for each detection")
            for number, field in enumerate(BOX):
                columns[field.name] = sizes[:, number] if len(pixels) else [None]
        if self._object_id:
            if object_id is None:
                raise ValueError("this log has the column object_id: expected an object_id for each detection")
            columns["object_id"] = object_id if len(pixels) else [None]
        self._table.append(columns)

    def close(self) -> None:
        """Write what is left and the footer."""
        self._table.close()

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._table.__exit__(kind, error, traceback)
