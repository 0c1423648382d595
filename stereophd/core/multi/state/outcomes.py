"""What an event may make of components and detections, and the components that it makes of them (compiled)."""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import IN_VIEW, PARTLY_IN_VIEW, Moved
from stereophd.core.multi.association.likelihoods import kalman_updates
from stereophd.core.multi.state.inputs import EventArrays, EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture, allocate_mixture
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.sorting import copy_gaussian, picked


class Outcomes(NamedTuple):
    """What an event may make of n components, by c pairs of a component and a detection, and of its m detections."""

    # `labels`, `weights`: Labels and weights of the components that the event missed, of those that it detected, and
    # of one new object for each detection.
    labels: Integers
    weights: Array
    # `owned`, `made`: arrays (c,) of int: Component and detection of each pair.
    owned: Integers
    made: Integers
    # `new_means`, `new_covariances`: arrays (m, d), (m, d, d): Gaussians of the new objects.
    new_means: Array
    new_covariances: Array


class ChosenOutcomes(NamedTuple):
    """Outcomes worth making."""

    chosen: Integers  # (k,) of int: Their places among all outcomes, in rising order
    weights: Array  # (k,): Of each
    left_out: int  # Number of others that were worth making but for the bound on hypotheses
    undecided: float  # Detections that these would have decided: sum of weights, each times its share of its track


@compiled
def label_outcomes(labels: Integers, owned: Integers, next_label: int, n_new: int) -> Integers:
    """Return the labels of `Outcomes`, from those (n,) before the event and the first that is unused."""
    count, end = len(labels), len(labels) + len(owned)
    out = np.empty(end + n_new, dtype=np.int64)
    for k in range(len(out)):
        out[k] = labels[k] if k < count else (labels[owned[k - count]] if k < end else next_label + k - end)
    return out


@compiled
def make_components(
    mixture: GaussianMixture,
    moved: Moved,
    event: EventArrays,
    numbers: EventNumbers,
    outcomes: Outcomes,
    choice: ChosenOutcomes,
) -> GaussianMixture:
    """Return the chosen outcomes as components; the other parameters are those of the updates."""
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
    _fill_missed(mixture, moved, chosen[:missed], numbers, out)
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


@compiled
def _fill_missed(
    mixture: GaussianMixture, moved: Moved, index: Integers, numbers: EventNumbers, out: GaussianMixture
) -> None:
    """Place the components with these indices (m,) at the beginning of `out`, as they are if the event missed them.

    Components wholly in view move to the event's space; others stay at home, where they are Gaussian. Weights, labels
    and identities are not filled in.
    """
    _, means, covariances, cameras, times, _, _, _ = mixture
    moved_means, moved_covariances, _, status, missed_means, missed_covariances, inside = moved
    _, to_means, to_covariances, to_cameras, to_times, _, _, _ = out
    camera, time_s = numbers.camera, numbers.time_s
    for i in range(len(index)):
        k = index[i]
        to_cameras[i] = camera if status[k] == IN_VIEW else cameras[k]
        to_times[i] = time_s if status[k] == IN_VIEW else times[k]
        if status[k] == IN_VIEW:
            copy_gaussian(moved_means, moved_covariances, k, to_means, to_covariances, i)
        elif status[k] == PARTLY_IN_VIEW or inside[k] < 1.0:
            copy_gaussian(missed_means, missed_covariances, k, to_means, to_covariances, i)
        else:
            copy_gaussian(means, covariances, k, to_means, to_covariances, i)
