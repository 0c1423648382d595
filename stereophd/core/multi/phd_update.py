"""Compiled update of the PHD filter with the detections of an event (paper VI, eq. 5), with ln L^c of VII-B."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.moved import OUT_OF_VIEW, Moved
from stereophd.core.multi.association import kalman_updates, pair_likelihoods
from stereophd.core.multi.inputs import EventArrays, EventNumbers
from stereophd.core.multi.mixture import GaussianMixture
from stereophd.core.multi.outcomes import allocate_outcomes, fill_missed
from stereophd.core.multi.reduce import reduce_mixture
from stereophd.core.numerics.compilation import compiled
from stereophd.core.numerics.sorting import places

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class PhdReduction(NamedTuple):
    """Settings of the reduction: those of `stereophd.core.multi.filter_settings.phd.PhdSettings`."""

    prune_weight: float
    merge_distance: float
    max_components: int
    mutual: bool


@compiled
def update_intensity(
    mixture: GaussianMixture, moved: Moved, event: EventArrays, numbers: EventNumbers, prune_weight: float
) -> tuple[GaussianMixture, float, Integers]:
    """Update an intensity; no reduction.

    Parameters
    ----------
    mixture : GaussianMixture
        As predicted, each component at home.
    moved : Moved
        The same components in the event's space.
    event, numbers : EventArrays, EventNumbers
    prune_weight : float
        Pairs of a component and a detection below this weight are not made.

    Returns
    -------
    mixture : GaussianMixture
        Missed components, detected ones, and one newborn a detection, in this order.
    log_likelihood : float
        Log-likelihood of the event's detections, per distorted pixel.
    updated : array of int
        Detection of each detected component.
    """
    points, noises, areas, readings, birth_means, birth_covariances = event
    detected = numbers.p_detect * moved.fraction * mixture.weights
    components, detections, joint = pair_likelihoods(
        moved.means, moved.covariances, moved.status != OUT_OF_VIEW, points, noises, areas, readings
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
    kept = places(weights >= prune_weight)
    components, detections = components[kept], detections[kept]
    out = allocate_outcomes(mixture, components, numbers, len(points))
    fill_missed(mixture, moved, np.arange(len(detected)), numbers, out)
    out.weights[: len(detected)] = mixture.weights - detected
    means, covariances = kalman_updates(
        moved.means, moved.covariances, components, detections, points, noises, readings
    )
    begin, end = len(detected), len(detected) + len(kept)
    out.weights[begin:end], out.means[begin:end], out.covariances[begin:end] = weights[kept], means, covariances
    out.weights[end:] = born * per_area / totals
    out.means[end:], out.covariances[end:] = birth_means, birth_covariances
    return out, log_likelihood, detections


@compiled
def reduce_intensity(mixture: GaussianMixture, settings: PhdReduction) -> tuple[GaussianMixture, int]:
    """`reduce_mixture` with these settings."""
    return reduce_mixture(
        mixture, settings.prune_weight, settings.merge_distance, settings.max_components, settings.mutual
    )
