"""Which tracks an event detected, and by which detections."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.sorting import stable_order

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class Claims(NamedTuple):
    """Which labels the detections of an event belong to, with which probability.

    Attributes
    ----------
    labels : array (n,) of int
        Several rows of one label and detection are alternatives: their probabilities add up.
    detections : array (n,) of int
        Rows of the event's detections.
    probabilities : array (n,)
        That the object of the label exists and made the detection (in a PHD, the expected number of such objects).
        What is missing to 1 for a detection is the probability of clutter and of objects that were not kept.
    """

    labels: Integers
    detections: Integers
    probabilities: Array


@compiled
def claims_of(labels: Integers, weights: Array, n_missed: int, updated: Integers) -> Claims:
    """Return the claims of an update, before reduction.

    Parameters
    ----------
    labels, weights : arrays (n,)
        Components after the update: those that it missed, those `updated` by a detection each, and one newborn a
        detection.
    n_missed : int
        Number of those missed.
    updated : array (k,) of int
        Detection of each of those updated.
    """
    n_detected = len(labels) - n_missed
    detections = np.empty(n_detected, dtype=np.int64)
    for k in range(n_detected):
        detections[k] = updated[k] if k < len(updated) else k - len(updated)
    return Claims(labels[n_missed:].copy(), detections, weights[n_missed:].copy())


@compiled
def likely_claims(labels: Integers, weights: Array, n_missed: int, detections: Integers) -> tuple[Integers, Integers]:
    """Labels and the detections that they made more probably than not, given that their objects exist.

    Parameters
    ----------
    labels, weights : arrays (n,)
        Components after an update, as for `claims_of`.
    n_missed : int
        The first so many were missed.
    detections : array (n - n_missed,) of int
        Detection of each of the others.
    """
    order = stable_order(labels)
    chosen, wanted = np.empty(len(detections), dtype=np.int64), np.empty(len(detections), dtype=np.int64)
    found, start = 0, 0
    while start < len(order):
        label, end, whole = labels[order[start]], start, 0.0
        while end < len(order) and labels[order[end]] == label:
            whole += weights[order[end]]
            end += 1
        for i in range(start, end):
            if label < 0 or order[i] < n_missed:
                continue
            # the rows of one label and detection are alternatives
            j, share = detections[order[i] - n_missed], 0.0
            for place in range(start, end):
                other = order[place]
                if other >= n_missed and detections[other - n_missed] == j:
                    share += weights[other]
            if share > 0.5 * whole:
                chosen[found], wanted[found] = label, j
                found += 1
                break
        start = end
    return chosen[:found], wanted[:found]


@compiled
def detected_labels(labels: Integers, weights: Array, n_missed: int) -> Integers:
    """Labels that an event detected: more probably than not, given that the object exists.

    After an update, and before reduction, a label's components are those that the event missed and those
    that it detected. Their weights are the probabilities of "exists, and was missed" and of "exists, and
    made a detection" (in a PHD, expected numbers), so given existence the object was detected with
    probability D / (D + M), where D and M are the sums of these weights. A newborn was detected for certain.

    Parameters
    ----------
    labels, weights : arrays (n,)
        Components after an update; negative labels stand for objects never detected, and are left out.
    n_missed : int
        The first so many were missed, the others detected.

    Returns
    -------
    array (k,) of int
        Labels with D > M, in rising order.
    """
    order = stable_order(labels)
    found = np.empty(len(labels), dtype=np.int64)
    count = 0
    balance = 0.0
    for place in range(len(order)):
        k = order[place]
        balance += -weights[k] if k < n_missed else weights[k]
        if place + 1 == len(order) or labels[order[place + 1]] != labels[k]:
            if labels[k] >= 0 and balance > 0.0:
                found[count] = labels[k]
                count += 1
            balance = 0.0
    return found[:count]
