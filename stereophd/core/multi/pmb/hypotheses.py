"""Hypotheses that an event leaves of labelled tracks: which of them are worth making (compiled).

An event gives each hypothesis of a track one that it missed, one for each detection that it may have made, and one new
track a detection. With many objects most of them are negligible. Their weights are known before their Gaussians are
computed, so that only those are made that the reduction keeps.
"""

import math
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.multi.state.outcomes import ChosenOutcomes, Outcomes
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import group, largest, picked, places, stable_order

# `max_hypotheses` that stands for a bound by the number of detections: so many a detection, and at least `LEAST_BOUND`.
BY_DETECTIONS = 0
HYPOTHESES_A_DETECTION = 16
LEAST_BOUND = 8192


class PmbReduction(NamedTuple):
    """Settings of the reduction: the fields of `PmbSettings` with the same names."""

    prune_weight: float
    merge_distance: float
    max_components: int
    hypothesis_distance: float
    least_share: float
    max_hypotheses: int


class Existences(NamedTuple):
    """Tracks after an event."""

    names: Integers  # (t,) of int: Labels in rising order
    existence: Array  # (t,): Sum of the weights of the outcomes of each


@compiled
def choose_hypotheses(outcomes: Outcomes, settings: PmbReduction) -> tuple[ChosenOutcomes, Existences]:
    """Outcomes to keep, in order: those of the most probable tracks that are not a negligible part of their track.

    Where they are too many, the likeliest are kept (`_likeliest`). With them all tracks are returned.
    """
    prune_weight, least_share = settings.prune_weight, settings.least_share
    labels, weights = outcomes.labels, outcomes.weights
    member, n_groups = group(labels)
    existence = np.zeros(n_groups)
    names = np.empty(n_groups, dtype=np.int64)
    for k in range(len(weights)):
        names[member[k]] = labels[k]
        existence[member[k]] += weights[k]
    _keep_most_probable(existence, settings.max_components)
    existence[existence < prune_weight] = 0.0
    index = np.empty(len(weights), dtype=np.int64)
    count = 0
    for k in range(len(weights)):
        whole = existence[member[k]]
        if weights[k] >= least_share * whole and whole > 0.0:
            index[count] = k
            count += 1
    most = settings.max_hypotheses
    if most == BY_DETECTIONS:
        most = max(LEAST_BOUND, HYPOTHESES_A_DETECTION * len(outcomes.new_means))
    if count <= most:
        index = index[:count]
        return ChosenOutcomes(index, picked(weights, index), 0, 0.0), Existences(names, existence)
    return _likeliest(outcomes, index[:count], member, existence, most), Existences(names, existence)


@compiled
def _likeliest(outcomes: Outcomes, index: Integers, member: Integers, existence: Array, most: int) -> ChosenOutcomes:
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
    heads = np.full(len(existence), -1)
    for k in range(len(weights)):
        # with what it got, a missed hypothesis may be one of the heaviest
        kept[k] = kept[k] or (k < n_components and weights[k] >= lightest and existence[member[k]] > 0.0)
    for k in index:
        head = heads[member[k]]
        if head < 0 or weights[k] > weights[head]:
            heads[member[k]] = k
    for head in heads:
        if head >= 0:
            kept[head] = True
    left_out, undecided = 0, 0.0
    for k in index:
        if not kept[k]:
            left_out += 1
            # one of many that are as probable would hardly have moved its track
            undecided += outcomes.weights[k] ** 2 / existence[member[k]]
    chosen = places(kept)
    return ChosenOutcomes(chosen, picked(weights, chosen), left_out, undecided)


@compiled
def _keep_most_probable(existence: Array, max_tracks: int) -> None:
    """Set the existence of all but the most probable tracks to 0."""
    if len(existence) > max_tracks:
        for g in stable_order(-existence)[max_tracks:]:
            existence[g] = 0.0
