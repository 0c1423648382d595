"""The labels that an event detected, and the detections of each."""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import picked, stable_order

# In the place of a detection where none is more probable than all others together.
UNDECIDED = -1


class Claims(NamedTuple):
    """Which labels the detections of an event belong to, with which probability."""

    # (n,) of int: Several rows of one label and detection are alternatives: their probabilities add up.
    labels: Integers
    detections: Integers  # (n,) of int: Rows of the event's detections
    # (n,): That the object of the label exists and made the detection (in a PHD, the expected number of such
    # objects). What is missing to 1 for a detection is the probability of clutter and of objects that were not kept.
    probabilities: Array


@compiled
def claims_of(labels: Integers, weights: Array, n_missed: int, updated: Integers) -> Claims:
    """Return the claims of an update, before reduction.

    Labels and weights (n,) are those of the components after the update: `n_missed` that it missed, those updated by a
    detection each (`updated` (k,) has the detections), and one newborn a detection.
    """
    n_detected = len(labels) - n_missed
    detections = np.empty(n_detected, dtype=np.int64)
    for k in range(n_detected):
        detections[k] = _detection_of(k, updated)
    return Claims(labels[n_missed:].copy(), detections, weights[n_missed:].copy())


@compiled
def join_claims(claims: Claims, least: float) -> Claims:
    """Return claims with the alternatives of a label and detection added up, those of less than `least` left out.

    Rows are in order of detection, then of label.
    """
    labels, detections, probabilities = claims
    order = stable_order(labels)
    order = picked(order, stable_order(picked(detections, order)))
    rows, sums = np.empty(len(order), dtype=np.int64), np.empty(len(order))
    count, start = 0, 0
    while start < len(order):
        k, end = order[start], start + 1
        rows[count], sums[count] = k, probabilities[k]
        while end < len(order) and labels[order[end]] == labels[k] and detections[order[end]] == detections[k]:
            sums[count] += probabilities[order[end]]
            end += 1
        count += 1 if sums[count] >= least else 0
        start = end
    return Claims(picked(labels, rows[:count]), picked(detections, rows[:count]), sums[:count])


@compiled
def detected_labels(labels: Integers, weights: Array, n_missed: int, updated: Integers) -> tuple[Integers, Integers]:
    """Labels that an event detected, more probably than not, given that the object exists; and the detections.

    After an update, and before reduction, a label's components are those that the event missed and those
    that it detected. Their weights are the probabilities of "exists, and was missed" and of "exists, and
    made a detection" (in a PHD, expected numbers), so given existence the object was detected with
    probability D / (D + M), where D and M are the sums of these weights. A newborn was detected for certain.

    Parameters are those of `claims_of`. Returns the labels (k,) with D > M, in rising order, and the detection (k,)
    that each made more probably than not; `UNDECIDED` where several share the probability.
    """
    order = stable_order(labels)
    detected, made = np.empty(len(labels), dtype=np.int64), np.empty(len(labels), dtype=np.int64)
    shares = np.zeros(len(labels) - n_missed - len(updated))
    count, start = 0, 0
    while start < len(order):
        label, end, balance, whole = labels[order[start]], start, 0.0, 0.0
        while end < len(order) and labels[order[end]] == label:
            k = order[end]
            balance += -weights[k] if k < n_missed else weights[k]
            whole += weights[k]
            end += 1
        if balance > 0.0:
            detected[count], made[count] = label, UNDECIDED
            # the components of one label and detection are alternatives
            for i in range(start, end):
                if order[i] >= n_missed:
                    shares[_detection_of(order[i] - n_missed, updated)] += weights[order[i]]
            for i in range(start, end):
                if order[i] >= n_missed:
                    j = _detection_of(order[i] - n_missed, updated)
                    if shares[j] > 0.5 * whole:
                        made[count] = j
                    shares[j] = 0.0
            count += 1
        start = end
    # copies: filters keep them for many events, and slices would keep the arrays of all outcomes
    return detected[:count].copy(), made[:count].copy()


@compiled
def _detection_of(k: int, updated: Integers) -> int:
    """Detection of component k after those missed."""
    return updated[k] if k < len(updated) else k - len(updated)
