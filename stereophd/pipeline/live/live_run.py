"""A live run: messages in, records out, with the time that each took."""

import contextlib
import gc
import heapq
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stereophd.config.tracking import LiveConfig
from stereophd.core.disparity.events import make_event
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.build import prepare
from stereophd.core.multi.filter_settings import filters
from stereophd.core.numerics.random_streams import WARM_UP_SEED
from stereophd.core.two_views.turns import prepare_turns
from stereophd.errors import InputError
from stereophd.io.logs.reading import Frame
from stereophd.io.streams.messages import Message
from stereophd.io.streams.sources import Arrivals
from stereophd.pipeline.live.frames import FrameChecks
from stereophd.pipeline.live.lagged import LaggedRecords
from stereophd.pipeline.live.rewinding import RewindingRun
from stereophd.pipeline.tracking.loop import Estimator, Record, ReportTimes

# Frames of each camera, their interval, and detections of a frame, that make all ready before the first frame.
WARM_UP_FRAMES, WARM_UP_INTERVAL_S, WARM_UP_DETECTIONS = 20, 0.02, 4
# Width and height of their boxes, which filters of points do not read.
WARM_UP_BOX_PX = 50.0
# Classes of durations, from 10 us to 100 s: the least, the ratio of neighbours, and their number.
SHORTEST_S, CLASS_RATIO, CLASSES = 1e-5, 1.02, 814
PERCENTILES = (50.0, 90.0, 99.0, 99.9, 100.0)


class LiveRecord(NamedTuple):
    """A record as soon as it is known."""

    record: Record
    is_revised: bool  # Whether an earlier record of the same event was reported, before a late frame came
    arrived_s: float  # When the frame came that made it (`time.perf_counter`)


class Histogram:
    """Numbers of durations, in classes of `CLASS_RATIO`: memory does not grow with them."""

    def __init__(self) -> None:
        self._counts = [0] * CLASSES

    def add(self, duration_s: float) -> None:
        """Count a duration."""
        place = int(math.log(max(duration_s / SHORTEST_S, 1.0)) / math.log(CLASS_RATIO))
        self._counts[min(place, CLASSES - 1)] += 1

    def percentiles_ms(self) -> dict[str, float]:
        """Return `PERCENTILES` of the durations by name, ms, rounded up to a class; NaN without durations."""
        total = sum(self._counts)
        places = np.searchsorted(np.cumsum(self._counts), np.ceil(total * np.asarray(PERCENTILES) / 100.0))
        values = [1e3 * SHORTEST_S * CLASS_RATIO ** (k + 1) if total else math.nan for k in places.tolist()]
        return {f"p{p:g}": value for p, value in zip(PERCENTILES, values, strict=True)}


@dataclass
class LiveCounts:
    """What happened to the frames of a run so far."""

    late: int = 0  # Frames that took the filter back
    revised: int = 0  # Events that were worked again
    latency: Histogram = field(default_factory=Histogram)  # From the arrival of a frame to its row
    processor: Histogram = field(default_factory=Histogram)  # Processor time from one row to the next

    def add_row(self, arrived_s: float, processor_s: float) -> None:
        """Count a frame whose row is written now."""
        self.latency.add(time.perf_counter() - arrived_s)
        self.processor.add(processor_s)


