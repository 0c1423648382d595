"""Compiled PHD filters conditional on camera hypotheses (paper VII-B): one event of many hypotheses.

The same computation as `stereophd.multi.phd.PhdFilter` (predict, eq. (5), likelihood, reduction), made of the
same compiled pieces, hypothesis by hypothesis with no state shared between them: results do not depend on
how the hypotheses are shared out over threads. Labels and identities are left out, because they change
neither the intensity nor the likelihood.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.compilation import compiled
from stereophd.disparity.kernels import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, motion_noise, move_components
from stereophd.disparity.space import PACKED_SIZE
from stereophd.geometry.layout import ROTATION
from stereophd.multi.association import kalman_updates, pair_likelihoods
from stereophd.multi.reduce import merge_sorted

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class SampleArrays(NamedTuple):
    """Standard-normal samples of an event, shared by all hypotheses.

    `samples` (rows, n) with `weights` (n,) of 1; `reserve` (rows, r) with `reserve_weights` (r,) for the second
    look at components of which only a corner is in view (`stereophd.disparity.samples.SampleSets`).
    """

    samples: Array
    weights: Array
    reserve: Array
    reserve_weights: Array


class EventArrays(NamedTuple):
    """Detections of an event (`stereophd.multi.events.Event`) and the objects they may have given birth to.

    `points` (m, 2), `noises` (m, 2, 2), `areas` (m,), `birth_means` (m, d), `birth_covariances` (m, d, d).
    """

    points: Array
    noises: Array
    areas: Array
    birth_means: Array
    birth_covariances: Array


class PhdStep(NamedTuple):
    """Numbers of one event.

    `camera`, `time_s` of the event; `survival` since the last one; `p_detect`, `clutter`, `births` per frame and
    `per_area` (1 / image area) of its camera; `acceleration_std` (3,), `max_speed` of the motion;
    `minimum`, `reserve_minimum`: fewest samples in view; `important`, `wide`: weight and relative spread of
    the disparity from which a component gets a second look; then the parameters of the reduction.
    """

    camera: int
    time_s: float
    survival: float
    p_detect: float
    clutter: float
    births: float
    per_area: float
    acceleration_std: Array
    max_speed: float
    minimum: int
    reserve_minimum: int
    important: float
    wide: float
    prune_weight: float
    merge_distance: float
    max_components: int
    mutual: bool


MixtureArrays = tuple[Array, Array, Array, Integers, Array]


@compiled
def _noise(samples: Array, destination: Array, step: PhdStep) -> Array:
    """Motion noise of samples in the destination's axes, as `stereophd.disparity.moments` makes it."""
    if samples.shape[0] < 12:
        return np.zeros((6, 0))
    axes = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            axes[a, b] = destination[ROTATION + 3 * a + b] * step.acceleration_std[b]
    return motion_noise(samples, axes)


@compiled
def _predict(
    weights: Array, mixture: MixtureArrays, spaces: Array, sets: SampleArrays, step: PhdStep, region: Array
) -> tuple[Array, Array, Array, Integers, Array, Array, Array]:
    """Carry a hypothesis' components into the event's space (`stereophd.disparity.moments.move`)."""
    _, means, covariances, cameras, times = mixture
    count, size = means.shape
    homes = np.empty((count, PACKED_SIZE))
    for i in range(count):
        homes[i] = spaces[cameras[i]]
    dts = step.time_s - times
    destination = spaces[step.camera]
    moved = (
        np.zeros((count, size)), np.zeros((count, size, size)), np.zeros(count), np.zeros(count, dtype=np.int64),
        np.zeros((count, size)), np.zeros((count, size, size)), np.ones(count),
    )  # fmt: skip
    move_components(
        means, covariances, homes, dts, sets.samples, sets.weights, _noise(sets.samples, destination, step),
        destination, step.p_detect, step.max_speed, step.minimum, region, moved,
    )  # fmt: skip
    fraction, status = moved[2], moved[3]
    noise = np.zeros((6, 0))
    for i in range(count):
        if status[i] != OUT_OF_VIEW or weights[i] < step.important:
            continue
        spread = step.wide * means[i, 2]
        if fraction[i] > 0.0 or covariances[i, 2, 2] > spread * spread:
            if noise.shape[1] == 0:
                noise = _noise(sets.reserve, destination, step)
            one = slice(i, i + 1)
            part = (
                moved[0][one], moved[1][one], moved[2][one], moved[3][one], moved[4][one], moved[5][one],
                moved[6][one],
            )  # fmt: skip
            move_components(
                means[one], covariances[one], homes[one], dts[one], sets.reserve, sets.reserve_weights, noise,
                destination, step.p_detect, step.max_speed, step.reserve_minimum, region, part,
            )  # fmt: skip
    for i in range(count):
        if status[i] == OUT_OF_VIEW:
            fraction[i] = 0.0
    return moved


