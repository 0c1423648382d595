"""Which components are reported as objects: thresholds with hysteresis, one estimate per label.

A component does not know which cameras have detected it. `run_estimator` (`pipeline/tracking/loop.py`, `_supported`)
therefore reports a tentative object only after a second camera has detected it, except at the start of a log.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.world_moments import world_components
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.multi.state.mixture import UNREPORTED, GaussianMixture, order_by_label
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.moments import add_part
from stereophd.core.numerics.sorting import picked, places, stable_order


class Report(NamedTuple):
    """How objects are reported."""

    # `confirm`, `release`, `tentative`: The thresholds of `Hysteresis`.
    confirm: float
    release: float
    tentative: float
    # Whether a label may represent several objects, as in a PHD; hypotheses of one track exclude each other.
    split: bool
    # `next_label`, `next_track`: First unused label and identity.
    next_label: int
    next_track: int


class Selection(NamedTuple):
    """Outcome of `select_objects`: the mixture, and one row for each object that has a position."""

    mixture: GaussianMixture  # With new labels and identities
    # Number of rows of confirmed objects, which come first; the others are tentative. Both in order of identity.
    confirmed: int
    components: Integers  # (k,) of int: Those that are reported
    existence: Array  # (k,): Weight or probability of existence of each object
    # `means`, `covariances`: arrays (k, 6), (k, 6, 6): In the world.
    means: Array
    covariances: Array
    # `next_label`, `next_track`: First unused label and identity.
    next_label: int
    next_track: int

    def estimates(self) -> Estimates:
        """Return the objects, the tentative ones apart."""
        mixture, index = self.mixture, self.components
        found = Estimates(
            mixture.tracks.take(index), self.means, self.covariances, self.existence, mixture.labels.take(index)
        )
        return found.divided(self.confirmed)


# Labels, identities and flags of components (n,), as in a mixture.
Identities = tuple[Integers, Integers, NDArray[np.bool_]]


@compiled
def select_objects(
    mixture: GaussianMixture, report: Report, rows: Integers, homes: Array, motion: MotionArrays, samples: Array
) -> Selection:
    """Choose the components that are reported, give identities in order of the first report, and place them.

    The components of a label are alternatives for one object: their weights add up, the heaviest gives the estimate,
    and all of them its covariance (`_errors`). A further component of a label that alone reaches the confirmation
    threshold is another object (two objects were merged while they were close), and gets a label of its own. An object
    at infinity has no position, and is left out.

    The mixture is that after an event. Component k has the packed home space ``homes[rows[k]]`` and, from its time to
    that of the report, the interval ``rows[k]`` of the motion; `samples` (rows, s) are as in
    `stereophd.core.disparity.moments.world_moments`.
    """
    weights, means, covariances, cameras, times, known, known_tracks, known_reported = mixture
    changed = (known.copy(), known_tracks.copy(), known_reported.copy())
    count = len(weights)
    index, existence, unsure = np.empty(count, dtype=np.int64), np.empty(count), np.empty(count, dtype=np.bool_)
    owner = np.full(count, -1)
    chosen, next_label, next_track = _select(weights, known, report, changed, owner, index, existence, unsure)
    index = index[:chosen].copy()
    members = places(owner >= 0)
    world_means, world_covariances = np.empty((len(members), 6)), np.empty((len(members), 6, 6))
    world_components(
        members, picked(rows, members), means, covariances, homes, motion, samples, world_means, world_covariances
    )  # fmt: skip
    best = np.searchsorted(members, index)
    by_identity, order = stable_order(picked(changed[1], index)), np.empty(chosen, dtype=np.int64)
    placed, confirmed = 0, 0
    for tentative in (False, True):
        for i in by_identity:
            # the mean of an object at infinity is NaN throughout
            if unsure[i] == tentative and math.isfinite(world_means[best[i], 0]):
                order[placed] = i
                placed += 1
        if not tentative:
            confirmed = placed
    order = order[:placed]
    index, existence = picked(index, order), picked(existence, order)
    errors = _errors(picked(weights, members), world_means, world_covariances, picked(owner, members), best)
    to_means, to_covariances = np.empty((placed, 6)), np.empty((placed, 6, 6))
    for i in range(placed):
        to_means[i], to_covariances[i] = world_means[best[order[i]]], errors[order[i]]
    named = GaussianMixture(weights, means, covariances, cameras, times, changed[0], changed[1], changed[2])
    return Selection(named, confirmed, index, existence, to_means, to_covariances, next_label, next_track)


@compiled
def _errors(weights: Array, means: Array, covariances: Array, owner: Integers, best: Integers) -> Array:
    """Covariances (c, 6, 6) of the errors of the `best` (c,) alternatives as estimates of their objects.

    Weights, means and covariances of the alternatives (m,) are in the world; alternative k is one for object
    ``owner[k]``. The object is at one of them, not at the mean m of the heaviest: two pairings of detections put it at
    places that are many standard deviations of either apart. The expected square of the error is

        P = sum_k w_k (P_k + (m_k - m) (m_k - m)^T) / sum_k w_k.

    An alternative that is nowhere (NaN) does not count.
    """
    totals, errors = np.zeros(len(best)), np.zeros((len(best), 6, 6))
    for k in range(len(weights)):
        totals[owner[k]] += weights[k] if math.isfinite(means[k, 0]) else 0.0
    for k in range(len(weights)):
        if math.isfinite(means[k, 0]):
            i = owner[k]
            add_part(weights[k] / totals[i], means[k], covariances[k], means[best[i]], errors[i])
    return errors


@compiled
def _select(
    weights: Array,
    known: Integers,
    report: Report,
    changed: Identities,
    owner: Integers,
    index: Integers,
    existence: Array,
    unsure: NDArray[np.bool_],
) -> tuple[int, int, int]:
    """Change labels, identities and flags of the components (n,); return how many are chosen, and both counters.

    The chosen ones, their existence, and whether they are tentative fill the beginnings of the last three arrays (n,);
    `known` holds the labels before. `owner` (n,), -1 before, gets which of the chosen ones has the label of each.
    """
    confirm, release, tentative, split, next_label, next_track = report
    labels, tracks, reported = changed
    order = order_by_label(weights, known)
    for i in range(1, len(order)):
        k = order[i]
        if split and known[k] == known[order[i - 1]] and weights[k] >= confirm:
            labels[k], tracks[k], reported[k] = next_label, UNREPORTED, False
            next_label += 1
    if split:
        order = picked(order, stable_order(picked(labels, order)))
    chosen, start = 0, 0
    while start < len(order):
        label, end = labels[order[start]], start
        total, track, was_reported = 0.0, UNREPORTED, False
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
            index[chosen], existence[chosen], unsure[chosen] = order[start], total, not shown
            for i in range(start, end):
                owner[order[i]] = chosen
            chosen += 1
        for i in range(start, end):
            tracks[order[i]], reported[order[i]] = track, shown
        start = end
    return chosen, next_label, next_track
