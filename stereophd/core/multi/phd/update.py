"""Compiled update of the PHD filter with the detections of an event (paper VI, eq. 5), with ln L^c of VII-B."""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import OUT_OF_VIEW, Moved
from stereophd.core.multi.association.likelihoods import ALL_PAIRS, pair_likelihoods
from stereophd.core.multi.state.inputs import EventArrays, EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture, take_components
from stereophd.core.multi.state.outcomes import ChosenOutcomes, Outcomes, label_outcomes, make_components
from stereophd.core.multi.state.reduction import merge_sorted
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import group, largest, picked, places, stable_order

# Part of the intensity at a detection that is left to others at least, against rounding.
LEAST_OTHERS = 1e-12


class PhdReduction(NamedTuple):
    """Settings of the reduction: those of `stereophd.core.multi.filter_settings.phd.PhdSettings`."""

    prune_weight: float
    merge_distance: float
    max_components: int
    by_label: bool


@compiled
def update_intensity(
    mixture: GaussianMixture, moved: Moved, event: EventArrays, numbers: EventNumbers, reduction: PhdReduction
) -> tuple[GaussianMixture, float, Integers, Array]:
    """Update an intensity as predicted, each component at home, which `moved` has in the event's space; no reduction.

    Of the settings, `prune_weight` (pairs of a component and a detection below it are not made) and `by_label` count.
    Returns missed components, detected ones and one newborn a detection, in this order; the log-likelihood of the
    event's detections, per distorted pixel; the detection of each detected component; and what each component counts
    for the moments when it is merged: `label_shares`, or its weight.
    """
    points, noises, areas, readings, birth_means, birth_covariances = event
    detected = numbers.p_detect * moved.fraction * mixture.weights
    components, detections, joint = pair_likelihoods(
        moved.means, moved.covariances, moved.status != OUT_OF_VIEW, points, noises, areas, readings, ALL_PAIRS
    )
    # clutter, births and components compete for every detection
    per_area = 1.0 / numbers.area
    born = numbers.p_detect * numbers.births
    totals = np.zeros(len(points))
    for p in range(len(joint)):
        joint[p] *= detected[components[p]]
        totals[detections[p]] += joint[p]
    totals += (numbers.clutter + born) * per_area
    log_likelihood = np.log(totals).sum() - numbers.clutter - born - detected.sum()
    weights = joint / totals[detections]
    kept = places(weights >= reduction.prune_weight)
    components, detections = components[kept], detections[kept]
    labels = label_outcomes(mixture.labels, components, numbers.next_label, len(points))
    begin, end, every = len(detected), len(detected) + len(kept), np.empty(len(labels))
    every[:begin], every[begin:end] = mixture.weights - detected, weights[kept]
    every[end:] = born * per_area / totals
    outcomes = Outcomes(labels, every, components, detections, birth_means, birth_covariances)
    out = make_components(
        mixture, moved, event, numbers, outcomes, ChosenOutcomes(np.arange(len(labels)), every, 0, 0.0)
    )  # fmt: skip
    shares = out.weights
    if reduction.by_label:
        shares = label_shares(
            mixture.labels, out.weights, components, detections, joint[kept], totals,
            (numbers.clutter + born) * per_area
        )  # fmt: skip
    return out, log_likelihood, detections, shares


@compiled
def label_shares(
    labels: Integers,
    weights: Array,
    components: Integers,
    detections: Integers,
    joint: Array,
    others: Array,
    least: float,
) -> Array:
    """Weights of components among the alternatives for their label (ours).

    In an intensity a component that an event missed keeps the weight w (1 - p_D) even if its label made a detection for
    certain: the detection may be that of another object, and a Poisson number of objects knows no alternatives. Taken
    as one object, which is missed or makes one detection, among Poisson others of intensity kappa_j at detection j, the
    label has for its alternatives the odds

        w_i (1 - p_D) of component i missed,    w_i p_D g_ij / kappa_j of component i detected by j.

    With clutter of 10 per frame, p_D = 0.7 and a detection at hand, the missed part has a share of 0.3 in the intensity
    and 0.0002 in these odds. Its larger covariance, and its distance from the detected part, would enter the moments of
    what is merged: the stated covariance would be half as large again as the errors.

    Labels (n,) are those before the event, weights (n + p + m,) those of the components missed, of the pairs of a
    component and a detection (p,), with the intensity w_i p_D g_ij (`joint`), and of the newborn. `others` (m,) is the
    intensity at each detection of everything, this label included, and `least` the part of it that is clutter and
    births. The sum over a label stays; newborn components keep their weights.
    """
    count, made = len(labels), len(others)
    number, known = group(labels)
    keys = np.empty(len(joint), dtype=np.int64)
    for p in range(len(joint)):
        keys[p] = number[components[p]] * made + detections[p]
    shares = weights.copy()
    # of each label: the sum of its weights, and of its odds
    whole, total = np.zeros(known), np.zeros(known)
    for k in range(count):
        whole[number[k]] += weights[k]
        total[number[k]] += weights[k]
    pairs = stable_order(keys)
    start = 0
    while start < len(pairs):
        own, end = 0.0, start
        while end < len(pairs) and keys[pairs[end]] == keys[pairs[start]]:
            own += joint[pairs[end]]
            end += 1
        at = others[detections[pairs[start]]]
        kappa = max(at - own, least, LEAST_OTHERS * at)
        for i in range(start, end):
            p = pairs[i]
            shares[count + p] = joint[p] / kappa
            whole[number[components[p]]] += weights[count + p]
            total[number[components[p]]] += shares[count + p]
        start = end
    for k in range(count + len(pairs)):
        owner = k if k < count else components[k - count]
        n = number[owner]
        if total[n] <= 0.0:
            shares[k] = weights[k]
        else:
            shares[k] *= whole[n] / total[n]
    return shares


@compiled
def reduce_intensity(mixture: GaussianMixture, shares: Array, settings: PhdReduction) -> tuple[GaussianMixture, int]:
    """Drop components below a weight, merge near ones (`merge_sorted`, with these shares), and keep the heaviest.

    Returns the mixture in order of falling weight of the heaviest part, whose identity a merged component keeps, and
    the number of components that `max_components` left out.
    """
    heavy = places(mixture.weights >= settings.prune_weight)
    order = picked(heavy, stable_order(-picked(mixture.weights, heavy)))
    reduced = take_components(mixture, order)
    if settings.merge_distance > 0.0 and len(reduced.weights) > 1:
        weights, means, covariances, leaders = merge_sorted(reduced, picked(shares, order), settings.merge_distance)
        reduced = GaussianMixture(
            weights, means, covariances, reduced.cameras[leaders], reduced.times[leaders], reduced.labels[leaders],
            reduced.tracks[leaders], reduced.reported[leaders]
        )  # fmt: skip
    left_out = max(len(reduced.weights) - settings.max_components, 0)
    if left_out > 0:
        reduced = take_components(reduced, places(largest(reduced.weights, settings.max_components)))
    return reduced, left_out
