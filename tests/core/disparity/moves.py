"""Moves that the tests of moments share, and the margins of a comparison with samples.

Margins. A fit to N independent samples has an error of std / sqrt(N) in the mean, and of
sqrt((k - 1) / N) of itself in a variance, k being the kurtosis of the (exact) result: `particle` and `qmc`
must stay within five of these for their own N, in the worst of all coordinates. The references have
65,536 points of low discrepancy, whose own error is small against that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.stats import norm, qmc

from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import Moved, Sources
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.numerics.samples import SampleSets, draw_sample_sets
from tests.core.disparity.cases import converging, make_camera, make_space, oracle_trip, random_covariance, state_in

METHODS = ("qmc", "particle", "adaptive", "unscented", "linear")
REFERENCE_SAMPLES = 2**16


@cache
def reference_samples() -> np.ndarray:
    """Standard normal samples (12, `REFERENCE_SAMPLES`) for reference moments: scrambled Sobol points."""
    samples = np.ascontiguousarray(norm.ppf(qmc.Sobol(12, seed=99).random(REFERENCE_SAMPLES)).T)
    samples.flags.writeable = False
    return samples


@cache
def drawn_once(method: str, samples: int, rows: int, seed: int) -> SampleSets:
    """The sample sets of a seed: most tests use the same few, and drawing them takes longer than most tests."""
    return draw_sample_sets(method, samples, rows, np.random.SeedSequence(seed))  # type: ignore[arg-type]


def sample_sets(method: str, samples: int, motion: Motion, seed: int = 1) -> SampleSets:
    return drawn_once(method, samples, motion.sample_rows, seed)


@dataclass(frozen=True)
class Case:
    """A Gaussian to be carried from one space to another."""

    mean: np.ndarray
    covariance: np.ndarray
    home: DisparitySpace
    destination: DisparitySpace
    dt: float
    motion: Motion

    def move(self, sets: SampleSets, turn: int = 0, p_detect: float = 1.0, important: bool = False) -> Moved:
        return move(self.sources, self.destination.packed(), sets, turn, p_detect, np.array([important]))

    @property
    def sources(self) -> Sources:
        intervals = self.motion.arrays(np.array([self.dt]))
        return Sources(self.mean[None], self.covariance[None], self.home.packed()[None], intervals)

    def trip(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return oracle_trip(self.mean, self.covariance, samples, self.home, self.destination, self.dt, self.motion)

    @cached_property
    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        return self.trip(reference_samples())


@cache
def nearly_linear(size: int = 6) -> Case:
    """A well localised object: 1 px, 2 % of disparity."""
    home, destination = converging(20.0, 0.26)
    world = [2.0, -3.0, 110.0, 1.0, -0.5, 2.0][:size]
    covariance = random_covariance(np.random.default_rng(1), [1.0, 1.2, 0.15, 1.0, 1.0, 0.02][:size])
    motion = ConstantVelocity([0.1, 0.2, 0.1]) if size == 6 else Static()
    return Case(state_in(home, world), covariance, home, destination, 0.5, motion)


@cache
def figure_4() -> Case:
    """Prediction in one camera: velocity (2, 2, 0.5) cm/s, noise of variance 0.08 cm^2/s^2, over 5 s."""
    space = make_space(make_camera())
    mean = state_in(space, [0.0, 0.0, 100.0, 2.0, 2.0, 0.5])
    covariance = np.diag([3.0, 3.0, 2.5, 1.0, 1.0, 0.02]) ** 2
    return Case(mean, covariance, space, space, 5.0, ConstantVelocity([0.08**0.5] * 3, max_speed=10.0))


@cache
def figure_7(size: int = 6) -> Case:
    """Cameras 200 cm apart, turned inward by pi/8; velocities of variance 0.03 cm^2/s^2 about 0."""
    home, destination = converging(100.0, np.pi / 8)
    mean = np.array([400.0, 300.0, 3.4, 0.0, 0.0, 0.0])[:size]
    # 0.6 px/s and 0.0022 px/s are 0.03^0.5 cm/s at the mean disparity
    covariance = np.diag([1.4, 1.4, 1.4, 0.6, 0.6, 0.0022])[:size, :size] ** 2
    motion = ConstantVelocity([0.1] * 3, max_speed=2.0) if size == 6 else Static()
    return Case(mean, covariance, home, destination, 1.0, motion)


def monte_carlo_margins(points: np.ndarray, count: int) -> tuple[float, np.ndarray]:
    """Five standard errors of the mean (in standard deviations) and of each variance (relative)."""
    scaled = (points - points.mean(axis=0)) / points.std(axis=0)
    return 5.0 / np.sqrt(count), 5.0 * np.sqrt(((scaled**4).mean(axis=0) - 1.0) / count)