class LiveRun:
    """Track messages as they arrive, and call `keep` with each that is used; estimates are reported at `times`.

    With `lagged`, records are not to be shown as they come: `late_records` gives smoothed ones.
    """

    def __init__(
        self,
        estimator: Estimator[Any],
        times: ReportTimes,
        checks: FrameChecks,
        settings: LiveConfig,
        keep: Callable[[Message], object],
        lagged: LaggedRecords | None = None,
    ) -> None:
        self.counts = LiveCounts()
        self._cameras: Sequence[Camera] = estimator.rig.cameras
        self._checks, self._settings, self._keep = checks, settings, keep
        self._lagged = lagged
        span_s = settings.span_s if lagged is None else max(settings.span_s, lagged.span_s)
        self._run = RewindingRun(estimator, times, span_s, lagged is not None)
        self._waiting: list[tuple[float, int, int, Frame, float]] = []
        self._newest = [-math.inf] * len(self._cameras)  # Of each camera; an array takes longer
        self._newest_arrived_s, self._on_grid = 0.0, times.grid_s is not None
        self._passed_over: set[int] = set()

    @property
    def residuals(self) -> dict[str, float]:
        """Residuals of each camera in the deviations that its noise and the tracks lead to expect, at least 1."""
        return {name: math.sqrt(looks.spread) for name, looks in self._run.knocks.cameras.items()}

    def pass_over(self, name: str) -> None:
        """Track no more frames of a camera, for the present."""
        self._passed_over |= {index for index, camera in enumerate(self._cameras) if camera.name == name}

    def go_on(self, estimator: Estimator[Any]) -> None:
        """Go on with an estimator whose cameras have other poses, and track all of them."""
        self._cameras = estimator.rig.cameras
        self._passed_over = set()
        self._run.go_on(estimator)

    def records(self, arrivals: Arrivals, source: str) -> Iterator[LiveRecord]:
        """Yield the records of messages, and at the end of the stream those that are left.

        Raises InputError if no message comes, or one cannot be used and the configuration does not drop such.
        """
        number = 0
        for message in arrivals:
            if message is not None:
                number += 1
                self._take(message, f"{source}: frame {message.frame} of camera {message.camera} (message {number})")
            # while messages come, only their own times count: a backlog is no wait
            yield from self._release(-np.inf if message is not None else time.perf_counter())
            if self._on_grid and message is None:
                yield from self._predict()
        if not number:
            raise InputError(
                f"{source}: expected frames, found none until its end: did the program that sends them fail?"
            )
        yield from self._release(np.inf)
        now = time.perf_counter()
        yield from (LiveRecord(record, False, now) for record in self._run.finish())

    def late_records(self, is_over: bool = False) -> Iterator[Record]:
        """Yield smoothed records that are due; at the end all that are left."""
        newest_s = math.inf if is_over else max(self._newest)
        if self._lagged is not None and self._lagged.is_due(newest_s):
            yield from self._lagged.take(self._run.records, newest_s)

    def _predict(self) -> Iterator[LiveRecord]:
        """Yield predictions to the times of a grid that have come: now is as long after the newest frame as it came."""
        newest_s, now = max(self._newest), time.perf_counter()
        if math.isfinite(newest_s):
            for record in self._run.forecasts(newest_s + min(now - self._newest_arrived_s, self._settings.span_s)):
                yield LiveRecord(record, False, now)

    def _take(self, message: Message, where: str) -> None:
        frame = self._checks.frame(message, where)
        if frame is not None:
            self._keep(message)
            if frame.time_s > max(self._newest):
                self._newest_arrived_s = message.arrived_s
            self._newest[frame.camera] = max(self._newest[frame.camera], frame.time_s)
            heapq.heappush(self._waiting, (frame.time_s, frame.camera, frame.frame, frame, message.arrived_s))

    def _release(self, now: float) -> Iterator[LiveRecord]:
        """Work the frames that need not wait: every camera has gone on, or they have waited long enough."""
        wait_s = self._settings.wait_s
        while self._waiting:
            time_s, _, _, frame, arrived_s = self._waiting[0]
            is_complete = time_s <= min(self._newest)
            has_waited = time_s <= max(self._newest) - wait_s or now - arrived_s >= wait_s
            if not (is_complete or has_waited):
                return
            heapq.heappop(self._waiting)
            yield from self._work(frame, arrived_s)

    def _work(self, frame: Frame, arrived_s: float) -> Iterator[LiveRecord]:
        if frame.camera in self._passed_over:
            return
        camera = self._cameras[frame.camera].at(frame.time_s)
        event = make_event(camera, frame.camera, frame.time_s, frame.pixels, frame.sigma, frame.frame, frame.sizes)
        if self._run.is_too_late(event):
            reason = (
                f"frame {frame.frame} of camera {camera.name}: expected a frame at most {self._settings.span_s:g} s"
            )
            self._checks.refuse("too_late", f"{reason} older than the newest (live.span_s), found an older one")
            return
        steps = self._run.work(event)
        self.counts.late += len(steps) > 1
        self.counts.revised += len(steps) - 1
        for place, step in enumerate(steps):
            for record in step.records:
                is_revised = place > 0 or (not record.is_event and record.time_s < self._run.forecast_s)
                yield LiveRecord(record, is_revised, arrived_s)


def warm_up_messages(cameras: Sequence[Camera]) -> Iterator[Message]:
    """Yield frames of detections that stand still at random places, in which a run uses all that it needs later."""
    rng = np.random.default_rng(WARM_UP_SEED)
    pixels = [rng.uniform(0.2, 0.8, (WARM_UP_DETECTIONS, 2)) * (c.width, c.height) for c in cameras]
    boxes = dict.fromkeys(("width_px", "height_px"), np.full(WARM_UP_DETECTIONS, WARM_UP_BOX_PX))
    for number in range(WARM_UP_FRAMES):
        time_s = WARM_UP_INTERVAL_S * number
        for camera, places in zip(cameras, pixels, strict=True):
            yield Message(camera.name, number, camera.clock.to_log(time_s), places, boxes)


@contextlib.contextmanager
def without_collections(kind: str) -> Iterator[None]:
    """Load the kernels of a kind of filter, and collect no garbage during the block.

    A run makes no objects that refer to each other in a circle, which alone need a collection: the others are freed at
    once. A collection looks at all states that are kept, which takes up to a quarter of a second with fifty objects.
    """
    if kind in filters():
        prepare(kind)
    prepare_turns()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
