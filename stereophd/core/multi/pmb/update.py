"""Compiled update of the Poisson multi-Bernoulli filter with the detections of an event (Williams 2015, IV).

The components of a label are alternatives for one track i of existence r_i = sum_h w_h, of which the part
p_h = pD f_h w_h is expected to be detected (f_h the share in view). With the density l_hj of detection j given
alternative h, the density c of clutter and the density b of first detections,

    psi_ij = sum_h p_h l_hj / ((1 - sum_h p_h) (c + b))

are the odds of the association problem that `association_marginals` solves: its marginals m_ij share the
detection out among the alternatives, w_hj = m_ij p_h l_hj / sum_h p_h l_hj.

The tracks after the event are taken for independent. By that the filter knows less than the detections say, and later
events are less probable than they would be. Their total correlation (M. Watanabe, "Information theoretical analysis of
multivariate correlation", IBM J. Res. Dev. 4 (1), 1960) is what is forgotten, in nats: the sum of the entropies of what
each track made, less the entropy of the association, log Z - sum_ij m_ij log psi_ij.
"""

import math
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import OUT_OF_VIEW, Moved
from stereophd.core.multi.association.exact_association import association_marginals
from stereophd.core.multi.association.likelihoods import pair_likelihoods
from stereophd.core.multi.state.inputs import EventArrays, EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.multi.state.outcomes import Outcomes, label_outcomes
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import group, picked, places, stable_order

# A track that must have been detected (certain, in view, detection probability 1) may still be missed
# with this probability: odds stay finite.
LEAST_MISSED = 1e-9
# Hypotheses of a smaller share than this are left out of the Gaussian of a track.
LEAST_SHARE = 1e-4
# Pairs of one component with detections: with thousands of detections an object of unknown depth has more, and the
# likeliest count.
MOST_PAIRS = 256


@compiled
def associate_tracks(
    mixture: GaussianMixture, moved: Moved, event: EventArrays, numbers: EventNumbers, prune_weight: float
) -> tuple[Outcomes, float, float]:
    """Share the detections of an event out among tracks, clutter and new objects.

    The mixture is as predicted, each component at home; `moved` has the same components in the event's space. Pairs far
    below the pruning weight are left out. Returns missed components, detected ones, and one new track a detection;
    the log-likelihood of the event's detections, per distorted pixel: the value of the association problem; and the
    total correlation of the tracks.
    """
    weights, labels = mixture.weights, mixture.labels
    points, noises, areas, readings, _, _ = event
    p_detect, clutter, births, area = numbers.p_detect, numbers.clutter, numbers.births, numbers.area
    status, fraction = moved.status, moved.fraction
    count, n_detections = len(weights), len(points)
    components, detections, densities = pair_likelihoods(
        moved.means, moved.covariances, status != OUT_OF_VIEW, points, noises, areas, readings, MOST_PAIRS
    )
    detected = p_detect * fraction * weights
    joint = picked(detected, components) * densities
    # densities of first detections of objects, and with those that are false
    born = p_detect * births / area
    background = clutter / area + born

    member, n_groups = group(labels)
    missed = np.ones(n_groups)
    log_likelihood = n_detections * math.log(background) - clutter - p_detect * births
    for k in range(count):
        missed[member[k]] -= detected[k]
    for g in range(n_groups):
        missed[g] = max(missed[g], LEAST_MISSED)
        log_likelihood += math.log(missed[g])

    claim = _track_claims(member, components, detections, joint, n_detections)
    odds = claim.sums / (picked(missed, claim.owners) * background)
    share, untouched, unclaimed, log_bethe = association_marginals(
        claim.owners, claim.wanted, odds, n_groups, n_detections
    )

    taken = np.empty(len(claim.order))
    for i in range(len(taken)):
        whole = claim.sums[claim.pair[i]]
        taken[i] = share[claim.pair[i]] * joint[claim.order[i]] / whole if whole > 0.0 else 0.0
    kept = places(taken >= LEAST_SHARE * prune_weight)
    chosen = picked(claim.order, kept)
    owned, made = picked(components, chosen), picked(detections, chosen)
    existence = unclaimed * (born / background)
    still = untouched / missed
    out_weights = np.concatenate(((weights - detected) * picked(still, member), picked(taken, kept), existence))
    out_labels = label_outcomes(labels, owned, numbers.next_label, n_detections)
    forgotten = -log_bethe
    for p in range(len(odds)):
        if share[p] > 0.0:
            forgotten += share[p] * math.log(odds[p] / share[p])
    for g in range(n_groups):
        if untouched[g] > 0.0:
            forgotten -= untouched[g] * math.log(untouched[g])
    for j in range(n_detections):  # of new tracks, which exist if no other made their detection, and it is not clutter
        forgotten += _entropy(existence[j]) - unclaimed[j] * _entropy(born / background)
    outcomes = Outcomes(out_labels, out_weights, owned, made, event.birth_means, event.birth_covariances)
    return outcomes, log_likelihood + log_bethe, max(forgotten, 0.0)


@compiled
def _entropy(probability: float) -> float:
    """Return the entropy of whether something is so, of this probability, nats."""
    if not 0.0 < probability < 1.0:
        return 0.0
    return -probability * math.log(probability) - (1.0 - probability) * math.log(1.0 - probability)


class TrackClaims(NamedTuple):
    """Pairs of a track and a detection: a track claims a detection as a whole, with all its alternatives."""

    # `owners`, `wanted`: arrays (n,) of int: Track and detection of each pair, in order of both.
    owners: Integers
    wanted: Integers
    sums: Array  # (n,): Sum over the alternatives
    order: Integers  # (c,) of int: Places of the alternatives among all pairs of a component and a detection
    pair: Integers  # (c,) of int: Pair of each of them


@compiled
def _track_claims(
    member: Integers, components: Integers, detections: Integers, joint: Array, n_detections: int
) -> TrackClaims:
    """Add up the pairs (p,) of components by their track (`member`) and detection."""
    # most components of a track follow one another; tracks that were joined may have others elsewhere
    order = stable_order(picked(member, components))
    owners, wanted = np.empty(len(order), dtype=np.int64), np.empty(len(order), dtype=np.int64)
    sums, pair = np.empty(len(order)), np.empty(len(order), dtype=np.int64)
    place = np.full(n_detections, -1)
    found, start = 0, 0
    while start < len(order):
        track, end, first = member[components[order[start]]], start, found
        while end < len(order) and member[components[order[end]]] == track:
            j = detections[order[end]]
            if place[j] < 0:
                place[j], wanted[found] = found, j
                found += 1
            end += 1
        sorted_ones = picked(wanted[first:found], stable_order(wanted[first:found]))
        for i in range(len(sorted_ones)):
            j = sorted_ones[i]
            place[j], wanted[first + i], owners[first + i], sums[first + i] = first + i, j, track, 0.0
        for i in range(start, end):
            pair[i] = place[detections[order[i]]]
            sums[pair[i]] += joint[order[i]]
        for i in range(first, found):
            place[wanted[i]] = -1
        start = end
    return TrackClaims(owners[:found], wanted[:found], sums[:found], order, pair)
