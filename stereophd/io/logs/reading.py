"""Detection logs, read frame by frame in the order of true time (written by `io.logs.rows`).

A log is a Parquet file with one row per detection (`docs/reference/formats.md`). It is read in pieces, so
memory does not depend on its length; what is wrong with a row is an error or a counted, dropped row.
"""

import heapq
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.times import TIME_DECIMALS
from stereophd.errors import InputError, unknown_camera
from stereophd.io.documents import check_instant
from stereophd.io.file_kinds import LOG
from stereophd.io.logs import checks
from stereophd.io.logs.order import LogOrder, order_of
from stereophd.io.logs.rows import OPTIONAL, REQUIRED, Rows, decode
from stereophd.io.tables.reading import check_columns, damaged_is_input_error, open_parquet
from stereophd.io.tables.writing import ROW_GROUP_ROWS


@dataclass(frozen=True, slots=True)
class Frame:
    """All detections of one camera frame; what the log does not state is None.

    Attributes
    ----------
    time_s : true time, s (the camera's clock corrected)
    camera : index in the configuration's order of cameras
    frame : number of the frame
    pixels : (m, 2), distorted px; m = 0 for an empty frame
    sigma : (m, 2), standard deviations, px
    object_id : (m,), true objects, -1 clutter; for evaluation only
    sizes : (m, 2), width and height of the boxes, px
    rows : (m,), rows of the log that the frame is from
    """

    time_s: float
    camera: int
    frame: int
    pixels: Array
    sigma: Array | None = None
    object_id: Integers | None = None
    sizes: Array | None = None
    rows: Integers | None = None


