"""An estimator over frames that arrive in any order: a late frame takes it back to the state before that frame.

An event is worked as soon as it arrives. The events of the last seconds are kept, and the states before some of them. A
frame that is older than the last event rewinds the estimator to a state before its own time, and the events from there
on are worked again: exactly what a run over the frames in order gives, because `RunState` holds all that a run depends
on. Memory is bounded by the span, and a frame older than that is too late.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from stereophd.core.disparity.events import Event
from stereophd.pipeline.tracking import loop
from stereophd.pipeline.tracking.associations import Associations
from stereophd.pipeline.tracking.knocked import KnockTest

# The state is kept before every such event: what is given up at once leaves its memory to the next while it is cached.
KEPT_EVERY = 4


class Step(NamedTuple):
    """An event that was worked, with the state before it."""

    key: tuple[float, int, int]  # True time, camera and frame: the order of a run
    event: Event
    before: loop.RunState[Any] | None  # None where it is not kept; of the first step it is
    records: tuple[loop.Record, ...]


class RewindingRun:
    """An estimator's run, reported at `times`, that events up to `span_s` of true time before the newest can join."""

    def __init__(
        self, estimator: loop.Estimator[Any], times: loop.ReportTimes, span_s: float, keep_records: bool
    ) -> None:
        self._estimator, self._times, self._span_s, self._keep_records = estimator, times, span_s, keep_records
        self._run: loop.RunState[Any] = loop.RunState(estimator.init())
        self._steps: list[Step] = []
        self._settled: tuple[float, int, int] | None = None
        #: Until when `forecasts` has predicted, s.
        self.forecast_s = -math.inf

    def is_too_late(self, event: Event) -> bool:
        """Whether an event comes before one that the newest left behind by more than the span."""
        return self._settled is not None and _key(event) < self._settled

    def work(self, event: Event) -> Sequence[Step]:
        """Work an event that not `is_too_late`, and later ones again; return their steps, its own first."""
        place = len(self._steps)
        while place and self._steps[place - 1].key >= _key(event):
            place -= 1
        later = self._steps[place:]
        if later:
            first, self._run = self._kept_state(place)
            earlier = self._steps[first:place]
            del self._steps[first:]
            self._steps += [self._step(step.event) for step in earlier]
        new = [self._step(event), *(self._step(step.event) for step in later)]
        self._steps += new if self._keep_records else [step._replace(records=()) for step in new]
        self._forget()
        return new

    @property
    def records(self) -> list[loop.Record]:
        """With `keep_records`, those of the events that are kept, in order, those of late ones in their places."""
        return [record for step in self._steps for record in step.records]

    @property
    def knocks(self) -> KnockTest:
        """The test for cameras that were knocked, after the last event."""
        return self._run.knocks

    def go_on(self, estimator: loop.Estimator[Any]) -> None:
        """Go on with an estimator whose cameras have other poses; cameras may be knocked again."""
        self._estimator = estimator
        self._run.knocks = KnockTest()

    def forecasts(self, until_s: float) -> Iterator[loop.Record]:
        """Yield predictions to the times of the grid before `until_s`; they come again, exact, with the next event."""
        grid_s, from_s = self._times.grid_s, max(self.forecast_s, self._run.forecast_from_s)
        if grid_s is None or self._run.last is None or math.floor(until_s / grid_s) <= math.floor(from_s / grid_s):
            return
        run, self.forecast_s = copy_of(self._run), until_s
        run.forecast_from_s = from_s
        yield from loop.forecasts(self._estimator, run, self._times, until_s)

    def finish(self) -> Iterator[loop.Record]:
        """Yield what is reported after the last event."""
        yield from loop.finish(self._estimator, self._run, self._times)

    def _step(self, event: Event) -> Step:
        before = copy_of(self._run) if not self._steps or self._run.events % KEPT_EVERY == 0 else None
        records = tuple(loop.work_event(self._estimator, self._run, event, self._times))
        return Step(_key(event), event, before, records)

    def _kept_state(self, place: int) -> tuple[int, loop.RunState[Any]]:
        """Return the place of the last step, up to that at a place, before which the state is kept, and that state."""
        while (before := self._steps[place].before) is None:
            place -= 1
        return place, before

    def _forget(self) -> None:
        """Remove states that no event may come before."""
        newest = self._steps[-1].key[0]
        count = 0
        while count < len(self._steps) - 1 and self._steps[count].key[0] < newest - self._span_s:
            count += 1
        if count:
            self._settled = self._steps[count - 1].key
            del self._steps[: self._kept_state(count)[0]]


def _key(event: Event) -> tuple[float, int, int]:
    return event.time_s, event.camera, event.frame


def copy_of(run: loop.RunState[Any]) -> loop.RunState[Any]:
    """Return a copy of a run that does not change when the run continues; states and records are frozen already."""
    attribution, known = loop.Attribution(dict(run.attribution.pending)), run.associations
    return replace(run, attribution=attribution, associations=Associations(dict(known.known), list(known.waiting)))
