"""Compiled multi-object filters conditional on camera hypotheses (paper VII-B): one event of many hypotheses.

The same computation as `core.multi.phd.PhdFilter` and `core.multi.pmb.PmbFilter` (predict and update),
made of the same compiled pieces, hypothesis by hypothesis with no state shared between them: results do not
depend on how the hypotheses are shared out over threads. A mixture is a tuple of arrays
(`stereophd.core.multi.intensity.Parts`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.batch_arrays import (
    ROOM,
    EventArrays,
    SampleArrays,
    Step,
    append_parts,
    predicted_parts,
    slice_moved,
)
from stereophd.core.disparity.kernels import (
    IN_VIEW,
    OUT_OF_VIEW,
    PARTLY_IN_VIEW,
    MovedArrays,
)
from stereophd.core.disparity.move_kernels import allocate_moved, carry_components
from stereophd.core.disparity.space import PACKED_SIZE
from stereophd.core.motion.arrays import MotionArrays, slice_motion
from stereophd.core.multi.association import kalman_updates, pair_likelihoods
from stereophd.core.multi.intensity import Parts
from stereophd.core.multi.parts import allocate_parts, slice_parts, take_parts
from stereophd.core.multi.pmb_reduce import reduce_tracks
from stereophd.core.multi.pmb_update import update_tracks
from stereophd.core.multi.reduce import merge_sorted
from stereophd.core.multi.visibility import fade_out_of_view
from stereophd.core.numerics.compilation import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@compiled
def predict(
    begins: Integers,
    ends: Integers,
    parts: Parts,
    spaces: Array,
    sets: SampleArrays,
    motion: MotionArrays,
    step: Step,
    region: Array,
) -> tuple[Array, MovedArrays]:
    """Carry the components of some hypotheses into the event's spaces: `DisparityFilter.predict`.

    Parameters
    ----------
    begins, ends : arrays (k,)
        Where each hypothesis' components begin and end in `parts`.
    parts : tuple of arrays
        Components.
    spaces : array (k, c, 30)
        Packed disparity spaces of each hypothesis' cameras.
    sets, motion, step
        As their classes say; `motion` has an interval for each of the components in `parts`.
    region : array (8,) or empty
        Where objects can be (`stereophd.core.disparity.kernels.region_mask`).

    Returns
    -------
    weights : array (n,)
        Of the components of these hypotheses, one hypothesis after the other, if they survive and are not
        forgotten.
    moved : tuple of arrays
        The same components in the event's space: fields of `stereophd.core.disparity.moments.Moved`.
    """
    size = parts[1].shape[1]
    total = (ends - begins).sum()
    all_weights, all_moved = np.empty(total), allocate_moved(total, size)
    first = 0
    for h in range(len(begins)):
        last = first + ends[h] - begins[h]
        weights, moved = all_weights[first:last], slice_moved(all_moved, first, last)
        first = last
        part = slice(begins[h], ends[h])
        means, covariances, cameras = parts[1][part], parts[2][part], parts[3][part]
        weights[:] = parts[0][part] * step.survival
        destination = spaces[h, step.camera]
        homes = np.empty((len(weights), PACKED_SIZE))
        for k in range(len(weights)):
            homes[k] = spaces[h, cameras[k]]
        carry_components(
            np.arange(len(weights)), means, covariances, homes, slice_motion(motion, begins[h], ends[h]),
            weights >= step.important, sets.first, sets.second, destination, step.shape_p_detect, region, moved,
        )  # fmt: skip
        fade_out_of_view(
            weights, moved[3], means, homes, step.time_s - parts[4][part], spaces[h], step.elapsed, step.out_of_view_s
        )
        _forget(weights, parts[3][part], moved, step)
    return all_weights, all_moved


@compiled
def _forget(weights: Array, cameras: Integers, moved: MovedArrays, step: Step) -> None:
    """Drop what lies outside the region, and what was never established and left the view of its camera."""
    status, inside = moved[3], moved[6]
    for i in range(len(weights)):
        if status[i] == OUT_OF_VIEW and cameras[i] == step.camera and weights[i] < step.important:
            weights[i] = 0.0
        weights[i] *= inside[i]


@compiled
def _reduce(parts: Parts, step: Step) -> Parts:
    """`stereophd.core.multi.reduce.reduce_mixture` of components none of which is below the pruning weight."""
    found = take_parts(parts, np.argsort(-parts[0], kind="mergesort"))
    if step.merge_distance > 0.0 and len(found[0]) > 1:
        weights, means, covariances, leaders = merge_sorted(
            found[0], found[1], found[2], found[3], found[4], step.merge_distance, step.mutual
        )
        heads = take_parts(found, leaders)
        found = (weights, means, covariances, heads[3], heads[4], heads[5], heads[6], heads[7])
    if len(found[0]) > step.max_components:
        kept = np.zeros(len(found[0]), dtype=np.bool_)
        kept[np.argsort(-found[0], kind="mergesort")[: step.max_components]] = True
        found = take_parts(found, np.flatnonzero(kept))
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
def _phd_update(parts: Parts, moved: MovedArrays, event: EventArrays, step: Step) -> tuple[Parts, float]:
    """`PhdFilter.update` of one hypothesis, with ln L^c of VII-B."""
    n_detections, size = len(event.points), parts[1].shape[1]
    detected = step.p_detect * moved[2] * parts[0]
    components, detections, joint = pair_likelihoods(
        moved[0], moved[1], moved[3] != OUT_OF_VIEW, event.points, event.noises, event.areas, event.delays
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
    means, covariances = kalman_updates(
        moved[0], moved[1], components, detections, event.points, event.noises, event.delays
    )

    out = allocate_parts(len(detected) + len(kept) + n_detections, size)
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
    return _reduce(slice_parts(out, 0, found), step), log_likelihood


@compiled
def phd_update(
    begins: Integers,
    ends: Integers,
    parts: Parts,
    weights: Array,
    moved: MovedArrays,
    event: EventArrays,
    step: Step,
) -> tuple[Integers, Parts, Array]:
    """`PhdFilter.update` of some hypotheses.

    Parameters
    ----------
    begins, ends, parts
        As of `predict`.
    weights, moved
        What `predict` returned.
    event, step
        As their classes say.

    Returns
    -------
    counts : array (k,)
        Components of each hypothesis after the event.
    parts : tuple of arrays
        Components after the event, one hypothesis after the other.
    log_likelihoods : array (k,)
        Of the event.
    """
    counts, log_likelihoods = np.empty(len(begins), dtype=np.int64), np.empty(len(begins))
    out = allocate_parts(len(begins) * ROOM, parts[1].shape[1])
    found, first = 0, 0
    for h in range(len(begins)):
        before, seen, first = predicted_parts(begins[h], ends[h], parts, weights, moved, first)
        after, log_likelihoods[h] = _phd_update(before, seen, event, step)
        counts[h] = len(after[0])
        out = append_parts(after, out, found)
        found += counts[h]
    return counts, slice_parts(out, 0, found), log_likelihoods


@compiled
def pmb_update(
    begins: Integers,
    ends: Integers,
    parts: Parts,
    weights: Array,
    moved: MovedArrays,
    event: EventArrays,
    step: Step,
) -> tuple[Integers, Parts, Array]:
    """`PmbFilter.update` of some hypotheses; as `phd_update`."""
    counts, log_likelihoods = np.empty(len(begins), dtype=np.int64), np.empty(len(begins))
    out = allocate_parts(len(begins) * ROOM, parts[1].shape[1])
    found, first = 0, 0
    for h in range(len(begins)):
        before, seen, first = predicted_parts(begins[h], ends[h], parts, weights, moved, first)
        updated, log_likelihoods[h] = update_tracks(
            before, seen, event.points, event.noises, event.areas, event.delays,
            event.birth_means, event.birth_covariances,
            (step.camera, step.time_s, step.next_label), (step.p_detect, step.clutter, step.births, step.area),
            step.prune_weight,
        )  # fmt: skip
        after, _ = reduce_tracks(
            updated, step.recycle_below, step.prune_weight, step.merge_distance, step.max_components,
            step.hypothesis_distance, step.least_share,
        )  # fmt: skip
        counts[h] = len(after[0])
        out = append_parts(after, out, found)
        found += counts[h]
    return counts, slice_parts(out, 0, found), log_likelihoods
