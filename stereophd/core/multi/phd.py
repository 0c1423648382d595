"""Gaussian-mixture PHD filter on disparity space (paper VI).

Prediction is the particle move of every component into the disparity space of the event's camera
(VI-B), split by the field of view (VI-C); the update is eq. (5), with births from every detection; the
log-likelihood of an event is that of the conditional filter of VII-B.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.moments import OUT_OF_VIEW
from stereophd.core.motion.base import Motion
from stereophd.core.multi.association import pair_likelihoods
from stereophd.core.multi.attribution import detected_labels
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction, missed_states, updated_components
from stereophd.core.multi.intensity import Info, concatenate
from stereophd.core.multi.kinds.phd import PhdSettings
from stereophd.core.multi.reduce import reduce_mixture
from stereophd.core.numerics.samples import SampleSets

Array = NDArray[np.float64]


@dataclass(frozen=True, init=False)
class PhdFilter(DisparityFilter):
    """The PHD filter; see `DisparityFilter` for `rig`, `motion`, `sets` and `threads`."""

    settings: PhdSettings

    def __init__(self, rig: Rig, motion: Motion, sets: SampleSets, settings: PhdSettings, threads: int = 1) -> None:
        super().__init__(
            rig,
            motion,
            sets,
            settings.survival_per_s,
            settings.out_of_view_s,
            settings.birth,
            settings.extraction,
            threads,
            settings.missed == "split",
        )
        object.__setattr__(self, "settings", settings)

    def update(self, state: FilterState, prediction: Prediction, event: Event) -> tuple[FilterState, Info]:
        """Update with the detections of an event: eq. (5), then reduction."""
        settings, mixture, moved = self.settings, prediction.mixture, prediction.moved
        camera = self.rig.cameras[event.camera]
        p_detect, clutter = camera.detector.p_detect, camera.detector.clutter_per_frame
        per_area = 1.0 / (camera.width * camera.height)
        detected = p_detect * moved.fraction * mixture.weights
        components, detections, densities = pair_likelihoods(
            moved.means,
            moved.covariances,
            moved.status != OUT_OF_VIEW,
            event.points,
            event.covariances,
            event.areas,
            event.delays,
        )
        # clutter, births and components compete for every detection
        born = p_detect * settings.birth.per_frame
        background = (clutter + born) * per_area
        joint = detected[components] * densities
        totals = background + np.bincount(detections, weights=joint, minlength=len(event.points))
        log_likelihood = float(np.log(totals).sum() - clutter - born - detected.sum())
        weights = joint / totals[detections]
        kept = weights >= settings.prune_weight
        missed = missed_states(prediction, event).with_weights(mixture.weights - detected)
        updated = updated_components(prediction, event, components[kept], detections[kept], weights[kept])
        births = self.births(event, np.asarray(born * per_area / totals), state.next_label)
        parts = concatenate([missed, updated, births])
        detected_now = detected_labels(parts.labels, parts.weights, len(missed))
        reduced = reduce_mixture(
            parts,
            settings.prune_weight,
            settings.merge_distance,
            settings.max_components,
            settings.merge_rule == "mutual",
        )
        info = Info(log_likelihood, float(reduced.weights.sum()), len(reduced), detected_now)
        label = state.next_label + len(event.points)
        return FilterState(reduced, event.time_s, state.n_events + 1, label, state.next_track), info
