"""Poisson multi-Bernoulli filter on disparity space: labelled tracks.

The track-oriented marginal filter (Williams 2015): each track is a Bernoulli component, a probability of
existence and a mixture of the hypotheses that the data have not decided yet (most often one Gaussian: the
pairing of detections of two cameras on one epipolar line stays open for a while); association marginals by
loopy belief propagation; objects that were never detected are a Poisson intensity, uniform over the image
(the observation-driven birth of the PHD filter), to which tracks that became improbable are recycled. The
log-likelihood of an event is the Bethe value of its association problem.

Reference: J. L. Williams, "Marginal multi-Bernoulli filters: RFS derivation of MHT, JIPDA and
association-based MeMBer", IEEE Trans. AES 51 (3), 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stereophd.compilation import compiled
from stereophd.disparity.moments import OUT_OF_VIEW
from stereophd.disparity.samples import SampleSets
from stereophd.motion import Motion
from stereophd.multi.association import kalman_updates, pair_likelihoods
from stereophd.multi.attribution import detected_labels
from stereophd.multi.base import DisparityFilter, FilterState, Prediction, missed_states, updated_components
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
# A track is never more certain than this: at existence 1 no number of misses could end it.
MOST_EXISTENCE = 1.0 - 1e-9
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
    hypothesis_distance : float
        Squared Mahalanobis distance, in the covariances of both, below which two hypotheses of a track merge;
        infinity for one Gaussian a track in each camera's space.
    least_share : float
        Hypotheses of a smaller share of their track are dropped.
    hysteresis : Hysteresis
        Which tracks are reported.
    """

    survival_per_s: float
    birth: BirthPrior
    recycle_below: float = 1e-3
    prune_weight: float = 1e-4
    merge_distance: float = 4.0
    max_components: int = 1000
    hypothesis_distance: float = 4.0
    least_share: float = 1e-3
    hysteresis: Hysteresis = field(default_factory=lambda: Hysteresis(0.95, 0.01))


@dataclass(frozen=True, init=False)
class PmbFilter(DisparityFilter):
    """The PMB filter; see `DisparityFilter` for `rig`, `motion`, `sets` and `threads`.

    In the state's mixture a label is a track and its weight the existence; components labelled -1 are
    the intensity of undetected objects.
    """

    settings: PmbSettings

    labels_may_split: ClassVar[bool] = False

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
        n_detections = len(event.points)
        labelled = mixture.labels != UNLABELLED
        claims = labelled[components]
        joint = detected[components] * densities
        # the first detection of an object: of one that is unknown so far, or of a recycled track
        birth = p_detect * self.birth.per_frame * per_area
        recycled = joint[~claims]
        first = birth + np.bincount(detections[~claims], weights=recycled, minlength=n_detections)
        unclaimed_density = clutter * per_area + first
        # the components of a label are alternatives for one track, which claims a detection as a whole
        labels, member = np.unique(mixture.labels, return_inverse=True)
        tracks, targets = components[claims], detections[claims]
        pairs, pair = np.unique(member[tracks] * n_detections + targets, return_inverse=True)
        claim = np.bincount(pair, weights=joint[claims], minlength=len(pairs))
        owners, wanted = pairs // max(n_detections, 1), pairs % max(n_detections, 1)
        seen = np.bincount(member, weights=detected, minlength=len(labels))
        missed = np.where(labels != UNLABELLED, np.maximum(1.0 - seen, LEAST_MISSED), 1.0)
        odds = claim / (missed[owners] * unclaimed_density[wanted])
        share, untouched, unclaimed, log_bethe = association_marginals(owners, wanted, odds, len(labels), n_detections)
        log_likelihood = float(
            log_bethe
            + np.log(unclaimed_density).sum()
            + np.log(missed).sum()
            - clutter
            - p_detect * self.birth.per_frame
            - detected[~labelled].sum()
        )
        # weights without a detection in this event, and with each
        still = (mixture.weights - detected) * np.where(labelled, (untouched / missed)[member], 1.0)
        taken = share[pair] * joint[claims] / claim[pair]
        kept = taken >= LEAST_SHARE * self.settings.prune_weight
        updated = updated_components(prediction, event, tracks[kept], targets[kept], taken[kept])
        existence = np.asarray(unclaimed * first / unclaimed_density)
        sources = (components[~claims], detections[~claims], recycled / first[detections[~claims]])
        new = self._first_detections(state, prediction, event, existence, np.asarray(birth / first), sources)
        parts = concatenate([missed_states(prediction, event).with_weights(still), updated, new])
        detected_now = detected_labels(parts.labels, parts.weights, len(mixture))
        reduced = self._reduce(parts)
        tracked = reduced.labels != UNLABELLED
        info = Info(log_likelihood, float(reduced.weights[tracked].sum()), len(reduced), detected_now)
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
        """Drop negligible hypotheses, merge those that agree, recycle improbable tracks."""
        settings, n_cameras = self.settings, len(self.rig.cameras)
        unknown = np.flatnonzero((mixture.labels == UNLABELLED) & (mixture.weights >= settings.prune_weight))
        undetected = mixture.take(unknown)
        mixture = mixture.take(np.flatnonzero(mixture.labels != UNLABELLED))
        labels, member = np.unique(mixture.labels, return_inverse=True)
        existence = np.bincount(member, weights=mixture.weights, minlength=len(labels))
        tracked = existence >= settings.recycle_below
        if tracked.sum() > settings.max_components:
            ranked = np.argsort(-existence, kind="stable")
            existence[ranked[settings.max_components :]] = 0.0
            tracked &= existence > 0.0
        whole = existence[member]
        kept = np.flatnonzero((mixture.weights >= settings.least_share * whole) & (whole >= settings.prune_weight))
        # what is dropped of a track goes to its other hypotheses: existence stays
        remains = np.bincount(member[kept], weights=mixture.weights[kept], minlength=len(labels))
        scale = np.minimum(existence, MOST_EXISTENCE) / np.maximum(remains, np.finfo(float).tiny)
        mixture = mixture.with_weights(mixture.weights * scale[member])
        order = kept[np.argsort(-mixture.weights[kept], kind="stable")]
        hypotheses = _merge_hypotheses(mixture.take(order), settings.hypothesis_distance, n_cameras)
        held = np.isin(hypotheses.labels, labels[tracked])
        weak = hypotheses.take(np.flatnonzero(~held & (hypotheses.weights >= settings.prune_weight)))
        weak = replace(weak, labels=np.full(len(weak), UNLABELLED))
        certain = hypotheses.take(np.flatnonzero(held))
        tracks = _merge_tracks(certain, settings.merge_distance)
        if tracks is not certain:
            tracks = _merge_hypotheses(tracks, settings.hypothesis_distance, n_cameras)
        return concatenate([tracks, undetected, weak])


