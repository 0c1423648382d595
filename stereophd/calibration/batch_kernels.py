"""Compiled multi-object filters conditional on camera hypotheses (paper VII-B): one event of many hypotheses.

The same computation as `stereophd.multi.phd.PhdFilter` and `stereophd.multi.pmb.PmbFilter` (predict and update),
made of the same compiled pieces, hypothesis by hypothesis with no state shared between them: results do not
depend on how the hypotheses are shared out over threads. A mixture is a tuple of arrays
(`stereophd.multi.intensity.Parts`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereophd.compilation import compiled
from stereophd.disparity.kernels import (
    IN_VIEW,
    OUT_OF_VIEW,
    PARTLY_IN_VIEW,
    MovedArrays,
    motion_noise,
    move_components,
)
from stereophd.disparity.space import PACKED_SIZE
from stereophd.geometry.layout import ROTATION
from stereophd.multi.association import kalman_updates, pair_likelihoods
from stereophd.multi.intensity import UNLABELLED, Parts
from stereophd.multi.pmb_reduce import reduce_tracks
from stereophd.multi.pmb_update import update_tracks
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


class Step(NamedTuple):
    """Numbers of one event.

    `camera`, `time_s` of the event; `survival` since the last one; first unused label; `p_detect`, `clutter` and
    `births` a frame, `area` of the camera's image (px^2); `acceleration_std` (3,) and `max_speed` of the motion;
    `minimum`, `reserve_minimum`: fewest samples in view; `important`, `wide`: weight and relative spread of the
    disparity from which a component gets a second look; `labelled`: PMB filter, else PHD filter; then the
    parameters of the reduction (`PhdSettings`, `PmbSettings`).
    """

    camera: int
    time_s: float
    survival: float
    next_label: int
    p_detect: float
    clutter: float
    births: float
    area: float
    acceleration_std: Array
    max_speed: float
    minimum: int
    reserve_minimum: int
    important: float
    wide: float
    labelled: bool
    prune_weight: float
    merge_distance: float
    max_components: int
    mutual: bool
    recycle_below: float
    hypothesis_distance: float
    least_share: float


@compiled
def _take(parts: Parts, index: Integers) -> Parts:
    """Return the components with these indices."""
    return (
        parts[0][index], parts[1][index], parts[2][index], parts[3][index], parts[4][index], parts[5][index],
        parts[6][index], parts[7][index],
    )  # fmt: skip


@compiled
def _slice(parts: Parts, first: int, last: int) -> Parts:
    """Return views of consecutive components."""
    return (
        parts[0][first:last], parts[1][first:last], parts[2][first:last], parts[3][first:last],
        parts[4][first:last], parts[5][first:last], parts[6][first:last], parts[7][first:last],
    )  # fmt: skip


@compiled
def _allocate(count: int, size: int) -> Parts:
    """Room for components; pages that are never written are never allocated."""
    return (
        np.empty(count), np.empty((count, size)), np.empty((count, size, size)), np.empty(count, dtype=np.int64),
        np.empty(count), np.empty(count, dtype=np.int64), np.full(count, UNLABELLED),
        np.zeros(count, dtype=np.bool_),
    )  # fmt: skip


@compiled
def _copy(source: Parts, target: Parts, first: int) -> int:
    """Copy components to `target` from place `first` on; return the place after the last."""
    last = first + len(source[0])
    target[0][first:last] = source[0]
    target[1][first:last] = source[1]
    target[2][first:last] = source[2]
    target[3][first:last] = source[3]
    target[4][first:last] = source[4]
    target[5][first:last] = source[5]
    target[6][first:last] = source[6]
    target[7][first:last] = source[7]
    return last


@compiled
def _noise(samples: Array, destination: Array, step: Step) -> Array:
    """Motion noise of samples in the destination's axes, as `stereophd.disparity.moments` makes it."""
    if samples.shape[0] < 12:
        return np.zeros((6, 0))
    axes = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            axes[a, b] = destination[ROTATION + 3 * a + b] * step.acceleration_std[b]
    return motion_noise(samples, axes)


@compiled
def _look_again(
    which: Integers,
    parts: Parts,
    homes: Array,
    dts: Array,
    destination: Array,
    sets: SampleArrays,
    step: Step,
    region: Array,
    moved: MovedArrays,
) -> None:
    """Carry some components over with the reserve of samples, into `moved`."""
    noise = _noise(sets.reserve, destination, step)
    for i in which:
        one = slice(i, i + 1)
        part = (
            moved[0][one], moved[1][one], moved[2][one], moved[3][one], moved[4][one], moved[5][one], moved[6][one],
        )  # fmt: skip
        move_components(
            parts[1][one], parts[2][one], homes[one], dts[one], sets.reserve, sets.reserve_weights, noise,
            destination, step.p_detect, step.max_speed, step.reserve_minimum, region, part,
        )  # fmt: skip


