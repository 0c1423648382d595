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
from typing import Any, ClassVar

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.moved import Moved
from stereophd.core.multi.association.attribution import Claims, claims_of, detected_labels
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.association.likelihoods import FEW_COMPONENTS
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction, most_components
from stereophd.core.multi.births.undetected import peak_births, reduction_for_births, reduction_in_crowd
from stereophd.core.multi.camera_hypotheses.batch_kernels import update_track_sets
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
from stereophd.core.multi.state.estimates import Info
from stereophd.core.multi.state.inputs import Detections, EventNumbers, with_newborns
from stereophd.core.multi.state.mixture import UNLABELLED, GaussianMixture, empty_mixture
from stereophd.core.multi.swaps.history import ClaimedDetections, History
from stereophd.core.multi.swaps.swap_test import SwapTest
from stereophd.core.numerics.compilation.compiled import compiled


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
        detector = self.rig.cameras[event.camera].detector
        reduction = reduction_for_births(self.reduction, prediction.births, detector)
        if prediction.mixture.size > FEW_COMPONENTS:
            peak = peak_births(state.undetected, prediction.births, event.camera)
            reduction = reduction_in_crowd(reduction, peak, detector, prediction.mixture.weights)
        detected, prior = self.detections(event)
        reduced, log_likelihood, expected, labels, detections, claims, fewer = _update(
            prediction.mixture, prediction.moved, detected, prior,
            self.event_numbers(event, state.next_label, prediction.births, prediction.burst), reduction, self.claims
        )  # fmt: skip
        history = state.history
        if math.isfinite(self.settings.exchange_above):
            claimed = ClaimedDetections(
                event.camera, event.time_s, labels, detections, event.points, event.covariances, detected.readings
            )
            history = (history or History()).add(claimed)
            reduced, history = self.swap_test.put_right(reduced, history, event.camera, event.time_s, state.n_events)
        label = state.next_label + len(event.points)
        left_out, room = 0, self.reduction.max_components - len(event.points)
        if prediction.mixture.size > room:
            tracks = np.unique(prediction.mixture.labels)
            left_out = max(int(np.count_nonzero(tracks != UNLABELLED)) - room, 0)
        return (
            FilterState(
                reduced, event.time_s, state.n_events + 1, label, state.next_track, prediction.undetected, history
            ),
            Info(log_likelihood, expected, reduced.size, labels, claims, left_out, prediction.burst, fewer),
        )


@compiled
def _update(
    mixture: GaussianMixture,
    moved: Moved,
    detected: Detections,
    prior: FirstSight,
    numbers: EventNumbers,
    reduction: PmbReduction,
    with_claims: bool,
) -> tuple[GaussianMixture, float, float, Integers, Integers, Claims | None, int]:
    """`associate_tracks`, which labels were detected and by which detections, and `reduce_tracks`, in one call."""
    event = with_newborns(detected, prior, mixture.means.shape[1])
    outcomes, log_likelihood = associate_tracks(mixture, moved, event, numbers, reduction.prune_weight)
    known, weights, made = outcomes.labels, outcomes.weights, outcomes.made
    labels, detections = detected_labels(known, weights, len(mixture.weights), made)
    claims = claims_of(known, weights, len(mixture.weights), made) if with_claims else None
    choice, tracks = choose_hypotheses(outcomes, reduction)
    reduced, expected = reduce_tracks(
        make_hypotheses(mixture, moved, event, numbers, outcomes, choice), tracks, reduction
    )  # fmt: skip
    return reduced, log_likelihood, expected, labels, detections, claims, choice.left_out


FILTER = PmbFilter
