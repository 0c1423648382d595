"""What makes a row of a detection log bad, decided for whole arrays of rows at a time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.settings import LARGEST_PX, LARGEST_SIGMA_PX, LARGEST_TIME_S, SMALLEST_SIGMA_PX
from stereophd.errors import InputError, unknown_camera
from stereophd.io.logs.order import LogOrder
from stereophd.io.logs.rows import Decoded, Rows
from stereophd.wording import instant

#: The kinds of bad rows, in the order in which a row is tested; keys of `LogReader.counts`.
KINDS = (
    "null_value",
    "non_finite",
    "time_out_of_range",
    "unknown_camera",
    "half_null",
    "outside_image",
    "invalid_sigma",
    "invalid_box",
    "time_backwards",
    "frame_out_of_order",
    "duplicate_row",
)

# What makes a kind of bad rows good ones.
REMEDIES = {
    "time_out_of_range": "write time_s in seconds",
    "unknown_camera": "add the camera to the cameras",
    "outside_image": "check image_size_px and the order of u and v",
    "time_backwards": "sort the rows by time_s",
}


def bad_rows(counts: Mapping[str, int]) -> tuple[int, str]:
    """Return the number of bad rows among the counts of a `LogReader`, and how many of each kind in words."""
    bad = {kind: counts[kind] for kind in KINDS if counts.get(kind)}
    return sum(bad.values()), ", ".join(f"{kind} {count}" for kind, count in bad.items())


@dataclass(frozen=True)
class Fault:
    """Bad rows of one kind: a mask over the rows, and the message about row i."""

    kind: str
    bad: Booleans
    say: Callable[[int], str]


def point_faults(piece: Decoded, cameras: Sequence[str], sizes: Array, margin: float) -> Iterator[Fault]:
    """Yield the faults that a row has by itself.

    `sizes` (cameras, 2) are width and height of each camera's image; a detection may be `margin` px outside of it.
    """
    rows = piece.rows
    u, v = rows.pixels[:, 0], rows.pixels[:, 1]
    yield Fault("null_value", piece.nulls, lambda i: "expected time_s, camera and frame, found null")
    yield Fault(
        "non_finite", ~np.isfinite(rows.time_s), lambda i: f"time_s: expected a finite number, found {rows.time_s[i]}"
    )
    yield Fault(
        "time_out_of_range",
        np.abs(rows.time_s) > LARGEST_TIME_S,
        lambda i: (
            f"time_s: expected a number between {-LARGEST_TIME_S:g} and {LARGEST_TIME_S:g}, found {rows.time_s[i]:g}"
        ),
    )
    yield Fault(
        "unknown_camera", rows.camera < 0, lambda i: f"camera: {unknown_camera(piece.names[i].as_py(), cameras)}"
    )
    yield Fault("half_null", piece.half, lambda i: "expected u_px and v_px both set or both null, found one null")
    yield Fault(
        "non_finite",
        ~rows.empty & ~(np.isfinite(u) & np.isfinite(v)),
        lambda i: f"u_px, v_px: expected finite numbers, found {u[i]}, {v[i]}",
    )
    # Pixel (0, 0) is a centre: the image reaches from -0.5 to width - 0.5.
    limit = sizes[rows.camera] - 0.5 + margin
    outside = (rows.pixels < -0.5 - margin) | (rows.pixels > limit)
    yield Fault(
        "outside_image",
        ~rows.empty & outside.any(axis=1),
        lambda i: (
            f"u_px, v_px: expected a detection inside the {sizes[rows.camera[i], 0]:.0f} x "
            f"{sizes[rows.camera[i], 1]:.0f} px image (to within {margin:g} px), found {u[i]:g}, {v[i]:g}"
        ),
    )
    if rows.sigma is not None:
        sigma = rows.sigma
        valid = ((sigma >= SMALLEST_SIGMA_PX) & (sigma <= LARGEST_SIGMA_PX)).all(axis=1)
        yield Fault(
            "invalid_sigma",
            ~rows.empty & ~valid,
            lambda i: (
                f"sigma_u_px, sigma_v_px: expected numbers from {SMALLEST_SIGMA_PX:g} to {LARGEST_SIGMA_PX:g}, found "
                f"{sigma[i, 0]}, {sigma[i, 1]}"
            ),
        )
    if rows.sizes is not None:
        boxes = rows.sizes
        # a detection without a box is a point
        valid = ((boxes > 0.0) & (boxes <= LARGEST_PX)).all(axis=1) | np.isnan(boxes).all(axis=1)
        yield Fault(
            "invalid_box",
            ~rows.empty & ~valid,
            lambda i: f"width_px, height_px: expected positive numbers, found {boxes[i, 0]}, {boxes[i, 1]}",
        )


def time_fault(rows: Rows, order: LogOrder) -> Fault:
    """Return the rows that the longest order of time leaves out."""
    place = np.searchsorted(order.misplaced, rows.row)
    bad = np.isin(rows.row, order.misplaced)

    def say(i: int) -> str:
        time, before, after = rows.time_s[i], order.before[place[i]], order.after[place[i]]
        where = f"after {instant(before, 9)}" if time < before else f"before {instant(after, 9)}"
        return (
            f"time_s: expected rows in order of time, found {instant(time, 9)} {where}; the longest order leaves out "
            f"{len(order.misplaced)} rows"
        )

    return Fault("time_backwards", bad, say)


def frame_fault(rows: Rows, last_frames: dict[int, int]) -> Fault:
    """Return the rows whose frame number is not above all of the same camera at earlier times.

    `rows` are in order of time, and hold all rows of each of their times. `last_frames`, the largest
    frame of each camera so far, is brought up to date.
    """
    bad = np.zeros(len(rows), dtype=bool)
    before = np.zeros(len(rows), dtype=np.int64)
    lowest = np.iinfo(np.int64).min
    for camera in np.unique(rows.camera):
        mine = np.flatnonzero(rows.camera == camera)
        time, frame = rows.time_s[mine], rows.frame[mine]
        starts = np.flatnonzero(np.concatenate([[True], time[1:] != time[:-1]]))
        highest = np.maximum.reduceat(frame, starts)
        earlier = np.maximum.accumulate(np.concatenate([[last_frames.get(int(camera), lowest)], highest]))
        group = np.repeat(np.arange(len(starts)), np.diff(np.concatenate([starts, [len(mine)]])))
        before[mine] = earlier[group]
        # Bad rows lie at or below the maximum, so they do not raise it either.
        bad[mine] = frame <= earlier[group]
        if (before[mine] == lowest).any():
            bad[mine[before[mine] == lowest]] = False
        last_frames[int(camera)] = int(earlier[-1])

    def say(i: int) -> str:
        if rows.frame[i] == before[i]:
            return f"frame: expected a frame of a camera at one time only, found frame {rows.frame[i]} at two"
        return (
            f"frame: expected frame numbers of a camera to increase with time, found {rows.frame[i]} after {before[i]}"
        )

    return Fault("frame_out_of_order", bad, say)


def frame_starts(rows: Rows) -> Integers:
    """Return where a new (time, camera, frame) begins in sorted rows."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (
        (rows.time_s[1:] != rows.time_s[:-1])
        | (rows.camera[1:] != rows.camera[:-1])
        | (rows.frame[1:] != rows.frame[:-1])
    )
    return np.flatnonzero(new)