@compiled
def predict(parts: Parts, spaces: Array, sets: SampleArrays, step: Step, region: Array) -> tuple[Parts, MovedArrays]:
    """Carry a hypothesis' components into the event's space: `DisparityFilter.predict`.

    Returns the components, at home, with the weights of those that survive and are not forgotten, and the
    fields of `stereophd.disparity.moments.Moved`.
    """
    means, covariances, cameras = parts[1], parts[2], parts[3]
    count, size = means.shape
    homes = np.empty((count, PACKED_SIZE))
    for i in range(count):
        homes[i] = spaces[cameras[i]]
    dts = step.time_s - parts[4]
    destination = spaces[step.camera]
    moved = (
        np.zeros((count, size)), np.zeros((count, size, size)), np.zeros(count), np.zeros(count, dtype=np.int64),
        np.zeros((count, size)), np.zeros((count, size, size)), np.ones(count),
    )  # fmt: skip
    move_components(
        means, covariances, homes, dts, sets.samples, sets.weights, _noise(sets.samples, destination, step),
        destination, step.p_detect, step.max_speed, step.minimum, region, moved,
    )  # fmt: skip
    fraction, status, inside = moved[2], moved[3], moved[6]
    weights = parts[0] * step.survival
    spread = (step.wide * means[:, 2]) ** 2
    corner = (weights >= step.important) & (status == OUT_OF_VIEW)
    corner &= (covariances[:, 2, 2] > spread) | (fraction > 0.0)
    which = np.flatnonzero(corner)
    if len(which) > 0:
        _look_again(which, parts, homes, dts, destination, sets, step, region, moved)
    for i in range(count):
        if status[i] == OUT_OF_VIEW:
            fraction[i] = 0.0
            if cameras[i] == step.camera and weights[i] < step.important:
                weights[i] = 0.0
        weights[i] *= inside[i]
    return (weights, parts[1], parts[2], parts[3], parts[4], parts[5], parts[6], parts[7]), moved


@compiled
def _reduce(parts: Parts, step: Step) -> Parts:
    """`stereophd.multi.reduce.reduce_mixture` of components none of which is below the pruning weight."""
    found = _take(parts, np.argsort(-parts[0], kind="mergesort"))
    if step.merge_distance > 0.0 and len(found[0]) > 1:
        weights, means, covariances, leaders = merge_sorted(
            found[0], found[1], found[2], found[3], found[4], step.merge_distance, step.mutual
        )
        found = (
            weights, means, covariances, found[3][leaders], found[4][leaders], found[5][leaders],
            found[6][leaders], found[7][leaders],
        )  # fmt: skip
    if len(found[0]) > step.max_components:
        order = np.argsort(-found[0], kind="mergesort")
        found = _take(found, np.sort(order[: step.max_components]))
    return found


@compiled
def _phd_missed(parts: Parts, moved: MovedArrays, detected: Array, step: Step, out: Parts) -> int:
    """Fill `out` with the components as they are if undetected; return how many are worth keeping."""
    found = 0
    for i in range(len(detected)):
        weight = parts[0][i] - detected[i]
        if not weight >= step.prune_weight:
            continue
        out[0][found], out[5][found] = weight, parts[5][i]
        out[3][found], out[4][found] = parts[3][i], parts[4][i]
        if moved[3][i] == IN_VIEW:
            out[1][found], out[2][found] = moved[0][i], moved[1][i]
            out[3][found], out[4][found] = step.camera, step.time_s
        elif moved[3][i] == PARTLY_IN_VIEW or moved[6][i] < 1.0:
            out[1][found], out[2][found] = moved[4][i], moved[5][i]
        else:
            out[1][found], out[2][found] = parts[1][i], parts[2][i]
        found += 1
    return found


