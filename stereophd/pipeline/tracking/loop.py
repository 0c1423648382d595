"""The one loop over a detection log: events through a filter, and predictions to the times of a grid."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event, make_event
from stereophd.core.multi.base import DisparityFilter, FilterState
from stereophd.core.multi.estimates import Estimates, Info
from stereophd.io.logs import LogReader

# Called with (done, total), in rows of the log.
Progress = Callable[[int, int], None]

# Events between two calls of `progress`, and between two clearances of what is known of dead tracks.
PROGRESS_EVERY = 50

# Times of a grid are rounded to the nanosecond, as simulated ones are; an event nearer than half of that (or
# than the last bits of its own time) to a time of the grid is at that time.
TIME_DECIMALS = 9
SAME_TIME_S = 0.5e-9
SAME_TIME_ULPS = 4.0


@dataclass(frozen=True)
class ReportTimes:
    """When estimates are reported: after every event, or as the one that is set says.

    Attributes
    ----------
    camera : str, optional
        After every frame of this camera.
    grid_s : float, optional
        At the multiples of this interval, s, from the first event to the last.
    """

    camera: str | None = None
    grid_s: float | None = None

    def after(self, camera: str) -> bool:
        """Whether estimates are reported after an event of this camera."""
        return self.grid_s is None and self.camera in (None, camera)


@dataclass(frozen=True)
class Record:
    """One event of a run, or one prediction to a time of the grid.

    Attributes
    ----------
    time_s : float
        True time of the event, or of the grid.
    camera, frame : str, int
        The event; of a prediction, the last one before it.
    n_detections : int
        Of the event; none in a prediction.
    first_label : int
        Smallest label that an object first detected in this event can have.
    info : Info
        Of the event; of a prediction that of the last event, faded, with log-likelihood 0.
    estimates : Estimates
    attributed : mapping
        Track -> camera -> number of detections that are known to be its own since this event (at the first
        report of a track, those before it too).
    reported : bool
        Whether the estimates are to be written.
    is_event : bool
    event : Event, optional
        The detections themselves, where a run keeps them.
    """

    time_s: float
    camera: str
    frame: int
    n_detections: int
    first_label: int
    info: Info
    estimates: Estimates
    attributed: Mapping[int, Mapping[str, int]] = field(default_factory=dict)
    reported: bool = True
    is_event: bool = True
    event: Event | None = None


class Attribution:
    """Whose detections were whose: counts by label until the label is reported as a track."""

    def __init__(self) -> None:
        self._pending: dict[int, dict[str, int]] = {}

    def update(self, camera: str, detected: NDArray[np.int64], estimates: Estimates) -> dict[int, Counter[str]]:
        """Count the labels that an event of a camera detected; return what falls to the reported tracks."""
        for label in detected.tolist():
            counts = self._pending.setdefault(label, {})
            counts[camera] = counts.get(camera, 0) + 1
        found: dict[int, Counter[str]] = {}
        for track_id, label in zip(estimates.track_ids.tolist(), estimates.labels.tolist(), strict=True):
            if label in self._pending:
                found[track_id] = Counter(self._pending.pop(label))
        return found

    def keep(self, labels: NDArray[np.int64]) -> None:
        """Forget all labels but these: memory does not grow with the log."""
        alive = set(labels.tolist())
        self._pending = {label: counts for label, counts in self._pending.items() if label in alive}


def run_filter(
    multi_filter: DisparityFilter,
    reader: LogReader,
    times: ReportTimes | None = None,
    unusable: list[int] | None = None,
    progress: Progress | None = None,
    keep_events: bool = False,
) -> Iterator[Record]:
    """Run a filter over a log, event by event, in memory that does not depend on its length.

    Parameters
    ----------
    multi_filter : DisparityFilter
    reader : LogReader
        Made with the filter's cameras.
    times : ReportTimes, optional
        When estimates are reported; default after every event.
    unusable : list of one int, optional
        Raised by the number of detections that have no undistorted place.
    progress : callable, optional
        Called with the rows done and their total.
    keep_events : bool
        Whether records carry the detections of their events.

    Yields
    ------
    Record
        One an event, and one a time of the grid.
    """
    times = times or ReportTimes()
    state = multi_filter.init()
    attribution = Attribution()
    last: Record | None = None
    for number, frame in enumerate(reader):
        if last is not None:
            yield from _predictions(multi_filter, state, last, times.grid_s, frame.time_s - same_time(frame.time_s))
        camera = multi_filter.rig.cameras[frame.camera]
        frozen = camera if camera.pose.is_static else camera.at(frame.time_s)
        event = make_event(frozen, frame.camera, frame.time_s, frame.pixels, frame.sigma)
        if unusable is not None:
            unusable[0] += len(frame.pixels) - len(event.points)
        first_label = state.next_label
        state, info, estimates = multi_filter.step(state, event)
        last = Record(
            frame.time_s, camera.name, frame.frame, len(event.points), first_label, info, estimates,
            attribution.update(camera.name, info.detected, estimates), times.after(camera.name),
            event=event if keep_events else None,
        )  # fmt: skip
        yield last
        if number % PROGRESS_EVERY == 0:
            attribution.keep(state.mixture.labels)
            if progress is not None:
                progress(reader.counts["rows"], reader.num_rows)
    if last is not None:
        yield from _predictions(multi_filter, state, last, times.grid_s, last.time_s + same_time(last.time_s))
    if progress is not None:
        progress(reader.num_rows, reader.num_rows)


def _predictions(
    multi_filter: DisparityFilter, state: FilterState, last: Record, grid_s: float | None, until_s: float
) -> Iterator[Record]:
    """Yield the objects after an event at the times of the grid before `until_s`."""
    if grid_s is None:
        return
    for time_s in grid_times(grid_s, last.time_s - same_time(last.time_s), until_s):
        faded = multi_filter.survival_per_s ** max(time_s - last.time_s, 0.0)
        there = replace(state, mixture=state.mixture.with_weights(state.mixture.weights * faded), time_s=time_s)
        info = replace(last.info, log_likelihood=0.0, cardinality_mean=last.info.cardinality_mean * faded)
        _, estimates = multi_filter.extract(there)
        yield Record(
            time_s, last.camera, last.frame, 0, state.next_label, info, estimates, reported=True, is_event=False
        )


def grid_times(step_s: float, from_s: float, until_s: float) -> Iterator[float]:
    """Yield the multiples of a step in ``[from_s, until_s)``, rounded to the nanosecond."""
    index = math.floor(from_s / step_s) - 1
    while (time_s := round(index * step_s, TIME_DECIMALS)) < until_s:
        if time_s >= from_s:
            yield time_s
        index += 1


def same_time(time_s: float) -> float:
    """Distance, s, up to which a time of the grid is that of an event at `time_s`."""
    return max(SAME_TIME_S, SAME_TIME_ULPS * float(np.spacing(abs(time_s))))
