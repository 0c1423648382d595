"""Compiled filters conditional on camera hypotheses (paper VII-B): one event of many hypotheses.

Hypothesis by hypothesis, with no state shared between them: results do not depend on how the hypotheses are shared
out over threads. The update and the reduction of a hypothesis are those of the filter itself.
"""

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import Moved, allocate_moved
from stereophd.core.disparity.sample_move import EventDraws
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.phd.update import PhdReduction, reduce_intensity, update_intensity
from stereophd.core.multi.pmb.hypotheses import PmbReduction, choose_hypotheses
from stereophd.core.multi.pmb.reduction import reduce_tracks
from stereophd.core.multi.pmb.update import associate_tracks
from stereophd.core.multi.prediction import homes_of, predict_components
from stereophd.core.multi.state.inputs import EventArrays, EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture, allocate_mixture, copy_components, slice_components
from stereophd.core.multi.state.outcomes import make_components
from stereophd.core.numerics.compilation.compiled import compiled

# Components that a hypothesis gets room for at first.
ROOM = 256


@compiled
def slice_motion(motion: MotionArrays, first: int, last: int) -> MotionArrays:
    """Return views of consecutive intervals."""
    return MotionArrays(
        motion.reach[first:last], motion.keep[first:last], motion.position_noise[first:last],
        motion.velocity_noise[first:last], motion.with_velocity[first:last], motion.alone[first:last],
        motion.drift[first:last], motion.noise_std, motion.max_speed
    )  # fmt: skip


@compiled
def update_batch(
    begins: Integers,
    ends: Integers,
    mixture: GaussianMixture,
    spaces: Array,
    motion: MotionArrays,
    draws: EventDraws,
    region: Array,
    event: EventArrays,
    numbers: EventNumbers,
    intensity: PhdReduction | None,
    tracks: PmbReduction | None,
) -> tuple[Integers, GaussianMixture, Array]:
    """Predict, update and reduce some hypotheses as their filter does, the one whose settings are given.

    The components of hypothesis h are those from ``begins[h]`` to ``ends[h]`` of the mixture, and `spaces` (k, c, 30)
    has the packed disparity spaces of its cameras; the motion has an interval for each component of the mixture, and
    the region is that of `stereophd.core.geometry.region`, or empty.

    Returns the number of components (k,) of each hypothesis after the event, all components, one hypothesis after the
    other, and the log-likelihoods (k,) of the event.
    """
    counts, log_likelihoods = np.empty(len(begins), dtype=np.int64), np.empty(len(begins))
    out = allocate_mixture(len(begins) * ROOM, mixture.means.shape[1])
    found = 0
    for h in range(len(begins)):
        components, travel = slice_components(mixture, begins[h], ends[h]), slice_motion(motion, begins[h], ends[h])
        before, seen = _predicted(components, travel, spaces[h], draws, region, numbers)
        # the compiler keeps the branch of the settings that are not None
        if intensity is not None:
            updated, log_likelihoods[h], _, shares = update_intensity(before, seen, event, numbers, intensity)
            after, _ = reduce_intensity(updated, shares, intensity)
        elif tracks is not None:
            outcomes, log_likelihoods[h], _ = associate_tracks(before, seen, event, numbers, tracks.prune_weight)
            choice, known = choose_hypotheses(outcomes, tracks)
            after, _ = reduce_tracks(make_components(before, seen, event, numbers, outcomes, choice), known, tracks)
        counts[h] = len(after.weights)
        out = _append(after, out, found)
        found += counts[h]
    return counts, slice_components(out, 0, found), log_likelihoods


@compiled
def _predicted(
    components: GaussianMixture,
    motion: MotionArrays,
    spaces: Array,
    draws: EventDraws,
    region: Array,
    numbers: EventNumbers,
) -> tuple[GaussianMixture, Moved]:
    """One hypothesis' components as predicted, and the same in the event's space."""
    count, size = components.means.shape
    moved, homes = allocate_moved(count, size), homes_of(spaces, components.cameras, spaces[numbers.camera])
    weights, _ = predict_components(
        components, numbers, homes, motion, spaces, region, draws, np.arange(count), moved
    )  # fmt: skip
    return GaussianMixture(weights, *components[1:]), moved


@compiled
def _append(after: GaussianMixture, out: GaussianMixture, found: int) -> GaussianMixture:
    """Copy components behind the first `found` of `out`; return `out`, or a larger one that replaces it."""
    count = len(after.weights)
    if found + count > len(out.weights):
        larger = allocate_mixture(2 * (found + count), out.means.shape[1])
        copy_components(out, np.arange(found), larger, 0)
        out = larger
    copy_components(after, np.arange(count), out, found)
    return out
