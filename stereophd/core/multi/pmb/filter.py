"""Poisson multi-Bernoulli filter on disparity space: labelled tracks.

The track-oriented marginal filter (Williams 2015). Each track is a Bernoulli component: a probability of existence and
a mixture of the hypotheses that the data have not decided yet. Most tracks have one Gaussian; several remain where
detections of two cameras on one epipolar line can be paired in several ways. Association marginals are exact, cluster
by cluster; loopy belief propagation replaces them for clusters that are too large. Objects that were never detected
form a Poisson intensity, uniform over the image (the observation-driven birth of the PHD filter). The log-likelihood of
an event is the value of its association problem.

Reference: J. L. Williams, "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA and
association-based MeMBer", IEEE Trans. AES 51 (3), 2015.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.moved import Moved
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.association.attribution import Claims, claims_of, detected_labels
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction, most_components
from stereophd.core.multi.births.undetected import Undetected, prune_weight_for_births
from stereophd.core.multi.camera_hypotheses.batch_kernels import update_batch
from stereophd.core.multi.extract import Report, Selection, select_objects
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.pmb.hypotheses import BY_DETECTIONS, Existences, PmbReduction, choose_hypotheses
from stereophd.core.multi.pmb.reduction import reduce_tracks
from stereophd.core.multi.pmb.update import associate_tracks
from stereophd.core.multi.prediction import Fields, predict_event
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.state.inputs import Detections, EventNumbers, with_births, with_newborns
from stereophd.core.multi.state.mixture import GaussianMixture, empty_mixture
from stereophd.core.multi.state.outcomes import make_components
from stereophd.core.multi.swaps.epipolar_pairs import NewObjects, Past, swap_candidates
from stereophd.core.multi.swaps.history import ClaimedDetections, DeferredPairs, History
from stereophd.core.multi.swaps.swap_test import SwapTest
from stereophd.core.numerics.compilation.compiled import compiled

NO_HISTORY = History()


@dataclass(frozen=True)
class PmbFilter(DisparityFilter):
    """The PMB filter; see `DisparityFilter` for its other fields.

    In the state's mixture a label is a track and its weight the existence.
    """

    settings: PmbSettings

    labels_may_split: ClassVar[bool] = False
    update_hypotheses = staticmethod(lambda *of: update_batch(*of[:-1], None, of[-1]))  # type: ignore[call-arg]

    @cached_property
    def reduction(self) -> PmbReduction:
        """Settings of the reduction, for compiled code."""
        settings = self.settings
        return PmbReduction(
            prune_weight=float(settings.prune_weight), merge_distance=float(settings.merge_distance),
            max_components=most_components(settings.max_components),
            hypothesis_distance=float(settings.hypothesis_distance), least_share=float(settings.least_share),
            max_hypotheses=int(settings.max_hypotheses or BY_DETECTIONS),
        )  # fmt: skip

    @cached_property
    def swap_test(self) -> SwapTest:
        """The test for pairs of tracks that are paired crosswise."""
        samples, settings = self.sets.turn(0), self.settings
        return SwapTest(self.rig, self.motion, samples, settings.birth, settings.exchange_above)

    @property
    def last_kernels(self) -> tuple[tuple[Any, tuple[Any, ...]], ...]:
        """See `DisparityFilter`."""
        integers = np.empty(0, dtype=np.int64)
        return (
            (association_marginals, (integers, integers, np.empty(0), 0, 0)),
            (reduce_tracks, (empty_mixture(self.state_size), Existences(integers, np.empty(0)), self.reduction)),
        )

    def compile_tests(self) -> None:
        """Compile the test for pairs of tracks that are paired crosswise."""
        self.swap_test.compile()

    def update(self, state: FilterState, prediction: Prediction, event: Event) -> tuple[FilterState, Info]:
        """Update with the detections of an event (Williams 2015, section IV), then reduction; no tracks are swapped."""
        reduced, *updated = _update(
            prediction.mixture, prediction.moved, *self.detections(event),
            self.event_numbers(state.time_s, event, state.next_label), (prediction.births, prediction.burst),
            self.reduction, self.claims,
        )  # fmt: skip
        counters = state.next_label + len(event.points), state.next_track
        return self._after(state, event, reduced, updated, counters, prediction.undetected, prediction.burst)

    def step(self, state: FilterState, event: Event) -> tuple[FilterState, Info, Estimates]:
        """Predict, update, exchange swapped tracks and extract for one event, in one compiled call."""
        camera = event.camera if self._exchanges else 0
        (between, _, new, tolerance, past, deferred, *numbers), added = self.swap_test.search(
            state.history or NO_HISTORY, camera, event.time_s, state.n_events
        )
        detected, prior = self.detections(event)
        selection, pairs, undetected, burst, *updated = _step(
            tuple(state.mixture), self.prediction(state, event), tuple(detected), tuple(prior), tuple(self.reduction),
            self.claims,
            (between, tuple(new), tolerance, tuple(past), tuple(added), tuple(deferred), *numbers),
            (*self.report, state.next_label + len(event.points), state.next_track), self.sets.turn(state.n_events + 1),
        )  # fmt: skip
        counters = selection.next_label, selection.next_track
        after, info = self._after(state, event, selection.mixture, updated, counters, undetected, burst)
        if not len(pairs):
            return after, info, selection.estimates()
        assert after.history is not None
        mixture, history = self.swap_test.swap(
            after.mixture, after.history, pairs, event.camera, event.time_s, state.n_events
        )
        after = replace(after, mixture=mixture, history=history)
        if mixture is selection.mixture:
            return after, info, selection.estimates()
        # identities are those of the first look: a swap leaves the existence of every track as it is
        after, estimates = self.extract(after)
        return after, replace(info, n_components=mixture.size), estimates

    @cached_property
    def _exchanges(self) -> bool:
        return math.isfinite(self.settings.exchange_above)

    def _after(
        self, state: FilterState, event: Event, mixture: GaussianMixture, updated: Sequence[Any],
        counters: tuple[int, int], undetected: Undetected, burst: int,
    ) -> tuple[FilterState, Info]:  # fmt: skip
        """Return the state after an event of which `_update` returns what it `updated`, and its diagnostics."""
        log_likelihood, forgotten, expected, labels, detections, claims, fewer, undecided = updated
        history, place = None, (event.camera, event.time_s)
        if self._exchanges:
            readings = event.readings(self.rig.space(*place))
            claimed = ClaimedDetections(*place, labels, detections, event.points, event.covariances, readings)
            history = (state.history or NO_HISTORY).add(claimed)
        left_out, room = 0, self.reduction.max_components - len(event.points)
        if state.mixture.size > room:
            left_out = max(len(np.unique(state.mixture.labels)) - room, 0)
        return (
            FilterState(mixture, event.time_s, state.n_events + 1, *counters, undetected, history),
            Info(log_likelihood, expected, mixture.size, labels, claims, left_out, burst, fewer, undecided, forgotten),
        )


@compiled
def _step(
    mixture: Fields,
    given: Fields,
    detected: Fields,
    prior: Fields,
    reduction: Fields,
    with_claims: bool,
    search: Fields,
    report: Fields,
    samples: Array,
) -> tuple[Selection, Integers, Undetected, int, float, float, float, Integers, Integers, Claims | None, int, float]:
    """`predict_event`, `_update`, `swap_candidates` and `select_objects`.

    Returns objects, pairs to be tested for a swap, what is undetected, the burst of clutter, and what `_update` returns
    beside the mixture.
    """
    weights, moved, homes, births, undetected, burst = predict_event(mixture, given)
    numbers, _, _, _, motion, _, views, _, _, _, _, _ = given
    known, predicted, event = GaussianMixture(*mixture), GaussianMixture(weights, *mixture[1:]), EventNumbers(*numbers)
    reduced, log_likelihood, forgotten, expected, found, detections, claims, fewer, undecided = _update(
        predicted, moved, Detections(*detected), FirstSight(*prior), event, (births, burst),
        PmbReduction(*reduction), with_claims
    )  # fmt: skip
    rows = _rows_of(reduced, known, event)
    pairs = np.empty((0, 2), dtype=np.int64)
    between, new, tolerance, past, added, deferred, number, most = search
    if between[1] > 0:
        past = added if len(found) > 0 else past
        pairs = swap_candidates(
            reduced, rows, homes, between, views, NewObjects(*new), tolerance, Past(*past), DeferredPairs(*deferred),
            number, most
        )  # fmt: skip
    selection = select_objects(reduced, Report(*report), rows, homes, MotionArrays(*motion), samples)
    return (
        selection, pairs, undetected, burst, log_likelihood, forgotten, expected, found, detections, claims, fewer,
        undecided
    )  # fmt: skip


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
    stated: PmbReduction,
    with_claims: bool,
) -> tuple[GaussianMixture, float, float, float, Integers, Integers, Claims | None, int, float]:
    """`associate_tracks`, which labels were detected and by which detections, and `reduce_tracks`.

    The numbers are those without births, and `born` has the births and the burst of clutter. The pruning weight is the
    one stated, or that of the births of this event alone: of cameras that take their frames at one time the last
    expects next to none, and may see what no other sees.
    """
    births, burst = born
    event, numbers = with_newborns(detected, prior, mixture.means.shape[1]), with_births(bare, births, burst)
    weight = prune_weight_for_births(stated.prune_weight, births, bare.p_detect, bare.clutter)
    reduction = PmbReduction(weight, *stated[1:])
    outcomes, log_likelihood, forgotten = associate_tracks(mixture, moved, event, numbers, reduction.prune_weight)
    known, weights, made = outcomes.labels, outcomes.weights, outcomes.made
    labels, detections = detected_labels(known, weights, len(mixture.weights), made)
    claims = claims_of(known, weights, len(mixture.weights), made) if with_claims else None
    choice, tracks = choose_hypotheses(outcomes, reduction)
    reduced, expected = reduce_tracks(
        make_components(mixture, moved, event, numbers, outcomes, choice), tracks, reduction
    )  # fmt: skip
    return reduced, log_likelihood, forgotten, expected, labels, detections, claims, choice.left_out, choice.undecided


FILTER = PmbFilter