@compiled
def _reduce(mixture: MixtureArrays, step: PhdStep) -> MixtureArrays:
    """`stereophd.multi.reduce.reduce_mixture` of components none of which is below the pruning weight."""
    order = np.argsort(-mixture[0], kind="mergesort")
    weights, cameras, times = mixture[0][order], mixture[3][order], mixture[4][order]
    means, covariances = mixture[1][order], mixture[2][order]
    if step.merge_distance > 0.0 and len(weights) > 1:
        weights, means, covariances, leaders = merge_sorted(
            weights, means, covariances, cameras, times, step.merge_distance, step.mutual
        )
        cameras, times = cameras[leaders], times[leaders]
    if len(weights) > step.max_components:
        keep = np.sort(np.argsort(-weights, kind="mergesort")[: step.max_components])
        weights, means, covariances = weights[keep], means[keep], covariances[keep]
        cameras, times = cameras[keep], times[keep]
    return weights, means, covariances, cameras, times


@compiled
def phd_event(
    mixture: MixtureArrays, spaces: Array, event: EventArrays, sets: SampleArrays, step: PhdStep, region: Array
) -> tuple[MixtureArrays, float]:
    """One event of one hypothesis: `PhdFilter.predict` and `PhdFilter.update`.

    Parameters
    ----------
    mixture : tuple of arrays
        Weights (n,), means (n, d), covariances (n, d, d), home cameras (n,) and times (n,).
    spaces : array (c, 30)
        Packed disparity spaces of the hypothesis' cameras.
    event, sets, step
        As their classes say.
    region : array (8,) or empty
        Where objects can be (`stereophd.disparity.kernels.region_mask`).

    Returns
    -------
    mixture : tuple of arrays
        After the event.
    log_likelihood : float
        Multi-object log-likelihood of the event, ln L^c of VII-B.
    """
    n_detections = len(event.points)
    means, covariances, cameras, times = mixture[1], mixture[2], mixture[3], mixture[4]
    count, size = means.shape
    weights = mixture[0] * step.survival
    moved = _predict(weights, mixture, spaces, sets, step, region)
    moved_means, moved_covariances, fraction, status, missed_means, missed_covariances, inside = moved
    detected = np.empty(count)
    detected_mass = 0.0
    for i in range(count):
        unseen = status[i] == OUT_OF_VIEW and cameras[i] == step.camera
        weights[i] = 0.0 if unseen and weights[i] < step.important else weights[i] * inside[i]
        detected[i] = step.p_detect * fraction[i] * weights[i]
        detected_mass += detected[i]
    components, detections, joint = pair_likelihoods(
        moved_means, moved_covariances, status != OUT_OF_VIEW, event.points, event.noises, event.areas
    )
    born = step.p_detect * step.births
    totals = np.full(n_detections, (step.clutter + born) * step.per_area)
    for p in range(len(joint)):
        joint[p] *= detected[components[p]]
        totals[detections[p]] += joint[p]
    log_likelihood = -step.clutter - born - detected_mass
    for j in range(n_detections):
        log_likelihood += math.log(totals[j])
    for p in range(len(joint)):
        joint[p] /= totals[detections[p]]
    kept = np.flatnonzero(joint >= step.prune_weight)
    updated_means, updated_covariances = kalman_updates(
        moved_means, moved_covariances, components[kept], detections[kept], event.points, event.noises
    )

    most = count + len(kept) + n_detections
    out_weights, out_cameras, out_times = np.empty(most), np.empty(most, dtype=np.int64), np.empty(most)
    out_means, out_covariances = np.empty((most, size)), np.empty((most, size, size))
    found = 0
    for i in range(count):
        weight = weights[i] - detected[i]
        if not weight >= step.prune_weight:
            continue
        out_weights[found], out_cameras[found], out_times[found] = weight, cameras[i], times[i]
        if status[i] == IN_VIEW:
            out_means[found], out_covariances[found] = moved_means[i], moved_covariances[i]
            out_cameras[found], out_times[found] = step.camera, step.time_s
        elif status[i] == PARTLY_IN_VIEW or inside[i] < 1.0:
            out_means[found], out_covariances[found] = missed_means[i], missed_covariances[i]
        else:
            out_means[found], out_covariances[found] = means[i], covariances[i]
        found += 1
    for p in range(len(kept)):
        out_weights[found] = joint[kept[p]]
        out_means[found], out_covariances[found] = updated_means[p], updated_covariances[p]
        out_cameras[found], out_times[found] = step.camera, step.time_s
        found += 1
    for j in range(n_detections):
        weight = born * step.per_area / totals[j]
        if weight >= step.prune_weight:
            out_weights[found] = weight
            out_means[found], out_covariances[found] = event.birth_means[j], event.birth_covariances[j]
            out_cameras[found], out_times[found] = step.camera, step.time_s
            found += 1
    together = (
        out_weights[:found], out_means[:found], out_covariances[:found], out_cameras[:found], out_times[:found],
    )  # fmt: skip
    return _reduce(together, step), log_likelihood