def _merge_hypotheses(tracks: GaussianMixture, distance: float, n_cameras: int) -> GaussianMixture:
    """Merge hypotheses of one track that agree; components in order of falling weight."""
    # as charts are told apart by camera and time, so are tracks
    chart = tracks.labels * n_cameras + tracks.cameras
    weights, means, covariances, leaders = merge_sorted(
        tracks.weights, tracks.means, tracks.covariances, chart, tracks.times, distance, True
    )
    return replace(tracks.take(leaders), weights=weights, means=means, covariances=covariances)


def _merge_tracks(tracks: GaussianMixture, distance: float) -> GaussianMixture:
    """Give tracks whose heaviest hypotheses have come to agree one label: of two identities the older."""
    _, first = np.unique(tracks.labels, return_index=True)
    if len(first) < 2 or distance <= 0.0:
        return tracks
    # an identity once reported counts more than existence, and of two the older keeps its name
    seniority = np.where(tracks.tracks[first] >= 0, tracks.tracks[first], np.iinfo(np.int64).max)
    first = first[np.lexsort((-tracks.weights[first], seniority))]
    heads = tracks.take(first)
    leaders = merge_sorted(heads.weights, heads.means, heads.covariances, heads.cameras, heads.times, distance, True)[3]
    if len(leaders) == len(first):
        return tracks
    return _join(tracks, heads, leaders, distance)


def _join(tracks: GaussianMixture, heads: GaussianMixture, leaders: Integers, distance: float) -> GaussianMixture:
    """Give every track that is no leader the label of the first leader that its head agrees with."""
    labels, identities, reported = tracks.labels.copy(), tracks.tracks.copy(), tracks.reported.copy()
    for junior in np.setdiff1d(np.arange(len(heads)), leaders):
        for senior in leaders[leaders < junior]:
            both = heads.take(np.array([senior, junior]))
            found = merge_sorted(
                both.weights, both.means, both.covariances, both.cameras, both.times, distance, True
            )  # fmt: skip
            if len(found[0]) == 1:
                moved = labels == heads.labels[junior]
                labels[moved] = heads.labels[senior]
                identities[moved], reported[moved] = heads.tracks[senior], heads.reported[senior]
                break
    _, member = np.unique(labels, return_inverse=True)
    existence = np.bincount(member, weights=tracks.weights)
    weights = tracks.weights / np.maximum(existence, 1.0)[member]
    return replace(tracks, weights=weights, labels=labels, tracks=identities, reported=reported)


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
