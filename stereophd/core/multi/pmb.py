"""Poisson multi-Bernoulli filter on disparity space: labelled tracks.

The track-oriented marginal filter (Williams 2015): each track is a Bernoulli component, a probability of
existence and a mixture of the hypotheses that the data have not decided yet (most often one Gaussian: the
pairing of detections of two cameras on one epipolar line stays open for a while); association marginals exactly,
cluster by cluster, and by loopy belief propagation for clusters too large; objects that were never detected are a
Poisson intensity, uniform over the image (the observation-driven birth of the PHD filter), to which tracks that
became improbable are recycled. The log-likelihood of an event is the value of its association problem.

Reference: J. L. Williams, "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA and
association-based MeMBer", IEEE Trans. AES 51 (3), 2015.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.kernels import MovedArrays
from stereophd.core.motion.base import Motion
from stereophd.core.multi.attribution import detected_labels
from stereophd.core.multi.base import DisparityFilter, FilterState, Prediction
from stereophd.core.multi.birth import birth_moments
from stereophd.core.multi.intensity import GaussianMixture, Info, Parts
from stereophd.core.multi.kinds.pmb import PmbSettings
from stereophd.core.multi.pmb_reduce import reduce_tracks
from stereophd.core.multi.pmb_update import update_tracks
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.samples import SampleSets

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, init=False)
class PmbFilter(DisparityFilter):
    """The PMB filter; see `DisparityFilter` for `rig`, `motion`, `sets` and `threads`.

    In the state's mixture a label is a track and its weight the existence; components labelled -1 are
    the intensity of undetected objects.
    """

    settings: PmbSettings

    labels_may_split: ClassVar[bool] = False

    def __init__(self, rig: Rig, motion: Motion, sets: SampleSets, settings: PmbSettings, threads: int = 1) -> None:
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
        """Update with the detections of an event (Williams 2015, section IV), then reduction."""
        mixture, settings = prediction.mixture, self.settings
        camera = self.rig.cameras[event.camera]
        detector = camera.detector
        newborn_means, newborn_covariances = birth_moments(
            event, self.rig.space(event.camera, event.time_s), self.birth, self.state_size
        )
        parts, log_likelihood, detected, expected = _update(
            mixture.parts,
            prediction.moved.arrays,
            event.points,
            event.covariances,
            event.areas,
            event.delays,
            newborn_means,
            newborn_covariances,
            (event.camera, event.time_s, state.next_label),
            (
                float(detector.p_detect),
                float(detector.clutter_per_frame),
                float(self.birth.per_frame),
                float(camera.width * camera.height),
            ),
            (
                settings.recycle_below,
                settings.prune_weight,
                settings.merge_distance,
                settings.max_components,
                settings.hypothesis_distance,
                settings.least_share,
            ),
        )
        reduced = GaussianMixture(*parts)
        label = state.next_label + len(event.points)
        return (
            FilterState(reduced, event.time_s, state.n_events + 1, label, state.next_track),
            Info(log_likelihood, expected, len(reduced), detected),
        )


@compiled
def _update(
    parts: Parts,
    moved: MovedArrays,
    points: Array,
    noises: Array,
    areas: Array,
    delays: Array | None,
    newborn_means: Array,
    newborn_covariances: Array,
    place: tuple[int, float, int],
    rates: tuple[float, float, float, float],
    reduction: tuple[float, float, float, int, float, float],
) -> tuple[Parts, float, Integers, float]:
    """`update_tracks`, which labels were detected, and `reduce_tracks` (parameters: theirs), in one call."""
    n_missed = len(parts[0])
    parts, log_likelihood = update_tracks(
        parts, moved, points, noises, areas, delays, newborn_means, newborn_covariances, place, rates, reduction[1]
    )
    detected = detected_labels(parts[5], parts[0], n_missed)
    parts, expected = reduce_tracks(
        parts, reduction[0], reduction[1], reduction[2], reduction[3], reduction[4], reduction[5]
    )
    return parts, log_likelihood, detected, expected