@compiled
def phd_event(
    parts: Parts, spaces: Array, event: EventArrays, sets: SampleArrays, step: Step, region: Array
) -> tuple[Parts, float]:
    """One event of one hypothesis: `PhdFilter.predict` and `PhdFilter.update`.

    Parameters
    ----------
    parts : tuple of arrays
        Components.
    spaces : array (c, 30)
        Packed disparity spaces of the hypothesis' cameras.
    event, sets, step
        As their classes say.
    region : array (8,) or empty
        Where objects can be (`stereophd.disparity.kernels.region_mask`).

    Returns
    -------
    parts : tuple of arrays
        After the event.
    log_likelihood : float
        Multi-object log-likelihood of the event, ln L^c of VII-B.
    """
    n_detections, size = len(event.points), parts[1].shape[1]
    parts, moved = predict(parts, spaces, sets, step, region)
    detected = step.p_detect * moved[2] * parts[0]
    components, detections, joint = pair_likelihoods(
        moved[0], moved[1], moved[3] != OUT_OF_VIEW, event.points, event.noises, event.areas
    )
    born = step.p_detect * step.births
    totals = np.full(n_detections, (step.clutter + born) / step.area)
    for p in range(len(joint)):
        joint[p] *= detected[components[p]]
        totals[detections[p]] += joint[p]
    log_likelihood = np.log(totals).sum() - step.clutter - born - detected.sum()
    for p in range(len(joint)):
        joint[p] /= totals[detections[p]]
    kept = np.flatnonzero(joint >= step.prune_weight)
    components, detections = components[kept], detections[kept]
    means, covariances = kalman_updates(moved[0], moved[1], components, detections, event.points, event.noises)

    out = _allocate(len(detected) + len(kept) + n_detections, size)
    missed = _phd_missed(parts, moved, detected, step, out)
    found = missed + len(kept)
    out[0][missed:found], out[1][missed:found], out[2][missed:found] = joint[kept], means, covariances
    out[5][missed:found] = parts[5][components]
    for j in range(n_detections):
        weight = born / step.area / totals[j]
        if weight >= step.prune_weight:
            out[0][found], out[5][found] = weight, step.next_label + j
            out[1][found], out[2][found] = event.birth_means[j], event.birth_covariances[j]
            found += 1
    out[3][missed:found], out[4][missed:found] = step.camera, step.time_s
    return _reduce(_slice(out, 0, found), step), log_likelihood


@compiled
def pmb_event(
    parts: Parts, spaces: Array, event: EventArrays, sets: SampleArrays, step: Step, region: Array
) -> tuple[Parts, float]:
    """One event of one hypothesis: `PmbFilter.predict` and `PmbFilter.update`; as `phd_event`."""
    parts, moved = predict(parts, spaces, sets, step, region)
    parts, log_likelihood = update_tracks(
        parts, moved, event.points, event.noises, event.areas, event.birth_means, event.birth_covariances,
        (step.camera, step.time_s, step.next_label), (step.p_detect, step.clutter, step.births, step.area),
        step.prune_weight,
    )  # fmt: skip
    parts, _ = reduce_tracks(
        parts, step.recycle_below, step.prune_weight, step.merge_distance, step.max_components,
        step.hypothesis_distance, step.least_share,
    )  # fmt: skip
    return parts, log_likelihood


@compiled
def batch_event(
    begins: Integers,
    ends: Integers,
    parts: Parts,
    spaces: Array,
    event: EventArrays,
    sets: SampleArrays,
    step: Step,
    region: Array,
) -> tuple[Integers, Parts, Array]:
    """`phd_event` or `pmb_event` of some hypotheses.

    Parameters
    ----------
    begins, ends : arrays (k,)
        Where each hypothesis' components begin and end in `parts`.
    spaces : array (k, c, 30)
        Packed spaces of each hypothesis.

    Returns
    -------
    counts : array (k,)
        Components of each hypothesis after the event.
    parts : tuple of arrays
        Components after the event, one hypothesis after the other.
    log_likelihoods : array (k,)
    """
    hypotheses = len(begins)
    counts, log_likelihoods = np.empty(hypotheses, dtype=np.int64), np.empty(hypotheses)
    out = _allocate(hypotheses * step.max_components, parts[1].shape[1])
    found = 0
    for h in range(hypotheses):
        before = _slice(parts, begins[h], ends[h])
        if step.labelled:
            after, log_likelihoods[h] = pmb_event(before, spaces[h], event, sets, step, region)
        else:
            after, log_likelihoods[h] = phd_event(before, spaces[h], event, sets, step, region)
        counts[h] = len(after[0])
        if found + counts[h] > len(out[0]):
            # a track of the PMB filter may have several components
            larger = _allocate(2 * (found + counts[h]), parts[1].shape[1])
            _copy(_slice(out, 0, found), larger, 0)
            out = larger
        found = _copy(after, out, found)
    return counts, _slice(out, 0, found), log_likelihoods
