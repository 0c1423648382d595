"""Compiled prediction of the filters for many objects: components survive, move, and come into the event's space."""

from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import Moved, Sources, allocate_moved
from stereophd.core.disparity.sample_move import Draws, EventDraws, carry_components
from stereophd.core.disparity.space import PACKED_SIZE
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.births.survival import IMPORTANT_WEIGHT, keep_surviving_weights
from stereophd.core.multi.births.undetected import Undetected, expected_births
from stereophd.core.multi.state.inputs import EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.numerics.compilation.compiled import compiled

# Fields of a named tuple, which the kernel names again: to find its form takes 0.6 us less for each.
Fields = tuple[Any, ...]


@compiled
def homes_of(spaces: Array, space_of: Integers, destination: Array) -> Array:
    """Return the packed home spaces (n + 1, 30) of n components, and after them that of the event."""
    count = len(space_of)
    homes = np.empty((count + 1, PACKED_SIZE))
    for a in range(PACKED_SIZE):
        for k in range(count):
            homes[k, a] = spaces[space_of[k], a]
        homes[count, a] = destination[a]
    return homes


@compiled
def predict_components(
    mixture: GaussianMixture,
    numbers: EventNumbers,
    homes: Array,
    motion: MotionArrays,
    views: Array,
    region: Array,
    draws: EventDraws,
    which: Integers,
    moved: Moved,
) -> tuple[Array, float]:
    """Return the weights (n,) of components that survive and are not forgotten, and their sum.

    Components have the first n of the packed spaces `homes`, the event the last. Those of `which` are carried into its
    space; `moved` has the others there already. `views` (c, 30) are the spaces of all cameras at the time of the event.
    """
    weights = mixture.weights * numbers.survival
    sources = Sources(mixture.means, mixture.covariances, homes, motion)
    carry_components(
        which, sources, weights >= IMPORTANT_WEIGHT, draws, homes[-1], numbers.shape_p_detect, region, moved
    )  # fmt: skip
    return weights, keep_surviving_weights(weights, mixture, moved, homes, motion, views, numbers)


@compiled
def predict_event(mixture: Fields, given: Fields) -> tuple[Array, Moved, Array, float, Undetected, int]:
    """Predict the components of a mixture, and what is born.

    What is given is, in this order, the numbers of the event; all components in its space (or none, where they are
    still to be carried); packed spaces, and which of them each component is at home in; the motion over the interval of
    each, and over none; the spaces of the event and of all cameras; the region; the `EventDraws`; and parameters of
    `expected_births`: what was undetected, the rates and what remains. Returns the weights (n,) of
    `predict_components`, all components in the event's space, `homes_of` them, and what `expected_births` returns.
    """
    numbers, carried, spaces, space_of, motion, destination, views, region, draws, before, rates, remaining = given
    components, event, moved = GaussianMixture(*mixture), EventNumbers(*numbers), Moved(*carried)
    both = EventDraws(Draws(*draws[0]), Draws(*draws[1]))
    count, which = len(components.weights), np.empty(0, dtype=np.int64)
    if len(moved.status) < count:
        moved, which = allocate_moved(count, components.means.shape[1]), np.arange(count)
    homes = homes_of(spaces, space_of, destination)
    weights, total = predict_components(
        components, event, homes, MotionArrays(*motion), views, region, both, which, moved
    )  # fmt: skip
    births, undetected, burst = expected_births(
        Undetected(*before), rates, remaining, event, event.p_detect * total
    )  # fmt: skip
    return weights, moved, homes, births, undetected, burst
