"""Gaussian-mixture PHD filter on disparity space (paper VI).

Prediction is the particle move of every component into the disparity space of the event's camera
(VI-B), split by the field of view (VI-C); the update is eq. (5), with births from every detection; the
log-likelihood of an event is that of the conditional filter of VII-B.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stereophd.core.arrays import Integers
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.moved import Moved
from stereophd.core.multi.association.attribution import Claims, claims_of, detected_labels
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction, most_components
from stereophd.core.multi.births.undetected import prune_weight_for_births
from stereophd.core.multi.camera_hypotheses.batch_kernels import update_batch
from stereophd.core.multi.filter_settings.phd import PhdSettings
from stereophd.core.multi.phd.update import PhdReduction, reduce_intensity, update_intensity
from stereophd.core.multi.state.estimates import Info
from stereophd.core.multi.state.inputs import Detections, EventNumbers, with_births, with_newborns
from stereophd.core.multi.state.mixture import GaussianMixture, empty_mixture
from stereophd.core.numerics.compilation.compiled import compiled


@dataclass(frozen=True)
class PhdFilter(DisparityFilter):
    """The PHD filter; see `DisparityFilter` for its other fields."""

    settings: PhdSettings

    update_hypotheses = staticmethod(lambda *given: update_batch(*given, None))  # type: ignore[call-arg]

    @cached_property
    def reduction(self) -> PhdReduction:
        """Settings of the reduction, for compiled code."""
        settings = self.settings
        return PhdReduction(
            prune_weight=float(settings.prune_weight), merge_distance=float(settings.merge_distance),
            max_components=most_components(settings.max_components), by_label=settings.merge_moments == "label",
        )  # fmt: skip

    @property
    def last_kernels(self) -> tuple[tuple[Any, tuple[Any, ...]], ...]:
        """See `DisparityFilter`."""
        return ((reduce_intensity, (empty_mixture(self.state_size), np.empty(0), self.reduction)),)

    def update(self, state: FilterState, prediction: Prediction, event: Event) -> tuple[FilterState, Info]:
        """Update with the detections of an event: eq. (5), then reduction."""
        reduced, log_likelihood, labels, claims, left_out = _update(
            prediction.mixture, prediction.moved, *self.detections(event),
            self.event_numbers(state.time_s, event, state.next_label), (prediction.births, prediction.burst),
            self.reduction, self.claims,
        )  # fmt: skip
        label = state.next_label + len(event.points)
        return (
            FilterState(reduced, event.time_s, state.n_events + 1, label, state.next_track, prediction.undetected),
            Info(
                log_likelihood, float(reduced.weights.sum()), reduced.size, labels, claims, left_out, prediction.burst
            ),
        )


@compiled
def _update(
    mixture: GaussianMixture,
    moved: Moved,
    detected: Detections,
    prior: FirstSight,
    bare: EventNumbers,
    born: tuple[float, int],
    stated: PhdReduction,
    with_claims: bool,
) -> tuple[GaussianMixture, float, Integers, Claims | None, int]:
    """`update_intensity`, which labels were detected and by which detections, and `reduce_intensity`, in one call.

    The numbers are those without births, and `born` has the births and the burst of clutter. The pruning weight is the
    one stated, or that of the births.
    """
    births, burst = born
    event, numbers = with_newborns(detected, prior, mixture.means.shape[1]), with_births(bare, births, burst)
    weight = prune_weight_for_births(stated.prune_weight, births, bare.p_detect, bare.clutter)
    reduction = PhdReduction(weight, *stated[1:])
    updated, log_likelihood, by, shares = update_intensity(mixture, moved, event, numbers, reduction)
    labels, _ = detected_labels(updated.labels, updated.weights, len(mixture.weights), by)
    claims = claims_of(updated.labels, updated.weights, len(mixture.weights), by) if with_claims else None
    reduced, left_out = reduce_intensity(updated, shares, reduction)
    return reduced, log_likelihood, labels, claims, left_out


FILTER = PhdFilter