@compiled
def phd_events(
    offsets: Integers,
    mixture: MixtureArrays,
    spaces: Array,
    event: EventArrays,
    sets: SampleArrays,
    step: PhdStep,
    region: Array,
) -> tuple[Integers, MixtureArrays, Array]:
    """`phd_event` of consecutive hypotheses whose components lie one after the other.

    Parameters
    ----------
    offsets : array (k + 1,)
        Where each hypothesis' components begin and end in the arrays of `mixture`.
    spaces : array (k, c, 30)
        Packed spaces of each hypothesis.

    Returns
    -------
    counts : array (k,)
        Components of each hypothesis after the event.
    mixture : tuple of arrays
        As given.
    log_likelihoods : array (k,)
    """
    hypotheses = len(offsets) - 1
    size = mixture[1].shape[1]
    counts, log_likelihoods = np.empty(hypotheses, dtype=np.int64), np.empty(hypotheses)
    # pages that are never written are never allocated
    most = hypotheses * step.max_components
    out = (
        np.empty(most), np.empty((most, size)), np.empty((most, size, size)), np.empty(most, dtype=np.int64),
        np.empty(most),
    )  # fmt: skip
    first = 0
    for h in range(hypotheses):
        part = slice(offsets[h], offsets[h + 1])
        before = (mixture[0][part], mixture[1][part], mixture[2][part], mixture[3][part], mixture[4][part])
        after, log_likelihoods[h] = phd_event(before, spaces[h], event, sets, step, region)
        counts[h] = len(after[0])
        last = first + counts[h]
        out[0][first:last] = after[0]
        out[1][first:last] = after[1]
        out[2][first:last] = after[2]
        out[3][first:last] = after[3]
        out[4][first:last] = after[4]
        first = last
    return (
        counts,
        (out[0][:first].copy(), out[1][:first].copy(), out[2][:first].copy(), out[3][:first].copy(), out[4][:first].copy()),
        log_likelihoods,
    )
