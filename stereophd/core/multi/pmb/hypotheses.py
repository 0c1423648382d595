"""Hypotheses that an event leaves of labelled tracks: which of them are worth making, and their Gaussians (compiled).

An event gives each hypothesis of a track one that it missed, one for each detection that it may have made, and one new
track a detection. With many objects most of them are negligible. Their weights are known before their Gaussians are
computed, so that only those are made that the reduction keeps.
"""

import math
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import Moved
from stereophd.core.multi.association.likelihoods import kalman_updates
from stereophd.core.multi.state.inputs import EventArrays, EventNumbers
from stereophd.core.multi.state.mixture import UNLABELLED, GaussianMixture, allocate_mixture, fill_missed
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import copy_gaussian, group, largest, picked, places, stable_order

# `max_hypotheses` that stands for a bound by the number of detections: so many a detection, and at least `LEAST_BOUND`.
BY_DETECTIONS = 0
HYPOTHESES_A_DETECTION = 16
LEAST_BOUND = 8192
# Where the bound acts, tracks of a smaller existence than this are recycled.
RECYCLE_BELOW = 0.02


class PmbReduction(NamedTuple):
    """Settings of the reduction: the fields of `PmbSettings` with the same names."""

    prune_weight: float
    recycle_below: float
    merge_distance: float
    max_components: int
    hypothesis_distance: float
    least_share: float
    max_hypotheses: int


class Outcomes(NamedTuple):
    """What an event may make of n components, by c pairs of a component and a detection, and of its m detections."""

    # `labels`, `weights`: Labels and weights of the components that the event missed, of those that it detected, and
    # of one new track for each detection.
    labels: Integers
    weights: Array
    # `owned`, `made`: arrays (c,) of int: Component and detection of each pair.
    owned: Integers
    made: Integers
    # `new_means`, `new_covariances`: arrays (m, d), (m, d, d): Gaussians of the new tracks.
    new_means: Array
    new_covariances: Array


class Existences(NamedTuple):
    """Tracks after an event."""

    names: Integers  # (t,) of int: Labels in rising order, -1 among them
    existence: Array  # (t,): Sum of the weights of the outcomes of each
    recycle_below: float  # Tracks of a smaller existence join the intensity of undetected objects


class ChosenOutcomes(NamedTuple):
    """Outcomes worth making."""

    chosen: Integers  # (k,) of int: Their places among all outcomes, in rising order
    weights: Array  # (k,): Of each
    left_out: int  # Number of others that were worth making but for the bound on hypotheses


@compiled
def choose_hypotheses(outcomes: Outcomes, settings: PmbReduction) -> tuple[ChosenOutcomes, Existences]:
    """Outcomes to keep, in order: those of the most probable tracks that are not a negligible part of their track.

    With them, of the intensity of undetected objects, what is not below the pruning weight; and all tracks. Where they
    are too many, the likeliest are kept (`_likeliest`), and more tracks are recycled.
    """
    prune_weight, least_share = settings.prune_weight, settings.least_share
    labels, weights = outcomes.labels, outcomes.weights
    member, n_groups = group(labels)
    existence = np.zeros(n_groups)
    names = np.empty(n_groups, dtype=np.int64)
    for k in range(len(weights)):
        names[member[k]] = labels[k]
        existence[member[k]] += weights[k]
    _keep_most_probable(existence, names, settings.max_components)
    index = np.empty(len(weights), dtype=np.int64)
    count = 0
    for k in range(len(weights)):
        whole = existence[member[k]]
        worth = weights[k] >= least_share * whole and whole >= prune_weight
        if weights[k] >= prune_weight if labels[k] == UNLABELLED else worth:
            index[count] = k
            count += 1
    most = settings.max_hypotheses
    if most == BY_DETECTIONS:
        most = max(LEAST_BOUND, HYPOTHESES_A_DETECTION * len(outcomes.new_means))
    if count <= most:
        index = index[:count]
        return ChosenOutcomes(index, picked(weights, index), 0), Existences(names, existence, settings.recycle_below)
    recycle_below = max(settings.recycle_below, RECYCLE_BELOW)
    return _likeliest(outcomes, index[:count], member, n_groups, most), Existences(names, existence, recycle_below)