def repeated_rows(frames: Array | Integers, pixels: Array, number: Integers) -> Booleans:
    """Return which rows (n,) repeat one of their frame with a lower number, or are empty (NaN) beside another.

    Those that repeat have exactly its pixels (n, 2).
    """
    # one sort puts equal pixels of a frame side by side, NaN last, lower numbers first
    order = np.lexsort((number, pixels[:, 1], pixels[:, 0], frames))
    before, after = order[:-1], order[1:]
    alike = np.isnan(pixels[after]).all(axis=1) | (pixels[after] == pixels[before]).all(axis=1)
    repeated = np.zeros(len(order), dtype=bool)
    repeated[after] = alike & (frames[after] == frames[before])
    return repeated


def duplicate_fault(rows: Rows) -> Fault:
    """Return the rows that repeat another of their frame, in rows sorted by frame.

    Such a row is a detection at exactly the pixels of an earlier row of the frame, or an empty row of a frame that has
    another row.
    """
    starts = frame_starts(rows)
    frames = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(rows)))
    bad = repeated_rows(frames, rows.pixels, rows.row)

    def say(i: int) -> str:
        if rows.empty[i]:
            return f"expected an empty frame to have one row, found others too (frame {rows.frame[i]})"
        return f"expected each detection once, found a duplicate row (frame {rows.frame[i]})"

    return Fault("duplicate_row", bad, say)


def raise_first(faults: list[Fault], rows: Rows, path: Any) -> None:
    """Raise `InputError` for the bad row that comes first in the file, if there is one."""
    first: tuple[int, str] | None = None
    for fault in faults:
        bad = np.flatnonzero(fault.bad)
        if len(bad):
            i = int(bad[np.argmin(rows.row[bad])])
            if first is None or rows.row[i] < first[0]:
                mend = f"{REMEDIES[fault.kind]}, or " if fault.kind in REMEDIES else ""
                first = (int(rows.row[i]), f"{fault.say(i)} ({mend}input.on_bad_row: drop skips and counts bad rows)")
    if first is not None:
        raise InputError(f"{path}: row {first[0]}: {first[1]}")
