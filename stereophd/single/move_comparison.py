"""How well each method carries a Gaussian from one disparity space to another (paper, Figures 4 and 7).

The truth is the Gaussian of the same first two moments as a very large sample, carried over by the
textbook. What a method loses is the Kullback-Leibler divergence of that Gaussian from its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.disparity.samples import Method
from stereophd.disparity.space import DisparitySpace
from stereophd.motion import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MoveCase:
    """A Gaussian to carry over.

    Attributes
    ----------
    home, destination : DisparitySpace
    mean, covariance : arrays (6,), (6, 6)
        In the home space.
    dt : float
        Interval, s.
    motion : Motion
    """

    home: DisparitySpace
    destination: DisparitySpace
    mean: Array
    covariance: Array
    dt: float
    motion: Motion


@dataclass(frozen=True)
class MoveMoments:
    """A Gaussian carried over by one method.

    Attributes
    ----------
    method : str
        Of `stereophd.disparity.samples.Method`, or ``reference``.
    samples : int
        Samples used.
    mean, covariance : arrays (6,), (6, 6)
        Of the part in view of the destination's camera, in its disparity space.
    fraction : float
        Part in view.
    divergence : float
        Kullback-Leibler divergence of the reference from this Gaussian, nat; 0 of the reference.
    """

    method: str
    samples: int
    mean: Array
    covariance: Array
    fraction: float
    divergence: float


def gaussian_of_object(
    space: DisparitySpace, point: Array, stds: Array, velocity: Array, velocity_std: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Gaussian (6,), (6, 6) of an object at a disparity point (u, v, d) that moves with a velocity in the world.

    Parameters
    ----------
    space : DisparitySpace
    point, stds : arrays (3,)
        Mean and standard deviations of u, v and d, px.
    velocity : array (3,)
        Mean velocity in the world, length/s.
    velocity_std : float
        Standard deviation of each of its components.
    rng : Generator
        Of the sample by whose moments the velocity in disparity space is found.
    """
    raise NotImplementedError


def reference_moments(case: MoveCase, rng: np.random.Generator, samples: int = 1_000_000) -> MoveMoments:
    """Moments of a very large pseudo-random sample carried over by the textbook."""
    raise NotImplementedError


def compare_move(
    case: MoveCase, method: Method, samples: int, reference: MoveMoments, rng: np.random.Generator
) -> MoveMoments:
    """Carry the Gaussian over by one method, once, and compare with the reference."""
    raise NotImplementedError


def compare_moves(
    case: MoveCase, methods: Sequence[tuple[Method, int]], reference: MoveMoments, rng: np.random.Generator
) -> tuple[MoveMoments, ...]:
    """`compare_move` for several methods, each with its number of samples."""
    raise NotImplementedError
