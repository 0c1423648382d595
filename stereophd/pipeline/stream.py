"""From frames to events: a detection log, or frames in memory, as events in order of true time.

A *frame* is what one camera reports at one time, in distorted pixels, as a log holds it. An *event* is the same frame
as estimators take it: undistorted, with its noise, on the true time. A *scan* is what `evaluate` scores once.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from stereophd.config.model import Config
from stereophd.config.report import InputConfig
from stereophd.core.disparity.events import Event, make_event
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.times import SAME_TIME_S
from stereophd.errors import InputError
from stereophd.io.logs.checks import bad_rows
from stereophd.io.logs.reading import Frame, LogReader
from stereophd.pipeline.runs.progress import Progress, ignore
from stereophd.wording import instant

# Events between two calls of `progress`.
PROGRESS_EVERY = 50
# Share of the rows that may be dropped as bad, those of cameras that are left out apart.
MOST_DROPPED = 0.05


@dataclass(eq=False)
class EventStream:
    """Iterate over the events of a log, or of frames in memory; every iteration starts anew.

    The cameras are in the order that the frames number them; the frames are in order of true time, ties in the order of
    the cameras. `progress` is called with the rows of the log that were read and their total. Events before `from_s`
    are passed over, and the first one from `until_s` on is the last; `counted` is the span of time whose detections
    beyond the lens model are counted.
    """

    cameras: tuple[Camera, ...]
    frames: LogReader | Sequence[Frame]
    progress: Progress = ignore
    from_s: float = -math.inf
    until_s: float = math.inf
    counted: tuple[float, float] = (-math.inf, math.inf)
    not_invertible: int = field(default=0, init=False)

    def with_cameras(self, cameras: Sequence[Camera]) -> Self:
        """Return a stream of the same frames for cameras with other detectors."""
        return replace(self, cameras=tuple(cameras))

    @property
    def counts(self) -> dict[str, int]:
        """Counts of the running or last iteration, for a report: those of the log, and ``not_invertible``.

        The latter is the number of detections that were left out because the lens model cannot be inverted there.
        """
        log = self.frames.counts if isinstance(self.frames, LogReader) else {}
        return {**log, "not_invertible": self.not_invertible}

    @property
    def source(self) -> str:
        """Name of the log in messages."""
        return str(self.frames.path) if isinstance(self.frames, LogReader) else "frames"

    @property
    def has_noise(self) -> bool:
        """Whether the log states the noise of its detections."""
        return isinstance(self.frames, LogReader) and self.frames.has_noise

    def __iter__(self) -> Iterator[Event]:
        self.not_invertible, count = 0, 0
        for number, frame in enumerate(covered(self.cameras, self.frames, self.source)):
            if frame.time_s < self.from_s:
                count += len(frame.pixels)
                continue
            camera = self.cameras[frame.camera].at(frame.time_s)
            # frames in memory state no rows of a log: detections are numbered as they come
            rows = np.arange(count, count + len(frame.pixels)) if frame.rows is None else frame.rows
            count += len(frame.pixels)
            event = make_event(
                camera, frame.camera, frame.time_s, frame.pixels, frame.sigma, frame.frame, frame.sizes, rows
            )
            if self.counted[0] <= event.time_s < self.counted[1]:
                self.not_invertible += event.not_invertible
            yield event
            if number % PROGRESS_EVERY == 0:
                self._report()
            if frame.time_s >= self.until_s:
                break
        else:
            self._check_dropped()
        self._report(done=True)

    def _check_dropped(self) -> None:
        counts = self.counts
        dropped, each = bad_rows({**counts, "unknown_camera": 0})
        if dropped > MOST_DROPPED * counts.get("rows", 0):
            raise InputError(
                f"{self.source}: expected at most {100 * MOST_DROPPED:g} % of the rows to be bad, found "
                f"{dropped} of {counts['rows']} ({each}): what is left is no longer this recording; "
                "correct the rows, or leave them out of the file"
            )

    def _report(self, done: bool = False) -> None:
        if isinstance(self.frames, LogReader):
            total = self.frames.num_rows
            self.progress(total if done else self.frames.counts["rows"], total)


def covered(cameras: Sequence[Camera], frames: Iterable[Frame], source: str) -> Iterator[Frame]:
    """Pass frames on while the trajectories of their cameras cover their times.

    `source` is the name of the log, for messages. Raises InputError if a frame, or a row of it, lies before the first
    or after the last pose of its camera.
    """
    spans = [camera.pose.span for camera in cameras]
    for frame in frames:
        first, last = spans[frame.camera]
        early, late = cameras[frame.camera].readout_span
        if not (first - SAME_TIME_S <= frame.time_s + early and frame.time_s + late <= last + SAME_TIME_S):
            raise InputError(
                f"{source}: camera {cameras[frame.camera].name}, frame {frame.frame}: expected a true time that the "
                f"trajectory of the camera covers ({instant(first, 10)} to {instant(last, 10)} s), found "
                f"{instant(frame.time_s, 10)} s"
                + ("" if early == late else f" and rows from {early:g} to {late:g} s after it")
            )
        yield frame


def open_stream(
    config: Config, cameras: Sequence[Camera], path: Path | str, progress: Progress = ignore
) -> EventStream:
    """Open a detection log with the settings of a configuration (section ``input``).

    `progress` is that of `EventStream`. Raises InputError if the log cannot be read (see
    `stereophd.io.logs.reading.LogReader`).
    """
    return EventStream(tuple(cameras), open_log(config.input, cameras, path), progress)


def open_log(
    settings: InputConfig, cameras: Sequence[Camera], path: Path | str, from_s: float = -math.inf
) -> LogReader:
    """Open a detection log as the section ``input`` of a configuration states."""
    return LogReader(path, cameras, settings.on_bad_row, settings.image_margin_px, from_s, settings.leave_out)
