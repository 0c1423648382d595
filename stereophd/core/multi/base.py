"""What the multi-object filters share: state, prediction by particle move, extraction.

A filter is ``init / predict / update / extract`` over a frozen state; `DisparityFilter.step` is the
three in a row that an event takes. The filters differ in their update.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.moments import NO_REGION, RULES, draws_of_event, move
from stereophd.core.disparity.moved import Moved, Sources, room_for_moved
from stereophd.core.motion.base import Motion
from stereophd.core.multi.births.survival import IMPORTANT_WEIGHT
from stereophd.core.multi.births.undetected import (
    Undetected,
    all_undetected,
    birth_rates,
    expected_births,
    newborn_prior,
    undetected_shares,
)
from stereophd.core.multi.extract import Report, select_objects
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.multi.prediction import Fields, predict_event
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.state.inputs import Detections, EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture, empty_mixture
from stereophd.core.multi.swaps.history import History
from stereophd.core.numerics.samples import SampleSets

# Assumed where the system does not report it, bytes.
DEFAULT_MEMORY = 4e9


# Upper bound on the memory of one component, its moved forms and its updated forms, bytes.
_COMPONENT_BYTES = 4096


def most_components(stated: int | None) -> int:
    """Return the bound on the components: the one stated, or what an eighth of the memory holds."""
    if stated is not None:
        return int(stated)
    try:
        memory = float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        memory = DEFAULT_MEMORY
    return int(memory / 8 / _COMPONENT_BYTES)


@dataclass(frozen=True)
class FilterState:
    """State after an event."""

    mixture: GaussianMixture  # The intensity (PHD), or the tracks and the intensity of undetected objects (PMB)
    time_s: float | None  # Time of the last event, None before the first
    n_events: int  # Events so far: picks the sample set
    # `next_label`, `next_track`: First unused label and identity.
    next_label: int
    next_track: int
    undetected: Undetected | None = None  # Objects that no camera has detected yet; None before the first event
    history: History | None = None  # Detections of the last events, of a filter that looks back

    @property
    def labels(self) -> Integers:
        """Labels of the components."""
        return self.mixture.labels


@dataclass(frozen=True)
class Prediction:
    """The surviving components, at home and carried into the event's disparity space.

    With them the expected number of undetected objects in view (`births`), what the event leaves of them, and how many
    of the event's detections are a `burst` of clutter.
    """

    mixture: GaussianMixture
    moved: Moved
    births: float
    undetected: Undetected
    burst: int = 0


@dataclass(frozen=True)
class DisparityFilter(ABC):
    """A multi-object filter on disparity space."""

    rig: Rig
    motion: Motion
    sets: SampleSets  # Shared by all components of a step
    settings: FilterSettings
    threads: int = 1  # Threads of the sample trips; results do not depend on it
    claims: bool = False  # Whether `Info.claims` is filled in

    #: Whether components of one label may be several objects (`select_objects`).
    labels_may_split: ClassVar[bool] = True
    #: The compiled event of many camera hypotheses (`multi.camera_hypotheses.batch_kernels`).
    update_hypotheses: ClassVar[Callable[..., tuple[Integers, GaussianMixture, Array]]]

    @abstractmethod
    def update(self, state: FilterState, prediction: Prediction, event: Event) -> tuple[FilterState, Info]:
        """Update with the detections of an event."""

    @property
    @abstractmethod
    def reduction(self) -> NamedTuple:
        """Settings of the reduction, for compiled code."""

    @property
    @abstractmethod
    def last_kernels(self) -> tuple[tuple[Any, tuple[Any, ...]], ...]:
        """Large kernels that an event needs late, the last one at the end, each with arguments of the types of a call.

        They are what a second process compiles first (`stereophd.core.multi.build`).
        """

    def compile_tests(self) -> None:
        """Compile what the filter needs only from when it reports several objects; by default there is nothing."""
        return

    @property
    def state_size(self) -> int:
        """Size of the states: 6, or 3 for static objects."""
        return self.motion.state_size

    def init(self) -> FilterState:
        """Return the state before the first event: no objects."""
        return FilterState(empty_mixture(self.state_size), None, 0, 0, 0)

    def prediction(self, state: FilterState, event: Event) -> Fields:
        """Return how the components of a state come to an event, as `predict_event` takes it."""
        mixture, rig, numbers = state.mixture, self.rig, self.event_numbers(state.time_s, event, state.next_label)
        intervals = np.zeros(mixture.size + 1)
        np.subtract(event.time_s, mixture.times, out=intervals[:-1])
        motion, destination = self.motion.arrays(intervals), rig.space(event.camera, event.time_s)
        region = NO_REGION if rig.region is None else rig.region
        carried, undetected = self._at_start
        if self.threads > 1 or self.sets.method in RULES:
            homes = rig.spaces(mixture.cameras, mixture.times)
            carried = move(
                Sources(mixture.means, mixture.covariances, homes, motion), destination, self.sets, state.n_events,
                numbers.shape_p_detect, mixture.weights * numbers.survival >= IMPORTANT_WEIGHT, self.threads, region,
            )  # fmt: skip
        return (
            tuple(numbers), tuple(carried), *rig.numbered_spaces(mixture.cameras, mixture.times), tuple(motion),
            destination, rig.views(event.time_s), region, self._draws[state.n_events % len(self._draws)],
            tuple(state.undetected or undetected), self._birth_rates, self._remaining_shares[event.camera],
        )  # fmt: skip

    @cached_property
    def _draws(self) -> list[Fields]:
        draws = [draws_of_event(self.sets, turn) for turn in range(len(self.sets.sets))]
        return [(tuple(first), tuple(second)) for first, second in draws]

    @cached_property
    def _at_start(self) -> tuple[Moved, Undetected]:
        """No components, carried into a space, and what is undetected before the first event."""
        return room_for_moved(0, self.state_size), all_undetected(len(self.rig.cameras))

    def predict(
        self, state: FilterState, event: Event, births: tuple[float, Undetected, int] | None = None
    ) -> Prediction:
        """Let objects survive, move and come into the event's disparity space.

        `births` replaces what `expected_births` returns, for filters of several camera hypotheses that share it.
        """
        weights, moved, _, *expected = predict_event(tuple(state.mixture), self.prediction(state, event))
        return Prediction(state.mixture.with_weights(weights), moved, *(births or expected))

    @cached_property
    def _remaining_shares(self) -> list[Array]:
        """Return the share (c, c) of the objects in view of each camera that a frame of each camera leaves."""
        return list(np.ascontiguousarray(undetected_shares(self.rig, self.settings.birth).T))

    @cached_property
    def _birth_rates(self) -> tuple[float, float, float]:
        return birth_rates(self.settings.birth)

    def expected_births(
        self, undetected: Undetected | None, elapsed: float, event: Event
    ) -> tuple[float, Undetected, int]:
        """Return the births of an event, what it leaves, and its burst of clutter, where no object is known."""
        numbers = self.event_numbers(None, event, 0)._replace(elapsed=elapsed)
        remaining = self._remaining_shares[event.camera]
        return expected_births(undetected or self._at_start[1], self._birth_rates, remaining, numbers, 0.0)

    def extract(self, state: FilterState) -> tuple[FilterState, Estimates]:
        """Report the objects of a state, in the world at the state's time."""
        mixture = state.mixture
        chosen = select_objects(
            mixture,
            Report(*self.report, state.next_label, state.next_track),
            np.arange(mixture.size),
            self.rig.spaces(mixture.cameras, mixture.times),
            self.motion.arrays((0.0 if state.time_s is None else state.time_s) - mixture.times),
            self.sets.turn(state.n_events),
        )
        # `replace` takes longer
        state = FilterState(
            chosen.mixture, state.time_s, state.n_events, chosen.next_label, chosen.next_track, state.undetected,
            state.history
        )  # fmt: skip
        return state, chosen.estimates()

    @cached_property
    def report(self) -> tuple[float, float, float, bool]:
        """How objects are reported: `Report` without counters."""
        levels = self.settings.extraction
        return float(levels.confirm), float(levels.release), float(levels.tentative), self.labels_may_split

    def step(self, state: FilterState, event: Event) -> tuple[FilterState, Info, Estimates]:
        """Predict, update and extract for one event; filters that swap tracks do so in between."""
        state, info = self.update(state, self.predict(state, event), event)
        state, estimates = self.extract(state)
        return state, info, estimates

    def forecast(self, state: FilterState, info: Info, time_s: float) -> tuple[Info, Estimates]:
        """Predict the objects of a state to a later time at which no camera reported.

        State and info are those after the last event; the info returned is faded, with log-likelihood 0.
        """
        assert state.time_s is not None
        faded = self.settings.survival_per_s ** max(time_s - state.time_s, 0.0)
        later = replace(state, mixture=state.mixture.with_weights(state.mixture.weights * faded), time_s=time_s)
        _, estimates = self.extract(later)
        return replace(info, log_likelihood=0.0, cardinality_mean=info.cardinality_mean * faded), estimates

    def detections(self, event: Event) -> tuple[Detections, FirstSight]:
        """Return an event's detections, and the prior of the objects that they may have given birth to."""
        space = self.rig.space(event.camera, event.time_s)
        detections = Detections(event.points, event.covariances, event.areas, event.readings(space))
        if not self.rig.moving:
            return detections, self._newborns[event.camera]
        return detections, newborn_prior(space, self.settings.birth, self.rig.region)

    @cached_property
    def _newborns(self) -> list[FirstSight]:
        return [newborn_prior(space, self.settings.birth, self.rig.region) for space in self.rig.packed]

    def event_numbers(self, before_s: float | None, event: Event, next_label: int) -> EventNumbers:
        """Return the numbers of an event, nothing born yet; the last one was at a time `before_s`, None if none was."""
        p_detect, clutter, area = self._detectors[event.camera]
        elapsed = 0.0 if before_s is None else max(event.time_s - before_s, 0.0)
        return EventNumbers(
            int(event.camera), float(event.time_s), elapsed, next_label, len(event.points), p_detect,
            p_detect if self.settings.missed == "split" else 0.0, area, self.settings.survival_per_s**elapsed,
            float(self.settings.out_of_view_s), clutter, 0.0,
        )  # fmt: skip

    @cached_property
    def _detectors(self) -> list[tuple[float, float, float]]:
        """Probability of detection, clutter a frame and area of the image of each camera."""
        return [
            (float(one.detector.p_detect), one.detector.expected_clutter, float(one.width * one.height))
            for one in self.rig.cameras
        ]
