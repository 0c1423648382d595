"""The one loop that runs an estimator over events, with predictions to the times of a grid.

Filters of many objects (`stereophd.core.multi.base.DisparityFilter`) and estimators of one
(`stereophd.pipeline.tracking.single.SingleTracker`) run in it alike. `RunState` holds all that the rest of a run
depends on: with it and the events that follow, another process gives the records of an uninterrupted run.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event, Rig
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.numerics.times import TIME_DECIMALS, same_time
from stereophd.errors import InputError
from stereophd.pipeline.tracking.associations import Associated, Associations
from stereophd.pipeline.tracking.knocked import Knock, KnockTest, look
from stereophd.wording import LOGGER, instant

# Number of events after which the data of ended tracks are removed.
FORGET_EVERY = 50

# Cameras that must have detected a tentative object.
SUPPORT = 2

# Times of a grid between two events. More than `MOST_FORECASTS` are an error. If more than `MOST_EMPTY_FORECASTS` are
# without an object, all after the first are left out. A pause of the recording may last for years.
MOST_FORECASTS = 1_000_000
MOST_EMPTY_FORECASTS = 10_000


@dataclass(frozen=True)
class ReportTimes:
    """When estimates are reported: after every event, or as the camera or grid that is set requires.

    With `max_position_std`, also how certain they must be for their associations to be reported.
    """

    camera: str | None = None  # After every frame of this camera
    grid_s: float | None = None  # At the multiples of this interval, s, from the first event to the last
    # Associations are those of tracks whose position was at least once as certain as this when they were reported.
    max_position_std: float | None = None
    # Associations are those of all confirmed tracks: what is written of them is decided once the run is known.
    whole_run: bool = False
    region: NDArray[np.float64] | None = None  # Half-spaces (h, 4) in which objects are reported; None: anywhere

    def after(self, camera: str) -> bool:
        """Whether estimates are reported after an event of this camera."""
        return self.grid_s is None and self.camera in (None, camera)

    def certain(self, estimates: Estimates) -> Estimates:
        """Return the estimates that are certain enough for their associations to be reported."""
        if self.whole_run or self.max_position_std is None:
            return estimates
        return estimates.certain(self.max_position_std)


AnyTracks = TypeVar("AnyTracks", Estimates, Associated)


@dataclass(frozen=True)
class Record:
    """One event of a run, or a prediction to a time of the grid: camera and frame are those of the last event then.

    Attributes
    ----------
    time_s : true time, s
    camera, frame : name of the camera, number of its frame
    n_detections : 0 of a prediction
    first_label : smallest label that an object first detected in this event can have
    info : diagnostics; of a prediction those of the last event, faded, with log-likelihood 0
    estimates : the objects: labels, states (k, 6), covariances (k, 6, 6) and existence, in the world, per second
    attributed : track -> camera -> number of detections known to be its own since the last record (a new one: ever)
    reported : whether the estimates are to be written
    is_event : False of a prediction
    event : the detections themselves, where a run keeps them
    associations : detections that reported tracks claim: also earlier ones of tracks reported for the first time
    knock : a camera that the event shows to have been knocked
    outside : number of detections that see nothing of the region, or are of tracks beside it
    filtered : the record of the filter, if this one is smoothed
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
    associations: tuple[Associated, ...] = ()
    knock: Knock | None = None
    outside: int = 0
    filtered: "Record | None" = None

    def of_tracks(self, is_kept: Callable[[int], bool]) -> "Record":
        """Return the record with some of its tracks only."""

        def kept(of: Estimates | Associated) -> NDArray[np.bool_]:
            return np.array([is_kept(track_id) for track_id in of.track_ids.tolist()], dtype=np.bool_)

        estimates, tentative = self.estimates, self.estimates.tentative
        mask = kept(estimates)
        if tentative is not None:
            tentative = tentative.take(kept(tentative))
        if not mask.all() or tentative is not None:
            estimates = replace(estimates.take(mask), tentative=tentative)
        rows = [(one, kept(one)) for one in self.associations]
        associations = tuple(one if mask.all() else one.take(mask) for one, mask in rows if mask.any())
        filtered = None if self.filtered is None else self.filtered.of_tracks(is_kept)
        return replace(self, estimates=estimates, associations=associations, filtered=filtered)

    def renamed(self, name: Callable[[int], int]) -> "Record":
        """Return the record with other identities of its tracks."""

        def rename(of: AnyTracks) -> AnyTracks:
            return replace(of, track_ids=np.array([name(one) for one in of.track_ids.tolist()], dtype=np.int64))

        estimates = rename(self.estimates)
        if (tentative := estimates.tentative) is not None:
            estimates = replace(estimates, tentative=rename(tentative))
        return replace(
            self,
            estimates=estimates,
            attributed={name(track_id): counts for track_id, counts in self.attributed.items()},
            associations=tuple(rename(one) for one in self.associations),
        )


