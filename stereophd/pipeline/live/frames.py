"""Frames of messages, checked as the rows of a log are."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pyarrow as pa

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.camera import Camera
from stereophd.core.settings import LARGEST_TIME_S
from stereophd.errors import InputError
from stereophd.io.logs.checks import KINDS, duplicate_fault, point_faults, raise_first
from stereophd.io.logs.reading import Frame
from stereophd.io.logs.rows import Decoded, Rows
from stereophd.io.streams.messages import Message
from stereophd.pipeline.checks.check_log import report_findings
from stereophd.pipeline.checks.finding import is_mistake
from stereophd.pipeline.checks.log.log_checks import check_times
from stereophd.pipeline.checks.log.sample import sample_log

# Kinds of frames that a running recording cannot use, beside the kinds of bad rows.
FRAME_KINDS = ("too_late", "repeated_frame")
# Last frames of a camera among which one may come again, and its first ones, which show the unit of the times.
MOST_RECENT, FIRST_FRAMES = 1000, 10


class FrameChecks:
    """Turn messages into frames, by the rules of `stereophd.io.logs.reading.LogReader`.

    The cameras are in the configuration's order. If `on_bad_row` is ``error``, the first bad detection raises; if
    ``drop``, bad ones are dropped and counted. `image_margin_px` is how far outside the image a detection may be.
    """

    def __init__(self, cameras: Sequence[Camera], on_bad_row: Literal["error", "drop"], image_margin_px: float) -> None:
        self._cameras = tuple(cameras)
        self._index = {camera.name: i for i, camera in enumerate(cameras)}
        self._sizes = np.array([(c.width, c.height) for c in cameras], dtype=float)
        self._limits = self._sizes - 0.5 + image_margin_px
        self._drop, self._margin = on_bad_row == "drop", image_margin_px
        self._first: list[list[Frame]] = [[] for _ in cameras]
        self._recent: list[dict[int, None]] = [{} for _ in cameras]
        self.counts = dict.fromkeys(("frames", "empty_frames", "detections", *KINDS, *FRAME_KINDS), 0)

    def frame(self, message: Message, where: str) -> Frame | None:
        """Return the frame of a message on true time, or None if nothing of it can be used.

        Raises InputError if something is bad, and ``on_bad_row`` is ``error``.
        """
        camera = self._index.get(message.camera, -1)
        sigma = _pairs(message, "sigma_u_px", "sigma_v_px")
        sizes = _pairs(message, "width_px", "height_px")
        pixels = message.pixels
        # a short answer for nearly all frames of points, by the rules of `_good`
        is_inside = ((pixels >= -0.5 - self._margin) & (pixels <= self._limits[camera])).all()
        is_faultless = is_inside and camera >= 0 and abs(message.time_s) <= LARGEST_TIME_S
        is_faultless = is_faultless and len(set(map(tuple, pixels.tolist()))) == len(pixels)
        if not is_faultless or sigma is not None or sizes is not None:
            good = self._good(message, camera, sigma, sizes, where)
            if not good.any():
                return None
            good = good[: len(pixels)]  # a frame without detections has one row
            pixels, sigma, sizes = pixels[good], _rows(sigma, good), _rows(sizes, good)
        recent = self._recent[camera]
        if message.frame in recent:
            self.refuse("repeated_frame", f"{where}: frame: expected each frame once, found {message.frame} again")
            return None
        recent[message.frame] = None
        if len(recent) > MOST_RECENT:
            del recent[next(iter(recent))]
        self.counts["frames"] += 1
        self.counts["empty_frames"] += not len(pixels)
        self.counts["detections"] += len(pixels)
        time_s = self._cameras[camera].clock.to_true(message.time_s)
        frame = Frame(time_s, camera, message.frame, pixels, sigma, sizes=sizes)
        if len(self._first[camera]) < FIRST_FRAMES:
            self._look_at_times(frame)
        return frame

    def _look_at_times(self, frame: Frame) -> None:
        """Keep one of the first frames of a camera; warn once they are all there, if their times are not in seconds."""
        first = self._first[frame.camera]
        first.append(frame)
        if len(first) == FIRST_FRAMES:
            sample = sample_log(sorted(first, key=lambda one: one.time_s), self._cameras)[frame.camera]
            report_findings(tuple(found for found in check_times(sample) if is_mistake(found)))

    def _good(self, message: Message, camera: int, sigma: Array | None, sizes: Array | None, where: str) -> Booleans:
        """Return which detections of a frame, or whether one without any, can be used; count the others, or raise."""
        count = max(len(message.pixels), 1)
        empty = not len(message.pixels)
        rows = Rows(
            np.arange(count),
            np.full(count, message.time_s),
            np.full(count, camera),
            np.full(count, message.frame),
            np.full((1, 2), np.nan) if empty else message.pixels,
            np.full(count, empty),
            sigma,
            None,
            sizes,
        )
        nothing = np.zeros(count, dtype=bool)
        piece = Decoded(rows, nothing, nothing, pa.repeat(message.camera, count))
        good = np.ones(count, dtype=bool)
        faults = list(point_faults(piece, list(self._index), self._sizes, self._margin))
        for fault in (*faults, duplicate_fault(rows)):
            if not fault.bad.any():
                continue
            if not self._drop:
                raise_first([fault], rows, where)
            self.counts[fault.kind] += int((fault.bad & good).sum())
            good &= ~fault.bad
        return good

    def refuse(self, kind: str, reason: str) -> None:
        """Count a frame that cannot be used, or raise."""
        if not self._drop:
            raise InputError(reason)
        self.counts[kind] += 1


def _rows(values: Array | None, kept: Booleans) -> Array | None:
    return None if values is None else values[kept]


def _pairs(message: Message, first: str, second: str) -> Array | None:
    """Return two columns of a message as (m, 2), or None where it has no detection or not both."""
    columns = message.columns
    if not (columns and len(message.pixels) and {first, second} <= columns.keys()):
        return None
    return np.stack([columns[first], columns[second]], axis=1)
