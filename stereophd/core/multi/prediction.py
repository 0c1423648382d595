"""Compiled prediction of the filters for many objects: components survive, move, and come into the event's space."""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import Moved, allocate_moved
from stereophd.core.disparity.sample_move import Looks, carry_components
from stereophd.core.disparity.space import PACKED_SIZE
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.births.survival import IMPORTANT_WEIGHT, keep_surviving_weights
from stereophd.core.multi.births.undetected import BirthRates, FrameCounts, Undetected, expected_births
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.numerics.compilation.compiled import compiled


class PredictionNumbers(NamedTuple):
    """Numbers of a prediction."""

    camera: int  # Index of the camera of the event
    survival: float  # Probability that an object survives since the last event
    # `elapsed`, `out_of_view_s`: Time since the last event, s, and the time constant of `keep_surviving_weights`.
    elapsed: float
    out_of_view_s: float
    shape_p_detect: float  # Probability of detection for the shape of the missed part; 0 where it keeps its own


class Journey(NamedTuple):
    """How the n components of a mixture come to an event."""

    # `spaces`, `space_of`: arrays (s, 30), (n,): Packed home spaces, and which of them each component has.
    spaces: Array
    space_of: Integers
    motion: MotionArrays  # Of n + 1 intervals: from the time of each component to the event, and none
    destination: Array  # (30,): Packed space of the event's camera
    views: Array  # (c, 30): Packed spaces of all cameras at the time of the event
    region: Array  # (r,) or empty: Where objects can be (`stereophd.core.geometry.region`)
    looks: Looks
    numbers: PredictionNumbers


class BirthsBefore(NamedTuple):
    """What the births of an event follow from: the parameters of `expected_births` but for the known objects."""

    undetected: Undetected
    rates: BirthRates
    remaining: Array
    frame: FrameCounts


@compiled
def homes_of(journey: Journey) -> Array:
    """Return the packed home spaces (n + 1, 30) of components, and after them that of the event."""
    spaces, space_of, destination = journey.spaces, journey.space_of, journey.destination
    count = len(space_of)
    homes = np.empty((count + 1, PACKED_SIZE))
    for k in range(count):
        for a in range(PACKED_SIZE):
            homes[k, a] = spaces[space_of[k], a]
    homes[count] = destination
    return homes


@compiled
def predict_components(
    mixture: GaussianMixture, journey: Journey, homes: Array, which: Integers, moved: Moved
) -> tuple[Array, float]:
    """Return the weights (n,) of components that survive and are not forgotten, and their sum.

    Those of `which` are carried into the event's space; `moved` has the others there already.
    """
    means, motion, numbers = mixture.means, journey.motion, journey.numbers
    weights = mixture.weights * numbers.survival
    carry_components(
        which, means, mixture.covariances, homes, motion, weights >= IMPORTANT_WEIGHT, journey.looks.first,
        journey.looks.second, journey.destination, numbers.shape_p_detect, journey.region, moved
    )  # fmt: skip
    total = keep_surviving_weights(
        weights, moved.status, moved.inside, means, mixture.tracks, mixture.cameras, homes, motion.reach, motion.drift,
        journey.views, numbers.camera, numbers.elapsed, numbers.out_of_view_s
    )  # fmt: skip
    return weights, total


@compiled
def predict_event(
    mixture: GaussianMixture, carried: Moved, journey: Journey, births: BirthsBefore
) -> tuple[Array, Moved, Array, float, Undetected, int]:
    """Predict the components of a mixture, and what is born.

    `carried` has all components in the event's space, or none where they are still to be carried. Returns the weights
    (n,) of `predict_components`, all components in the event's space, `homes_of` the journey, and what
    `expected_births` returns.
    """
    count = len(mixture.weights)
    moved, which = carried, np.empty(0, dtype=np.int64)
    if len(carried.status) < count:
        moved, which = allocate_moved(count, mixture.means.shape[1]), np.arange(count)
    homes = homes_of(journey)
    weights, total = predict_components(mixture, journey, homes, which, moved)
    expected, undetected, burst = expected_births(
        births.undetected, births.rates, births.remaining, births.frame, births.frame.p_detect * total
    )  # fmt: skip
    return weights, moved, homes, expected, undetected, burst