class EstimatorState(Protocol):
    """The part of an estimator's state that the loop reads."""

    @property
    def next_label(self) -> int:
        """First label that no object has."""

    @property
    def labels(self) -> NDArray[np.int64]:
        """Labels of all objects that the state holds."""


State = TypeVar("State", bound=EstimatorState)


class Estimator(Protocol[State]):
    """An estimator that the loop runs."""

    @property
    def rig(self) -> Rig:
        """The cameras."""

    def init(self) -> State:
        """Return the state before the first event."""

    def step(self, state: State, event: Event) -> tuple[State, Info, Estimates]:
        """Return the state after an event, its diagnostics, and the objects then."""

    def forecast(self, state: State, info: Info, time_s: float) -> tuple[Info, Estimates]:
        """Return diagnostics and objects at a time between two events."""


@dataclass
class Attribution:
    """Detections of each label: counts until the label is reported as a track."""

    # Label -> camera -> detections, of the labels that are not reported yet; counts are replaced, never changed.
    pending: dict[int, dict[str, int]] = field(default_factory=dict)

    def update(self, camera: str, detected: Iterable[int], estimates: Estimates) -> dict[int, dict[str, int]]:
        """Count the labels that an event of a camera detected; return what falls to the reported tracks."""
        pending, once = self.pending, {camera: 1}  # one for all: most labels have been reported, and wait for nothing
        for label in detected:
            counts = pending.get(label)
            pending[label] = once if counts is None else counts | {camera: counts.get(camera, 0) + 1}
        tracks = zip(estimates.track_ids.tolist(), estimates.labels.tolist(), strict=True)
        return {track_id: pending.pop(label) for track_id, label in tracks if label in pending}

    def keep(self, labels: NDArray[np.int64]) -> None:
        """Forget all labels but these: memory does not grow with the log."""
        alive = set(labels.tolist())
        self.pending = {label: counts for label, counts in self.pending.items() if label in alive}


@dataclass
class RunState(Generic[State]):
    """All that the rest of a run depends on. `run_estimator` brings it up to date before it yields a record."""

    estimator: State  # State of the estimator after the last event
    events: int = 0  # Number of events so far: those that a run from a copy passes over
    last: Record | None = None  # Record of the last event
    forecast_from_s: float = -math.inf  # Times of the grid from here on are still to be predicted
    attribution: Attribution = field(default_factory=Attribution)
    associations: Associations = field(default_factory=Associations)
    knocks: KnockTest = field(default_factory=KnockTest)


def run_estimator(
    estimator: Estimator[State],
    events: Iterable[Event],
    times: ReportTimes | None = None,
    keep_events: bool = False,
    run: RunState[State] | None = None,
) -> Iterator[Record]:
    """Run an estimator over events, in memory that does not depend on their number.

    The events, such as those of `stereophd.pipeline.stream.EventStream`, are those of the estimator's cameras, in order
    of time. Estimates are reported at `times`, by default after every event: one record per event, and one per time of
    the grid; with `keep_events` records carry their events. `run` says where the run begins (default before the first
    event), and is kept up to date.
    """
    times = times or ReportTimes()
    run = RunState(estimator.init()) if run is None else run
    for event in events:
        yield from work_event(estimator, run, event, times, keep_events)
    yield from finish(estimator, run, times)


