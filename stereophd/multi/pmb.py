"""Poisson multi-Bernoulli filter on disparity space: labelled tracks.

The track-oriented marginal filter (Williams 2015): each track is a Bernoulli component, a probability
of existence and one Gaussian; association marginals by loopy belief propagation; objects that were
never detected are a Poisson intensity, uniform over the image (the observation-driven birth of the PHD
filter), to which tracks that became improbable are recycled. The log-likelihood of an event is the
Bethe value of its association problem: smooth in the camera poses, as calibration needs it.

Reference: J. L. Williams, "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA and
association-based MeMBer", IEEE Trans. AES 51 (3), 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.compilation import compiled
from stereophd.disparity.moments import IN_VIEW, OUT_OF_VIEW
from stereophd.disparity.samples import SampleSets
from stereophd.motion import Motion
from stereophd.multi.association import kalman_updates, pair_likelihoods
from stereophd.multi.base import DisparityFilter, FilterState, Prediction, missed_states
from stereophd.multi.belief import association_marginals
from stereophd.multi.birth import BirthPrior
from stereophd.multi.events import Event, Rig
from stereophd.multi.extract import Hysteresis
from stereophd.multi.intensity import UNLABELLED, GaussianMixture, Info, concatenate
from stereophd.multi.reduce import merge_sorted

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# A track that must have been detected (certain, in view, detection probability 1) may still be missed
# with this probability: odds stay finite.
LEAST_MISSED = 1e-9
# Hypotheses of a smaller share than this are left out of the Gaussian of a track.
LEAST_SHARE = 1e-4


@dataclass(frozen=True)
class PmbSettings:
    """Parameters of the filter.

    Attributes
    ----------
    survival_per_s : float
        Probability that an object survives one second.
    birth : BirthPrior
        Prior of new objects.
    recycle_below : float
        Tracks of a smaller existence become part of the intensity of undetected objects.
    prune_weight : float
        Components of that intensity below this weight are dropped.
    merge_distance : float
        Squared Mahalanobis distance, in the covariances of both, below which two tracks are one object.
    max_components : int
        The most probable tracks are kept.
    hysteresis : Hysteresis
        Which tracks are reported.
    """

    survival_per_s: float
    birth: BirthPrior
    recycle_below: float = 1e-3
    prune_weight: float = 1e-4
    merge_distance: float = 4.0
    max_components: int = 1000
    hysteresis: Hysteresis = field(default_factory=lambda: Hysteresis(0.9, 0.02))


@dataclass(frozen=True, init=False)
class PmbFilter(DisparityFilter):
    """The PMB filter; see `DisparityFilter` for `rig`, `motion`, `sets` and `threads`.

    In the state's mixture a label is a track and its weight the existence; components labelled -1 are
    the intensity of undetected objects.
    """

    settings: PmbSettings

    def __init__(self, rig: Rig, motion: Motion, sets: SampleSets, settings: PmbSettings, threads: int = 1) -> None:
        super().__init__(rig, motion, sets, settings.survival_per_s, settings.birth, settings.hysteresis, threads)
        object.__setattr__(self, "settings", settings)

    def update(self, state: FilterState, prediction: Prediction, event: Event) -> tuple[FilterState, Info]:
        """Update with the detections of an event (Williams 2015, section IV), then reduction."""
        mixture, moved = prediction.mixture, prediction.moved
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
        )
        labelled = mixture.labels != UNLABELLED
        claims = labelled[components]
        joint = detected[components] * densities
        n_detections = len(event.points)
        # the first detection of an object: of one that is unknown so far, or of a recycled track
        birth = p_detect * self.birth.per_frame * per_area
        recycled = joint[~claims]
        first = birth + np.bincount(detections[~claims], weights=recycled, minlength=n_detections)
        unclaimed_density = clutter * per_area + first
        missed = np.where(labelled, np.maximum(1.0 - detected, LEAST_MISSED), 1.0)
        tracks, targets = components[claims], detections[claims]
        odds = joint[claims] / (missed[tracks] * unclaimed_density[targets])
        share, untouched, unclaimed, log_bethe = association_marginals(
            tracks, targets, odds, len(mixture), n_detections
        )
        log_likelihood = float(
            log_bethe
            + np.log(unclaimed_density).sum()
            + np.log(missed).sum()
            - clutter
            - p_detect * self.birth.per_frame
            - detected[~labelled].sum()
        )
        # existence without a detection in this event; for the intensity, its undetected part
        still = np.where(labelled, untouched * (mixture.weights - detected) / missed, mixture.weights - detected)
        old = _mix_tracks(prediction, event, still, tracks, targets, share)
        existence = np.asarray(unclaimed * first / unclaimed_density)
        sources = (components[~claims], detections[~claims], recycled / first[detections[~claims]])
        new = self._first_detections(state, prediction, event, existence, np.asarray(birth / first), sources)
        reduced = self._reduce(concatenate([old, new]))
        tracked = reduced.labels != UNLABELLED
        info = Info(log_likelihood, float(reduced.weights[tracked].sum()), len(reduced))
        label = state.next_label + n_detections
        return FilterState(reduced, event.time_s, state.n_events + 1, label, state.next_track), info

    def _first_detections(
        self,
        state: FilterState,
        prediction: Prediction,
        event: Event,
        existence: Array,
        born: Array,
        sources: tuple[Integers, Integers, Array],
    ) -> GaussianMixture:
        """Tracks of objects detected for the first time: born now, or recycled before."""
        newborn = self.births(event, existence, state.next_label)
        components, detections, weights = sources
        kept = (weights > LEAST_SHARE) & (existence[detections] >= self.settings.prune_weight)
        if not kept.any():
            return newborn
        means, covariances = _mix_pairs(
            prediction, event, components[kept], detections[kept], weights[kept], detections[kept],
            born, newborn.means, newborn.covariances,
        )  # fmt: skip
        return replace(newborn, means=means, covariances=covariances)

    def _reduce(self, mixture: GaussianMixture) -> GaussianMixture:
        """Recycle improbable tracks, drop what is negligible, merge tracks of one object."""
        settings = self.settings
        weights = mixture.weights
        labels = np.where(weights < settings.recycle_below, UNLABELLED, mixture.labels)
        tracked = labels != UNLABELLED
        # an identity once reported counts more than existence, and of two the older keeps its name
        seniority = np.where(mixture.tracks >= 0, mixture.tracks, np.iinfo(np.int64).max)
        found = np.flatnonzero(tracked)
        if len(found) > settings.max_components:
            found = found[np.argsort(-weights[found], kind="stable")[: settings.max_components]]
        found = found[np.lexsort((-weights[found], seniority[found]))]
        rest = np.flatnonzero(~tracked & (weights >= settings.prune_weight))
        mixture = replace(mixture, labels=labels).take(np.concatenate([found, rest]))
        return _merge_tracks(mixture, len(found), settings.merge_distance)


def _merge_tracks(mixture: GaussianMixture, count: int, distance: float) -> GaussianMixture:
    """Merge those of the first `count` components that have come to describe one object.

    The first of them gives the identity.
    """
    if count < 2 or distance <= 0.0:
        return mixture
    weights, means, covariances, leaders = merge_sorted(
        mixture.weights[:count],
        mixture.means[:count],
        mixture.covariances[:count],
        mixture.cameras[:count],
        mixture.times[:count],
        distance,
        True,
    )
    if len(leaders) == count:
        return mixture
    merged = replace(mixture.take(leaders), weights=np.minimum(weights, 1.0), means=means, covariances=covariances)
    return concatenate([merged, mixture.take(np.arange(count, len(mixture)))])


def _mix_tracks(
    prediction: Prediction, event: Event, still: Array, tracks: Integers, targets: Integers, share: Array
) -> GaussianMixture:
    """Tracks after the association: existence, and one Gaussian for all hypotheses of each.

    A track wholly in view is mixed in the event's space. One partly in view that was more probably
    missed keeps the Gaussian of its missed part, at home; else that of its detected part.
    """
    moved = prediction.moved
    claimed = np.bincount(tracks, weights=share, minlength=len(still))
    missed = missed_states(prediction, event)
    here = (moved.status == IN_VIEW) | (claimed > still)
    kept = here[tracks] & (share > LEAST_SHARE * (claimed + still)[tracks])
    base = np.where(moved.status == IN_VIEW, still, 0.0)
    means, covariances = _mix_pairs(
        prediction, event, tracks[kept], targets[kept], share[kept], tracks[kept],
        base, missed.means, missed.covariances,
    )  # fmt: skip
    return replace(
        missed,
        weights=np.minimum(still + claimed, 1.0),
        means=means,
        covariances=covariances,
        cameras=np.where(here, event.camera, missed.cameras),
        times=np.where(here, event.time_s, missed.times),
    )


def _mix_pairs(
    prediction: Prediction,
    event: Event,
    components: Integers,
    detections: Integers,
    weights: Array,
    groups: Integers,
    base_weights: Array,
    base_means: Array,
    base_covariances: Array,
) -> tuple[Array, Array]:
    """One Gaussian a group: a base Gaussian mixed with Kalman updates of pairs (moment matching)."""
    moved = prediction.moved
    means, covariances = kalman_updates(
        moved.means, moved.covariances, components, detections, event.points, event.covariances
    )
    return mix_gaussians(groups, weights, means, covariances, base_weights, base_means, base_covariances)


@compiled
def mix_gaussians(
    groups: Integers,
    weights: Array,
    means: Array,
    covariances: Array,
    base_weights: Array,
    base_means: Array,
    base_covariances: Array,
) -> tuple[Array, Array]:
    """Moment-match, group by group, Gaussians (p) with a base Gaussian (g) of weight >= 0.

    Returns means (g, d) and covariances (g, d, d); a group without members keeps its base.
    """
    out_means = base_means.copy()
    out_covariances = base_covariances.copy()
    size = base_means.shape[1]
    totals = base_weights.copy()
    members = np.zeros(len(base_weights), dtype=np.int64)
    for p in range(len(groups)):
        totals[groups[p]] += weights[p]
        members[groups[p]] += 1
    for g in range(len(base_weights)):
        if members[g] > 0:
            part = base_weights[g] / totals[g]
            for a in range(size):
                out_means[g, a] *= part
                for b in range(size):
                    out_covariances[g, a, b] *= part
    for p in range(len(groups)):
        g = groups[p]
        for a in range(size):
            out_means[g, a] += weights[p] / totals[g] * means[p, a]
    for g in range(len(base_weights)):
        if members[g] > 0 and base_weights[g] > 0.0:
            part = base_weights[g] / totals[g]
            for a in range(size):
                for b in range(size):
                    out_covariances[g, a, b] += (
                        part * (base_means[g, a] - out_means[g, a]) * (base_means[g, b] - out_means[g, b])
                    )
    for p in range(len(groups)):
        g = groups[p]
        part = weights[p] / totals[g]
        for a in range(size):
            for b in range(size):
                spread = (means[p, a] - out_means[g, a]) * (means[p, b] - out_means[g, b])
                out_covariances[g, a, b] += part * (covariances[p, a, b] + spread)
    return out_means, out_covariances
