"""Which components are reported as objects: thresholds with hysteresis, one estimate per label."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.multi.filter_settings.common import Hysteresis
from stereophd.core.multi.mixture import UNLABELLED, GaussianMixture
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.sorting import picked, places, stable_order

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Selection:
    """Outcome of `select_objects`.

    Attributes
    ----------
    mixture : GaussianMixture
        With new labels and identities.
    index : array (k,) of int
        Components that are reported, in order of identity.
    existence : array (k,)
        Weight or probability of existence of each object.
    tentative : array (k,) of bool
        Which of them are not confirmed.
    next_label, next_track : int
        First unused label and identity.
    """

    mixture: GaussianMixture
    index: Integers
    existence: Array
    tentative: NDArray[np.bool_]
    next_label: int
    next_track: int


def select_objects(
    mixture: GaussianMixture, hysteresis: Hysteresis, next_label: int, next_track: int, split: bool = True
) -> Selection:
    """Choose the components that are reported, and give identities in order of the first report.

    The components of a label are alternatives for one object: their weights add up, and the heaviest
    gives the estimate. A further component of a label that alone reaches the confirmation threshold is
    another object (two objects were merged while they were close), and gets a label of its own.

    Parameters
    ----------
    mixture : GaussianMixture
        After an event.
    hysteresis : Hysteresis
        Thresholds.
    next_label, next_track : int
        First unused label and identity.
    split : bool
        Whether a label may represent several objects, as in a PHD; hypotheses of one track exclude each other.

    Returns
    -------
    Selection
    """
    # filled in place: a compiled function that returns arrays wraps each of them
    count = mixture.size
    labels, tracks, reported = mixture.labels.copy(), mixture.tracks.copy(), mixture.reported.copy()
    index, existence, tentative = np.empty(count, dtype=np.int64), np.empty(count), np.empty(count, dtype=bool)
    found, next_label, next_track = _select(
        mixture.weights,
        mixture.labels,
        hysteresis.confirm,
        hysteresis.release,
        hysteresis.tentative,
        next_label,
        next_track,
        split,
        labels,
        tracks,
        reported,
        index,
        existence,
        tentative,
    )
    relabelled = GaussianMixture(*mixture[:5], labels, tracks, reported)
    return Selection(relabelled, index[:found], existence[:found], tentative[:found], next_label, next_track)


@compiled
def _select(
    weights: Array,
    known: Integers,
    confirm: float,
    release: float,
    tentative: float,
    next_label: int,
    next_track: int,
    split: bool,
    labels: Integers,
    tracks: Integers,
    reported: NDArray[np.bool_],
    index: Integers,
    existence: Array,
    unsure: NDArray[np.bool_],
) -> tuple[int, int, int]:
    """Change labels, identities and flags of the components (n,); return how many are chosen, and both counters.

    The chosen ones, their existence, and whether they are tentative fill the beginnings of the last three arrays (n,),
    in order of identity; `known` holds the labels before.
    """
    order = _by_label(weights, known)
    for k in range(len(labels)):
        if labels[k] == UNLABELLED:
            tracks[k], reported[k] = UNLABELLED, False
    for i in range(1, len(order)):
        k = order[i]
        if split and known[k] == known[order[i - 1]] and weights[k] >= confirm:
            labels[k], tracks[k], reported[k] = next_label, UNLABELLED, False
            next_label += 1
    if split:
        order = picked(order, stable_order(picked(labels, order)))
    found, start = 0, 0
    while start < len(order):
        label, end = labels[order[start]], start
        total, track, was_reported = 0.0, UNLABELLED, False
        while end < len(order) and labels[order[end]] == label:
            # any part of a label may carry its identity: the heaviest may come from a merged newborn
            k = order[end]
            total += weights[k]
            track = max(track, tracks[k])
            was_reported = was_reported or reported[k]
            end += 1
        shown = total >= (release if was_reported else confirm)
        if shown or total >= tentative:
            if track < 0:
                track = next_track
                next_track += 1
            index[found], existence[found], unsure[found] = order[start], total, not shown
            found += 1
        for i in range(start, end):
            tracks[order[i]], reported[order[i]] = track, shown
        start = end
    shown_order = stable_order(picked(tracks, index[:found]))
    by_label, totals, doubts = index[:found].copy(), existence[:found].copy(), unsure[:found].copy()
    for i in range(found):
        place = shown_order[i]
        index[i], existence[i], unsure[i] = by_label[place], totals[place], doubts[place]
    return found, next_label, next_track


@compiled
def _by_label(weights: Array, labels: Integers) -> Integers:
    """Components with a label, by label and then by falling weight; most often they are in this order."""
    order = places(labels != UNLABELLED)
    for i in range(1, len(order)):
        before, k = order[i - 1], order[i]
        if labels[k] < labels[before] or (labels[k] == labels[before] and weights[k] > weights[before]):
            order = picked(order, stable_order(-picked(weights, order)))
            return picked(order, stable_order(picked(labels, order)))
    return order
