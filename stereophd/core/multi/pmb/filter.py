"""Poisson multi-Bernoulli filter on disparity space: labelled tracks.

The track-oriented marginal filter (Williams 2015). Each track is a Bernoulli component: a probability of existence and
a mixture of the hypotheses that the data have not decided yet. Most tracks have one Gaussian; several remain where
detections of two cameras on one epipolar line can be paired in several ways. Association marginals are exact, cluster
by cluster; loopy belief propagation replaces them for clusters that are too large. Objects that were never detected
form a Poisson intensity, uniform over the image (the observation-driven birth of the PHD filter); tracks that became
improbable are recycled to it. The log-likelihood of an event is the value of its association problem.

Reference: J. L. Williams, "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA and
association-based MeMBer", IEEE Trans. AES 51 (3), 2015.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.moved import Moved
from stereophd.core.multi.association.attribution import Claims, claims_of, detected_labels
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.association.likelihoods import FEW_COMPONENTS
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction, most_components
from stereophd.core.multi.births.undetected import Undetected, prune_weight_for_births, prune_weight_in_crowd
from stereophd.core.multi.camera_hypotheses.batch_kernels import update_track_sets
from stereophd.core.multi.extract import Report, Selection, select_objects
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.pmb.hypotheses import (
    BY_DETECTIONS,
    Existences,
    PmbReduction,
    choose_hypotheses,
    make_hypotheses,
)
from stereophd.core.multi.pmb.reduction import reduce_tracks
from stereophd.core.multi.pmb.update import associate_tracks
from stereophd.core.multi.prediction import BirthsBefore, Journey, predict_event
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.state.inputs import Detections, EventNumbers, with_births, with_newborns
from stereophd.core.multi.state.mixture import UNLABELLED, GaussianMixture, empty_mixture
from stereophd.core.multi.swaps.epipolar_pairs import SwapSearch, search_pairs
from stereophd.core.multi.swaps.history import ClaimedDetections, History
from stereophd.core.multi.swaps.swap_test import MOST_TESTS, SwapTest
from stereophd.core.numerics.compilation.compiled import compiled

NO_HISTORY = History()


@dataclass(frozen=True)
class PmbFilter(DisparityFilter):
    """The PMB filter; see `DisparityFilter` for its other fields.

    In the state's mixture a label is a track and its weight the existence; components labelled -1 are
    the intensity of undetected objects.
    """

    settings: PmbSettings

    labels_may_split: ClassVar[bool] = False

    @cached_property
    def reduction(self) -> PmbReduction:
        """Settings of the reduction, for compiled code."""
        settings = self.settings
        return PmbReduction(
            recycle_below=float(settings.recycle_below), prune_weight=float(settings.prune_weight),
            merge_distance=float(settings.merge_distance), max_components=most_components(settings.max_components),
            hypothesis_distance=float(settings.hypothesis_distance), least_share=float(settings.least_share),
            max_hypotheses=int(settings.max_hypotheses or BY_DETECTIONS),
        )  # fmt: skip

    @cached_property
    def swap_test(self) -> SwapTest:
        """The test for pairs of tracks that are paired crosswise."""
        samples, settings = self.sets.turn(0), self.settings
        return SwapTest(self.rig, self.motion, samples, settings.birth, settings.exchange_above)

    @property
    def update_hypotheses(self) -> Callable[..., tuple[Integers, GaussianMixture, Array]]:
        """See `DisparityFilter`."""
        return update_track_sets

    @property
    def last_kernels(self) -> tuple[tuple[Any, tuple[Any, ...]], ...]:
        """See `DisparityFilter`."""
        integers = np.empty(0, dtype=np.int64)
        return (
            (association_marginals, (integers, integers, np.empty(0), 0, 0)),
            (reduce_tracks, (empty_mixture(self.state_size), Existences(integers, np.empty(0), 0.0), self.reduction)),
        )

    def compile_tests(self) -> None:
        """Compile the test for pairs of tracks that are paired crosswise."""
        self.swap_test.compile()

    def update(self, state: FilterState, prediction: Prediction, event: Event) -> tuple[FilterState, Info]:
        """Update with the detections of an event (Williams 2015, section IV), then reduction."""
        before = self.births_before(state.undetected, 0.0, event)
        reduced, updated, claims = _update(
            prediction.mixture, prediction.moved, *self.detections(event), self.event_numbers(event, state.next_label),
            (prediction.births, prediction.burst), float(before.undetected.peaks[event.camera]), self.reduction,
            self.claims,
        )  # fmt: skip
        history = self._history_after(state, event, updated)
        if history is not None:
            reduced, history = self.swap_test.put_right(reduced, history, event.camera, event.time_s, state.n_events)
        label, undetected = state.next_label + len(event.points), prediction.undetected
        after = FilterState(reduced, event.time_s, state.n_events + 1, label, state.next_track, undetected, history)
        return after, self._info(state, event, after, updated, claims, prediction.burst)

    def step(self, state: FilterState, event: Event) -> tuple[FilterState, Info, Estimates]:
        """Predict, update and extract for one event, in one compiled call."""
        journey, label = self.journey(state, event), state.next_label + len(event.points)
        search = self.swap_test.search(
            state.history or NO_HISTORY, event.camera if self._exchanges else 0, event.time_s, state.n_events
        )
        selection, updated, claims, pairs, undetected, burst = _step(
            state.mixture, self.carried(state, journey), journey,
            self.births_before(state.undetected, journey.numbers.elapsed, event), *self.detections(event),
            self.event_numbers(event, state.next_label), self.reduction, self.claims, search,
            self.report(label, state.next_track), self.sets.turn(state.n_events + 1),
        )  # fmt: skip
        mixture, history = selection.mixture, self._history_after(state, event, updated)
        if len(pairs):
            assert history is not None
            mixture, history = self.swap_test.swap(mixture, history, pairs, search)
        after = FilterState(
            mixture, event.time_s, state.n_events + 1, selection.next_label, selection.next_track, undetected, history
        )
        info = self._info(state, event, after, updated, claims, burst)
        if mixture is not selection.mixture:
            # identities are those of the first look: a swap leaves the existence of every track as it is
            after, estimates = self.extract(after)
            return after, info, estimates
        return after, info, selection.estimates()

    @cached_property
    def _exchanges(self) -> bool:
        return math.isfinite(self.settings.exchange_above)

    def _history_after(self, state: FilterState, event: Event, updated: "Updated") -> History | None:
        """Return the history with what the labels claimed of an event; None where nothing is exchanged."""
        if not self._exchanges:
            return None
        readings = event.readings(self.rig.space(event.camera, event.time_s))
        claimed = ClaimedDetections(
            event.camera, event.time_s, updated.labels, updated.detections, event.points, event.covariances, readings
        )
        return (state.history or NO_HISTORY).add(claimed)

    def _info(
        self, before: FilterState, event: Event, after: FilterState, updated: "Updated", claims: Claims | None,
        burst: int,
    ) -> Info:  # fmt: skip
        """Return the diagnostics of an event."""
        left_out, room = 0, self.reduction.max_components - len(event.points)
        if before.mixture.size > room:
            tracks = np.unique(before.mixture.labels)
            left_out = max(int(np.count_nonzero(tracks != UNLABELLED)) - room, 0)
        return Info(
            updated.log_likelihood, updated.cardinality, after.mixture.size, updated.labels, claims, left_out, burst,
            updated.hypotheses_left_out,
        )  # fmt: skip


class Updated(NamedTuple):
    """What an update shows beside the mixture."""

    log_likelihood: float  # Of the event's detections, per distorted pixel
    cardinality: float  # Sum of the existences
    # `labels`, `detections`: arrays (k,) of int: As of `detected_labels`.
    labels: Integers
    detections: Integers
    hypotheses_left_out: int  # Hypotheses beyond the bound on their number


@compiled
def _step(
    mixture: GaussianMixture,
    carried: Moved,
    journey: Journey,
    before: BirthsBefore,
    detected: Detections,
    prior: FirstSight,
    numbers: EventNumbers,
    reduction: PmbReduction,
    with_claims: bool,
    search: SwapSearch,
    report: Report,
    samples: Array,
) -> tuple[Selection, Updated, Claims | None, Integers, Undetected, int]:
    """`predict_event`, `_update`, `search_pairs` and `select_objects`, with what is born and the burst of clutter."""
    weights, moved, homes, births, undetected, burst = predict_event(mixture, carried, journey, before)
    _, means, covariances, cameras, times, labels, tracks, reported = mixture
    predicted = GaussianMixture(weights, means, covariances, cameras, times, labels, tracks, reported)
    peak = before.undetected.peaks[numbers.camera]
    reduced, updated, claims = _update(
        predicted, moved, detected, prior, numbers, (births, burst), peak, reduction, with_claims
    )  # fmt: skip
    rows = _rows_of(reduced, mixture, numbers)
    pairs = search_pairs(reduced, rows, homes, search, len(updated.labels) > 0, MOST_TESTS)
    selection = select_objects(reduced, report, rows, homes, journey.motion, samples)
    return selection, updated, claims, pairs, undetected, burst


@compiled
def _rows_of(after: GaussianMixture, before: GaussianMixture, numbers: EventNumbers) -> Integers:
    """Return which component of n before an event each one after it was at home with, n for those in its space."""
    cameras, times, known_cameras, known_times = after.cameras, after.times, before.cameras, before.times
    count, k = len(known_times), 0
    rows = np.full(len(times), count)
    for i in range(len(times)):
        if cameras[i] != numbers.camera or times[i] != numbers.time_s:
            # both are in order of their labels: the next one is near
            while cameras[i] != known_cameras[k] or times[i] != known_times[k]:
                k = (k + 1) % count
            rows[i] = k
    return rows


@compiled
def _update(
    mixture: GaussianMixture,
    moved: Moved,
    detected: Detections,
    prior: FirstSight,
    bare: EventNumbers,
    born: tuple[float, int],
    peak: float,
    stated: PmbReduction,
    with_claims: bool,
) -> tuple[GaussianMixture, Updated, Claims | None]:
    """`associate_tracks`, which labels were detected and by which detections, and `reduce_tracks`.

    The numbers are those without births, and `born` has the births and the burst of clutter; `peak` is that of the
    camera before the event (`Undetected`). The pruning weight is the one stated, or that of the births.
    """
    births, burst = born
    event, numbers = with_newborns(detected, prior, mixture.means.shape[1]), with_births(bare, births, burst)
    weight = prune_weight_for_births(stated.prune_weight, births, bare.p_detect, bare.clutter)
    if len(mixture.weights) > FEW_COMPONENTS:
        weight = prune_weight_in_crowd(
            weight, stated.recycle_below, max(births, peak), bare.p_detect, bare.clutter, mixture.weights
        )  # fmt: skip
    reduction = PmbReduction(
        stated.recycle_below, weight, stated.merge_distance, stated.max_components, stated.hypothesis_distance,
        stated.least_share, stated.max_hypotheses
    )  # fmt: skip
    outcomes, log_likelihood = associate_tracks(mixture, moved, event, numbers, reduction.prune_weight)
    known, weights, made = outcomes.labels, outcomes.weights, outcomes.made
    labels, detections = detected_labels(known, weights, len(mixture.weights), made)
    claims = claims_of(known, weights, len(mixture.weights), made) if with_claims else None
    choice, tracks = choose_hypotheses(outcomes, reduction)
    reduced, expected = reduce_tracks(
        make_hypotheses(mixture, moved, event, numbers, outcomes, choice), tracks, reduction
    )  # fmt: skip
    return reduced, Updated(log_likelihood, expected, labels, detections, choice.left_out), claims


FILTER = PmbFilter
