"""Summary of a detection log, in one pass; memory holds a few numbers for each frame."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.errors import InputError
from stereophd.io.file_kinds import LOG
from stereophd.io.logs.rows import OPTIONAL, REQUIRED, Rows, decode
from stereophd.io.tables.reading import check_columns, open_parquet, read_pieces

# Intervals longer than this many median ones are gaps.
GAP_INTERVALS = 1.5


@dataclass
class _CameraRows:
    """What successive rows of one camera hold: a number for each frame, as far as they reach, and their extent."""

    frames: list[Integers] = field(default_factory=list)
    times: list[Array] = field(default_factory=list)
    detections: list[Integers] = field(default_factory=list)
    empty: int = 0
    # Least and greatest time, u and v.
    lowest: Array = field(default_factory=lambda: np.full(3, np.nan))
    highest: Array = field(default_factory=lambda: np.full(3, np.nan))

    def add(self, rows: Rows) -> None:
        """Take in some rows of this camera; a frame may go on in the next ones."""
        starts = np.flatnonzero(np.diff(rows.frame, prepend=rows.frame[0] - 1))
        self.frames.append(rows.frame[starts])
        self.times.append(rows.time_s[starts])
        self.detections.append(np.add.reduceat(~rows.empty, starts, dtype=np.int64))
        self.empty += int(rows.empty.sum())
        values = np.column_stack([rows.time_s, rows.pixels])
        values[~np.isfinite(values).all(axis=1), 1:] = np.nan
        self.lowest = np.fmin(self.lowest, np.fmin.reduce(values))
        self.highest = np.fmax(self.highest, np.fmax.reduce(values))

    def summary(self) -> dict[str, Any]:
        """Return the counts."""
        frames, times, detections = (np.concatenate(each) for each in (self.frames, self.times, self.detections))
        starts = np.flatnonzero(np.diff(frames, prepend=frames[0] - 1))
        counts, steps, intervals = np.add.reduceat(detections, starts), np.diff(frames[starts]), np.diff(times[starts])
        intervals = intervals[intervals > 0]
        median = float(np.median(intervals)) if len(intervals) else None
        first_s, last_s = float(self.lowest[0]), float(self.highest[0])
        has_pixels = not np.isnan(self.lowest[1])
        return {
            "frames": len(starts),
            "empty_frames": self.empty,
            "detections": int(counts.sum()),
            "detections_per_frame": float(counts.mean()),
            "most_detections_in_a_frame": int(counts.max()),
            "first_s": first_s,
            "last_s": last_s,
            "rate_hz": None if median is None else 1.0 / median,
            "mean_rate_hz": (len(starts) - 1) / (last_s - first_s) if last_s > first_s else None,
            "gaps": 0 if median is None else int((intervals > GAP_INTERVALS * median).sum()),
            "longest_interval_s": float(intervals.max()) if len(intervals) else None,
            "first_frame": int(frames[0]),
            "last_frame": int(frames[-1]),
            "missing_frame_numbers": int(np.maximum(steps - 1, 0).sum()),
            "frames_backwards": int((steps < 0).sum()),
            "lowest_px": self.lowest[1:].tolist() if has_pixels else None,
            "highest_px": self.highest[1:].tolist() if has_pixels else None,
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
    states: list[_CameraRows] = []
    latest, backwards = -np.inf, 0
    start = 0
    for batch in read_pieces(path, [*REQUIRED, *present], LOG):
        for name in batch.column("camera").unique().to_pylist():
            if name is not None and name not in names:
                names[name] = len(names)
                states.append(_CameraRows())
        rows = decode(batch, start, names, path).rows
        start += len(batch)
        rows = rows.take((rows.camera >= 0) & np.isfinite(rows.time_s))
        backwards += int((np.diff(rows.time_s, prepend=latest) < 0).sum())
        latest = float(rows.time_s[-1]) if len(rows) else latest
        for k in np.unique(rows.camera).tolist():
            states[k].add(rows.take(rows.camera == k))
    if not any(state.frames for state in states):
        raise InputError(f"{path}: expected rows with a camera and a finite time, found none in {rows_of_file} rows")
    cameras = {name: states[k].summary() for name, k in sorted(names.items()) if states[k].frames}
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