class LogReader:
    """Iterate over the frames of a detection log in the order of true time, ties in camera order.

    All rows of one (time, camera, frame) are one `Frame`, wherever they lie among the rows of that time. Rows in blocks
    of one camera each are merged, if each block is in order of time. A frame whose rows are all bad is dropped: it
    carries no information about the scene.

    Of the cameras, in the configuration's order, names, image sizes and clocks are used. The first bad row raises
    (`on_bad_row` ``error``), or bad rows are dropped and counted (``drop``); a detection further than `image_margin_px`
    outside the image is one. The caller needs no frame before the true time `from_s`: row groups that end before it are
    not read (frames before it may still come). `leave_out` has, by camera, places (u, v and radius, px) whose
    detections are left out.

    `counts` of the last (or running) iteration has ``rows``, ``frames``, ``empty_frames``, ``detections``, one for each
    kind of bad row (`stereophd.io.logs.checks.KINDS`), and ``cameras_without_frames``. `num_rows` is the number of rows
    of the file; `has_boxes` says whether it has the columns ``width_px, height_px``.

    Raises InputError at construction: no such file, not Parquet, truncated, no rows, a column missing or of a wrong
    type; and while iterating: damaged data, a bad row under ``error``, no usable row at all.
    """

    def __init__(
        self,
        path: Path | str,
        cameras: Sequence[Camera],
        on_bad_row: Literal["error", "drop"] = "error",
        image_margin_px: float = 10.0,
        from_s: float = -math.inf,
        leave_out: Mapping[str, Sequence[tuple[float, float, float]]] | None = None,
    ) -> None:
        self.path = Path(path)
        self._from_s = from_s
        self._cameras = tuple(cameras)
        self._index = {camera.name: i for i, camera in enumerate(cameras)}
        self._drop = on_bad_row == "drop"
        self._margin = image_margin_px
        for name in leave_out or {}:
            if name not in self._index:
                raise InputError(f"input.leave_out: {unknown_camera(name, list(self._index))}")
        self._left_out = [np.array((leave_out or {}).get(c.name, ()), dtype=float).reshape(-1, 3) for c in cameras]
        self._sizes = np.array([(c.width, c.height) for c in cameras], dtype=float).reshape(-1, 2)
        self.counts: dict[str, int] = {}
        with open_parquet(self.path, LOG) as parquet:
            present = check_columns(parquet.schema_arrow, REQUIRED, OPTIONAL, self.path)
            self.num_rows: int = parquet.metadata.num_rows
            self.metadata: Mapping[bytes, bytes] = parquet.schema_arrow.metadata or {}
        if self.num_rows == 0:
            raise InputError(f"{self.path}: expected a detection log, found one without rows")
        for first, second in (("sigma_u_px", "sigma_v_px"), ("width_px", "height_px")):
            if (first in present) != (second in present):
                raise InputError(f"{self.path}: expected both of the columns {first} and {second}, found one")
        self.has_boxes = "width_px" in present
        self._columns = [*REQUIRED, *present]

    @property
    def has_noise(self) -> bool:
        """Whether the log states the noise of its detections."""
        return "sigma_u_px" in self._columns

    @cached_property
    def order(self) -> LogOrder:
        """How the rows lie in time. If only those of each camera are in order, they are merged on reading."""
        return order_of(self.path)

    def __iter__(self) -> Iterator[Frame]:
        self.counts = dict.fromkeys(("rows", "frames", "empty_frames", "detections", *checks.KINDS), 0)
        self.counts["cameras_without_frames"] = len(self._cameras)
        seen: set[int] = set()
        exact = all(c.clock.offset_s == 0 and c.clock.rate == 1 for c in self._cameras)
        if exact and not self.order.by_camera:
            frames = self._frames(None)
        else:
            # Each camera's clock is monotonic, so each camera's frames are in order by themselves: one
            # pass over the file for each camera keeps the memory bounded, however far the clocks differ.
            passes = [self._frames(i) for i in range(len(self._cameras))]
            frames = heapq.merge(*passes, key=lambda f: (f.time_s, f.camera, f.frame))
        counts = self.counts
        for frame in frames:
            counts["frames"] += 1
            counts["detections"] += len(frame.pixels)
            counts["empty_frames"] += not len(frame.pixels)
            if frame.camera not in seen:
                seen.add(frame.camera)
                counts["cameras_without_frames"] -= 1
            yield frame
        if not seen:
            _, why = checks.bad_rows(counts)
            raise InputError(f"{self.path}: expected usable rows, found that all {self.num_rows} rows are bad ({why})")

    def _frames(self, only: int | None) -> Iterator[Frame]:
        """Yield the frames in log order; with `only`, those of that camera, on its true time."""
        last_frames: dict[int, int] = {}
        carry: Rows | None = None
        for rows in self._good_rows(only):
            if only is not None:
                rows = rows.take(rows.camera == only)
            if carry is not None:
                rows = carry.join(rows)
            if not len(rows):
                carry = None
                continue
            # The last time may continue in the next piece: its rows wait until it is complete.
            complete = int(np.searchsorted(rows.time_s, rows.time_s[-1], side="left"))
            carry = rows.take(slice(complete, None))
            check_instant(len(carry), float(carry.time_s[0]), str(self.path))
            yield from self._split(rows.take(slice(0, complete)), last_frames)
        if carry is not None:
            yield from self._split(carry, last_frames)

    def _good_rows(self, only: int | None) -> Iterator[Rows]:
        """Yield pieces of the log without rows that are bad by themselves or out of order."""
        start: int | None = None
        for first_row, batch in self._batches():
            start = first_row if start is None else start
            with damaged_is_input_error(self.path):
                piece = decode(batch, start, self._index, self.path)
            rows = piece.rows
            start += len(rows)
            # In a pass for one camera only its own rows count; rows of no camera count in the first.
            counted = np.ones(len(rows), dtype=bool)
            if only is not None:
                counted = (rows.camera == only) | ((rows.camera < 0) & (only == 0))
            self.counts["rows"] += int(counted.sum())
            faults = list(checks.point_faults(piece, list(self._index), self._sizes, self._margin))
            good = rows.take(self._accept(faults, rows, counted))
            if only is not None and self.order.by_camera:
                # rows of other cameras in between do not matter for the order of these
                good = good.take(good.camera == only)
            late = checks.time_fault(good, self.order)
            good = good.take(self._accept([late], good, None if only is None else good.camera == only))
            yield good

    def _accept(self, faults: list[checks.Fault], rows: Rows, counted: Booleans | None = None) -> Booleans:
        """Return the mask of good rows; count the bad ones, each once, or raise for the first."""
        if not self._drop:
            checks.raise_first(faults, rows, self.path)
        good = np.ones(len(rows), dtype=bool)
        for fault in faults:
            new = fault.bad & good
            good &= ~fault.bad
            self.counts[fault.kind] += int((new if counted is None else new & counted).sum())
        return good

    def _batches(self) -> Iterator[tuple[int, pa.RecordBatch]]:
        """Yield pieces of the file, each with the number of the first row that is read at all."""
        with open_parquet(self.path, LOG, words=("camera",)) as parquet:
            groups, first_row = self._groups(parquet.metadata)
            pieces = parquet.iter_batches(ROW_GROUP_ROWS, groups, columns=self._columns, use_threads=False)
            while True:
                with damaged_is_input_error(self.path):
                    batch = next(pieces, None)
                if batch is None:
                    return
                yield first_row, batch

    def _groups(self, metadata: pq.FileMetaData) -> tuple[list[int], int]:
        """Return the row groups to read, all from the first one that reaches `from_s`, and their first row."""
        least = min((camera.clock.to_log(self._from_s) for camera in self._cameras), default=-math.inf)
        column = metadata.schema.names.index("time_s")
        first_row = 0
        for group in range(metadata.num_row_groups):
            rows = metadata.row_group(group)
            statistics = rows.column(column).statistics
            if statistics is None or not statistics.has_min_max or not statistics.max < least:
                return list(range(group, metadata.num_row_groups)), first_row
            first_row += rows.num_rows
        return [], first_row

    def _split(self, rows: Rows, last_frames: dict[int, int]) -> Iterator[Frame]:
        """Check the rows against those around them, and yield their frames in order."""
        if not len(rows):
            return
        rows = rows.take(self._accept([checks.frame_fault(rows, last_frames)], rows))
        rows = rows.take(np.lexsort((rows.row, rows.frame, rows.camera, rows.time_s)))
        rows = rows.take(self._accept([checks.duplicate_fault(rows)], rows))
        starts = checks.frame_starts(rows)
        ends = np.append(starts[1:], len(rows)).tolist()
        # Plain Python numbers: indexing arrays one element at a time is slow.
        frames = rows.frame[starts].tolist()
        cameras = rows.camera[starts].tolist()
        times = self._true_times(rows.time_s[starts], rows.camera[starts]).tolist()
        # A duplicate empty row is gone by now, so an empty frame is exactly one empty row.
        ends = (np.asarray(ends) - rows.empty[starts]).tolist()
        for time, camera, frame, i, j in zip(times, cameras, frames, starts.tolist(), ends, strict=True):
            kept: slice | Integers = slice(i, j)
            if len(places := self._left_out[camera]):
                apart = np.hypot(*(rows.pixels[i:j, None] - places[:, :2]).transpose(2, 0, 1))
                kept = i + np.flatnonzero((apart > places[:, 2]).all(axis=1))
            yield Frame(
                time,
                camera,
                frame,
                rows.pixels[kept],
                None if rows.sigma is None else rows.sigma[kept],
                None if rows.object_id is None else rows.object_id[kept],
                None if rows.sizes is None else rows.sizes[kept],
                rows.row[kept],
            )

    def _true_times(self, time_s: Array, camera: Integers) -> Array:
        offset = np.array([c.clock.offset_s for c in self._cameras])
        rate = np.array([c.clock.rate for c in self._cameras])
        true: Array = offset[camera] + rate[camera] * time_s
        # Cameras whose frames coincide come in their order: a clock must not part them by its rounding.
        kept = (offset == 0.0) & (rate == 1.0)
        return np.where(kept[camera], time_s, np.round(true, TIME_DECIMALS))
