"""Gaussians carried between disparity spaces: particle, quasi-Monte Carlo, unscented and linear moves.

`move` is the paper's particle prediction and particle move (IV-B a-e, V-B, Algorithm 2) with the split of a component
into a detected and a missed part by the field of view (VI-C, Fig. 8). The part in view is a Gaussian in the
destination's space. The part out of view keeps its Gaussian in the space and at the time of origin, because the
destination's space describes it badly beyond the field of view and behind the camera. No covariance that leaves this
module is rank-deficient.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.disparity.moved import IN_VIEW, Moved, Sources, room_for_moved
from stereophd.core.disparity.rule_move import STEP, rule_components
from stereophd.core.disparity.sample_move import Draws, EventDraws, carry_components, noise_axes
from stereophd.core.disparity.world_moments import world_components
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.samples import SampleSets, cubature_points
from stereophd.core.numerics.threads import in_threads

# A Gaussian refitted from fewer samples than this is rank-deficient or soon overconfident.
FEWEST_SAMPLES = 24
# Components whose disparity is known no better than to this fraction are not worth a try with a low-order rule.
WIDEST_RULE = 0.5
NO_REGION = np.empty(0)
# Methods that do without samples, or may.
RULES = ("adaptive", "unscented", "linear")
# Below this many sample trips a step is over before a second thread has started.
TRIPS_PER_THREAD = 20_000


def minimum_in_view(samples: int) -> int:
    """Fewest samples in view from which a Gaussian is fitted: 24, or an eighth, of at least 48."""
    return max(min(FEWEST_SAMPLES, samples // 2), samples // 8)


def move(
    sources: Sources,
    destination: Array,
    sets: SampleSets,
    turn: int,
    p_detect: float = 1.0,
    important: Booleans | None = None,
    threads: int = 1,
    region: Array | None = None,
) -> Moved:
    """Carry Gaussians into the packed disparity space (30,) of a camera, over an interval of time.

    The sets name the method and hold its samples; `turn`, the number of the event, picks one. `p_detect` is the
    probability of detection inside the image, for the shape of the missed part: 0 leaves it as it was. `important` (n,)
    components get more samples when too few are in view: an object at the edge of the field of view would otherwise
    count as a new one. Objects can be in the `region` (r,) only (`stereophd.core.geometry.region`).
    Components are shared out over the threads; the result does not depend on their number.
    """
    draws, moved = draws_of_event(sets, turn), room_for_moved(*sources.means.shape)
    region = NO_REGION if region is None else region
    important = np.zeros(len(sources.means), dtype=bool) if important is None else important
    which = np.arange(len(sources.means))
    if sets.method in RULES:
        which = _low_order(sources, destination, sets, region, moved)

    def run(part: Integers) -> None:
        carry_components(part, sources, important, draws, destination, p_detect, region, moved)

    parts = max(1, min(threads, len(which) * sets.size // TRIPS_PER_THREAD))
    in_threads(run, [which] if parts == 1 else np.array_split(which, parts), parts)
    return moved


def world_moments(
    means: Array, covariances: Array, homes: Array, dts: Array, motion: Motion, sets: SampleSets, turn: int
) -> tuple[Array, Array]:
    """Mean (n, 6) and covariance (n, 6, 6) in the world of Gaussians in disparity space, after `dts`.

    By the moments of the samples. A component whose mean disparity is not positive is at infinity and
    has no position: its rows are NaN. Samples more than ten times further away than the mean are left
    out (a Gaussian in disparity has no moments in depth). For static objects the velocity is 0.
    Parameters as `Sources` and `move`; `dts` (n,) are times from each component, s, of any sign.
    """
    out_means = np.empty((len(means), 6))
    out_covariances = np.empty((len(means), 6, 6))
    which, intervals = np.arange(len(means)), motion.arrays(dts)
    world_components(which, which, means, covariances, homes, intervals, sets.turn(turn), out_means, out_covariances)
    return out_means, out_covariances


def draws_of_event(sets: SampleSets, turn: int) -> EventDraws:
    """Return the samples of event number `turn`."""
    return EventDraws(
        Draws(sets.turn(turn), _equal_weights(sets.size), minimum_in_view(sets.size)),
        Draws(sets.reserve, sets.reserve_weights, FEWEST_SAMPLES),
    )


@cache
def _equal_weights(samples: int) -> Array:
    return np.ones(samples)


@cache
def _rule_points(rows: int) -> Array:
    return np.concatenate([cubature_points(rows), np.zeros((rows, 1))], axis=1)


def _low_order(sources: Sources, destination: Array, sets: SampleSets, region: Array, moved: Moved) -> NDArray[np.intp]:
    """Move by the unscented or the linear rule; return which components still need samples."""
    points = _rule_points(12 if sources.means.shape[1] == 6 else 3)
    axes = noise_axes(destination, sources.intervals.noise_std)
    limits = (WIDEST_RULE, sets.max_nonlinearity) if sets.method == "adaptive" else (np.inf, np.inf)
    todo = rule_components(sources, points, axes, destination, region, *limits, moved)
    if sets.method == "linear":
        near = room_for_moved(*sources.means.shape)
        rule_components(sources, STEP * points, axes, destination, region, *limits, near)
        # A Gaussian so narrow that its near points round to one keeps the moments of the others.
        kept = near.status == IN_VIEW
        moved.means[kept], moved.covariances[kept] = near.means[kept], near.covariances[kept] / STEP**2
    return todo
