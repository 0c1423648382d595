"""Summary of a detection log, in one pass and bounded memory."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.file_kinds import LOG
from stereophd.io.logs.rows import OPTIONAL, REQUIRED, Rows, decode
from stereophd.io.tables.reading import check_columns, open_parquet, read_pieces

# Intervals of a camera of which the median is taken.
INTERVALS_KEPT = 1_000_000
# Intervals longer than this many median ones are gaps.
GAP_INTERVALS = 1.5


@dataclass
class _CameraState:
    """Counts of one camera."""

    rows: int = 0
    frames: int = 0
    empty_frames: int = 0
    detections: int = 0
    most_detections: int = 0
    first_s: float = np.inf
    last_s: float = -np.inf
    first_frame: int = 0
    last_frame: int | None = None
    missing_frames: int = 0
    frames_backwards: int = 0
    current: int = 0
    lowest: Array = field(default_factory=lambda: np.full(2, np.inf))
    highest: Array = field(default_factory=lambda: np.full(2, -np.inf))
    intervals: list[Array] = field(default_factory=list)
    kept: int = 0

    def add(self, rows: Rows) -> None:
        """Count some rows of this camera."""
        seen = ~rows.empty
        self.rows += len(rows)
        self.empty_frames += int(rows.empty.sum())
        self.detections += int(seen.sum())
        pixels = rows.pixels[seen & np.isfinite(rows.pixels).all(axis=1)]
        if len(pixels):
            self.lowest = np.minimum(self.lowest, pixels.min(axis=0))
            self.highest = np.maximum(self.highest, pixels.max(axis=0))
        previous = rows.frame[0] - 1 if self.last_frame is None else self.last_frame
        steps = np.diff(rows.frame, prepend=previous)
        starts = np.flatnonzero(steps != 0)
        if self.last_frame is None:
            self.first_frame = int(rows.frame[0])
        self.frames += len(starts)
        self.missing_frames += int(np.maximum(steps[starts] - 1, 0).sum())
        self.frames_backwards += int((steps[starts] < 0).sum())
        self._count_detections(seen, starts)
        times = rows.time_s[starts]
        if self.kept < INTERVALS_KEPT:
            before = times if self.last_frame is None else np.append(self.last_s, times)
            self.intervals.append(np.diff(before))
            self.kept += len(self.intervals[-1])
        self.first_s = min(self.first_s, float(rows.time_s.min()))
        self.last_s = max(self.last_s, float(rows.time_s.max()))
        self.last_frame = int(rows.frame[-1])

    def _count_detections(self, seen: Any, starts: Any) -> None:
        """Keep the largest number of detections of a frame; the first rows may belong to the frame before."""
        bounds = np.concatenate([[0], starts, [len(seen)]]).astype(int)
        sums = np.add.reduceat(np.append(seen, False), bounds[:-1]) * (np.diff(bounds) > 0)
        sums[0] += self.current
        self.most_detections = max(self.most_detections, int(sums.max()))
        self.current = int(sums[-1])

    def summary(self) -> dict[str, Any]:
        """Return the counts."""
        intervals = np.concatenate(self.intervals) if self.intervals else np.empty(0)
        intervals = intervals[intervals > 0]
        median = float(np.median(intervals)) if len(intervals) else None
        has_pixels = bool(np.isfinite(self.lowest).all())
        return {
            "frames": self.frames,
            "empty_frames": self.empty_frames,
            "detections": self.detections,
            "detections_per_frame": self.detections / self.frames if self.frames else None,
            "most_detections_in_a_frame": self.most_detections,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "rate_hz": None if median is None else 1.0 / median,
            "mean_rate_hz": (self.frames - 1) / (self.last_s - self.first_s) if self.last_s > self.first_s else None,
            "gaps": 0 if median is None else int((intervals > GAP_INTERVALS * median).sum()),
            "longest_interval_s": float(intervals.max()) if len(intervals) else None,
            "first_frame": self.first_frame,
            "last_frame": self.last_frame,
            "missing_frame_numbers": self.missing_frames,
            "frames_backwards": self.frames_backwards,
            "lowest_px": self.lowest.tolist() if has_pixels else None,
            "highest_px": self.highest.tolist() if has_pixels else None,
        }


def summarise_log(path: Path) -> dict[str, Any]:
    """Return what a log holds: rows, columns, period, overlap of the cameras, and a row of counts for each camera.

    Raises InputError when it is not a log, or damaged.
    """
    with open_parquet(path, LOG) as parquet:
        schema = parquet.schema_arrow
        present = check_columns(schema, REQUIRED, OPTIONAL, path)
        rows_of_file = parquet.metadata.num_rows
    if not rows_of_file:
        raise InputError(f"{path}: expected a detection log, found one without rows")
    names: dict[str, int] = {}
    states: list[_CameraState] = []
    latest, backwards = -np.inf, 0
    start = 0
    for batch in read_pieces(path, [*REQUIRED, *present], LOG):
        for name in batch.column("camera").unique().to_pylist():
            if name is not None and name not in names:
                names[name] = len(names)
                states.append(_CameraState())
        rows = decode(batch, start, names, path).rows
        start += len(batch)
        rows = rows.take((rows.camera >= 0) & np.isfinite(rows.time_s))
        backwards += int((np.diff(rows.time_s, prepend=latest) < 0).sum())
        latest = float(rows.time_s[-1]) if len(rows) else latest
        for k in np.unique(rows.camera).tolist():
            states[k].add(rows.take(rows.camera == k))
    if not any(state.rows for state in states):
        raise InputError(f"{path}: expected rows with a camera and a finite time, found none in {rows_of_file} rows")
    cameras = {name: states[k].summary() for name, k in sorted(names.items())}
    first = [camera["first_s"] for camera in cameras.values()]
    last = [camera["last_s"] for camera in cameras.values()]
    return {
        "rows": rows_of_file,
        "columns": list(schema.names),
        "first_s": min(first),
        "last_s": max(last),
        "overlap_s": max(min(last) - max(first), 0.0),
        "times_backwards": backwards,
        "cameras": cameras,
    }