def work_event(
    estimator: Estimator[State], run: RunState[State], event: Event, times: ReportTimes, keep_events: bool = False
) -> Iterator[Record]:
    """Work one event of `run_estimator`: yield the predictions before it, and its own record."""
    cameras = estimator.rig.cameras
    if times.grid_s is not None:
        yield from forecasts(estimator, run, times, event.time_s - same_time(event.time_s))
    name = cameras[event.camera].name
    event = event.within(estimator.rig)
    knock = None
    if run.last is not None:
        run.knocks, knock = look(run.knocks, cameras, event, run.last.time_s, run.last.estimates)
    first_label = run.estimator.next_label
    run.estimator, info, estimates = estimator.step(run.estimator, event)
    outside = 0
    if times.region is not None and not times.whole_run:
        labels, estimates = estimates.labels, estimates.inside(times.region)
        outside = int(np.isin(info.detected, np.setdiff1d(labels, estimates.labels)).sum())
    # most newborns are other detections of known objects, and gone at once
    alive = set(run.estimator.labels.tolist())
    detected = [label for label in info.detected.tolist() if label < first_label or label in alive]
    attributed = run.attribution.update(name, detected, estimates)
    estimates = _supported(estimates, run, len(cameras))
    associations = run.associations.update(event, name, info.claims)
    if info.claims is not None and (times.whole_run or times.after(name)):
        associations += tuple(run.associations.report(times.certain(estimates)))
    run.last = record = Record(
        event.time_s, name, event.frame, len(event.points) + event.outside, first_label, info, estimates, attributed,
        times.after(name), event=event if keep_events else None, associations=associations, knock=knock,
        outside=event.outside + outside,
    )  # fmt: skip
    run.forecast_from_s = event.time_s - same_time(event.time_s)
    if run.events % FORGET_EVERY == 0:
        run.attribution.keep(run.estimator.labels)
        run.associations.keep(run.estimator.labels)
    run.events += 1
    yield record


def finish(estimator: Estimator[State], run: RunState[State], times: ReportTimes) -> Iterator[Record]:
    """Yield the predictions of `run_estimator` after the last event."""
    if times.grid_s is not None and run.last is not None:
        yield from forecasts(estimator, run, times, run.last.time_s + same_time(run.last.time_s))


def _supported(estimates: Estimates, run: RunState[State], cameras: int) -> Estimates:
    """Return estimates with only those tentative objects that two cameras have detected.

    In the first events of a log, as many as there are cameras, one camera is enough: most of what the first frames show
    was there before the recording, and no second camera may have had a frame.
    """
    tentative = estimates.tentative
    if tentative is None:
        return estimates
    pending = run.attribution.pending
    least = 1 if run.events < cameras else SUPPORT
    kept = np.array([len(pending.get(label, ())) >= least for label in tentative.labels.tolist()], dtype=bool)
    return estimates if kept.all() else replace(estimates, tentative=tentative.take(kept) if kept.any() else None)


def forecasts(
    estimator: Estimator[State], run: RunState[State], times: ReportTimes, until_s: float
) -> Iterator[Record]:
    """Yield objects after the last event at grid times before `until_s`; InputError if too many have an object."""
    last = run.last
    if last is None or times.grid_s is None:
        return
    if (until_s - run.forecast_from_s) / times.grid_s > MOST_FORECASTS:
        _check_pause(estimator, run, last, times.grid_s, until_s)
    for time_s in grid_times(times.grid_s, run.forecast_from_s, until_s):
        info, estimates = estimator.forecast(run.estimator, last.info, time_s)
        estimates = _supported(estimates, run, len(estimator.rig.cameras))
        run.forecast_from_s = math.nextafter(time_s, math.inf)
        left = (until_s - time_s) / times.grid_s
        empty = not len(estimates.track_ids) and estimates.tentative is None
        if empty and left > MOST_EMPTY_FORECASTS:
            LOGGER.warning(
                "report.times: no object is left at %g s, %g s before the next event: about %.0f times of the grid "
                "are left out",
                time_s, until_s - time_s, left,
            )  # fmt: skip
            run.forecast_from_s = until_s
        yield Record(
            time_s, last.camera, last.frame, 0, run.estimator.next_label, info, estimates, is_event=False,
            associations=tuple(run.associations.report(times.certain(estimates))),
        )  # fmt: skip
        if run.forecast_from_s == until_s:
            return


def _check_pause(
    estimator: Estimator[State], run: RunState[State], last: Record, step_s: float, until_s: float
) -> None:
    """Check that no object is left after as many times of the grid as are allowed: none comes back after that."""
    from_s = run.forecast_from_s
    _, estimates = estimator.forecast(run.estimator, last.info, from_s + MOST_FORECASTS * step_s)
    if len(estimates.track_ids):
        raise InputError(
            f"report.times: grid {step_s:g} s: expected at most {MOST_FORECASTS} times between two events, found "
            f"{(until_s - from_s) / step_s:.3g} from {instant(from_s)} s to {instant(until_s)} s, with an object "
            "at each; choose a longer step, a shorter life of objects (`filter.survival_per_s`), or cut the log there"
        )


def grid_times(step_s: float, from_s: float, until_s: float) -> Iterator[float]:
    """Yield the multiples of a step in ``[from_s, until_s)``, rounded to the nanosecond."""
    index = math.floor(from_s / step_s) - 1
    while (time_s := round(index * step_s, TIME_DECIMALS)) < until_s:
        if time_s >= from_s:
            yield time_s
        index += 1