@compiled
def _likeliest(outcomes: Outcomes, index: Integers, member: Integers, n_groups: int, most: int) -> ChosenOutcomes:
    """Return the heaviest of the outcomes with these indices.

    A detection that a hypothesis does not get remains undecided for it: its weight goes to the hypothesis as if the
    event had missed it, which is as broad as before. Of every track the heaviest outcome stays.
    """
    weights = outcomes.weights.copy()
    n_pairs = len(outcomes.made)
    n_components = len(weights) - n_pairs - len(outcomes.new_means)
    heaviest = largest(picked(weights, index), most)
    kept = np.zeros(len(weights), dtype=np.bool_)
    lightest = math.inf
    for i in range(len(index)):
        if heaviest[i]:
            kept[index[i]] = True
            lightest = min(lightest, weights[index[i]])
    for i in range(len(index)):
        k = index[i]
        if not heaviest[i] and n_components <= k < n_components + n_pairs:
            weights[outcomes.owned[k - n_components]] += weights[k]
    heads = np.full(n_groups, -1)
    for k in range(len(weights)):
        # with what it got, a missed hypothesis may be one of the heaviest
        kept[k] = kept[k] or (k < n_components and weights[k] >= lightest)
    for k in index:
        head = heads[member[k]]
        if head < 0 or weights[k] > weights[head]:
            heads[member[k]] = k
    for head in heads:
        if head >= 0:
            kept[head] = True
    left_out = 0
    for k in index:
        left_out += 0 if kept[k] else 1
    chosen = places(kept)
    return ChosenOutcomes(chosen, picked(weights, chosen), left_out)


@compiled
def _keep_most_probable(existence: Array, names: Integers, max_tracks: int) -> None:
    """Set the existence of all but the most probable tracks to 0."""
    if len(existence) <= max_tracks:
        return
    found = 0
    for g in stable_order(-existence):
        if names[g] != UNLABELLED:
            found += 1
            if found > max_tracks:
                existence[g] = 0.0


@compiled
def make_hypotheses(
    mixture: GaussianMixture,
    moved: Moved,
    event: EventArrays,
    numbers: EventNumbers,
    outcomes: Outcomes,
    choice: ChosenOutcomes,
) -> GaussianMixture:
    """Return the chosen outcomes as components; the other parameters are those of `associate_tracks`."""
    chosen = choice.chosen
    out = allocate_mixture(len(chosen), mixture.means.shape[1])
    to_weights, to_means, to_covariances, cameras, times, labels, tracks, reported = out
    count, n_pairs = len(mixture.weights), len(outcomes.made)
    missed = int(np.searchsorted(chosen, count))
    detected = int(np.searchsorted(chosen, count + n_pairs))
    pairs = chosen[missed:detected] - count
    owned = picked(outcomes.owned, pairs)
    known_tracks, known_reported = mixture.tracks, mixture.reported
    for i in range(len(chosen)):
        to_weights[i], labels[i] = choice.weights[i], outcomes.labels[chosen[i]]
        if i < detected:
            origin = chosen[i] if i < missed else owned[i - missed]
            tracks[i], reported[i] = known_tracks[origin], known_reported[origin]
    for i in range(missed, len(chosen)):
        cameras[i], times[i] = numbers.camera, numbers.time_s
    fill_missed(mixture, moved, chosen[:missed], numbers, out)
    means, covariances, rows = kalman_updates(
        moved.means, moved.covariances, owned, picked(outcomes.made, pairs), event.points, event.noises, event.readings
    )
    for i in range(len(owned)):
        for a in range(means.shape[1]):
            to_means[missed + i, a] = means[i, a]
            for b in range(means.shape[1]):
                to_covariances[missed + i, a, b] = covariances[rows[i], a, b]
    for i in range(detected, len(chosen)):
        j = chosen[i] - count - n_pairs
        copy_gaussian(outcomes.new_means, outcomes.new_covariances, j, to_means, to_covariances, i)
    return out
