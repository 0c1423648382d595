"""Sets of standard-normal samples, shared by all components (and camera hypotheses) of a step.

A set for moving objects has twelve rows: six for the state and six for the motion noise; a set for
static objects has three.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from annotated_types import Interval

from stereophd.core.arrays import Array
from stereophd.core.numerics.sobol import normal_quantiles, sobol_points
from stereophd.core.settings import Positive, parameter, settings

Method = Literal["adaptive", "qmc", "particle", "unscented", "linear"]

# Non-linearity (`stereophd.core.disparity.rule_move`) up to which a component is moved by the low-order rule.
MAX_NONLINEARITY = 0.03

FEWEST_QMC_SAMPLES = 64


@settings
class MomentsSettings:
    """How a Gaussian is carried from one disparity space to another (paper IV-B, V-B, VI-C)."""

    method: Method = parameter(
        "qmc: scrambled Sobol points; particle: pseudo-random, as the paper has it; adaptive: a low-order "
        "rule for each component over which the map is nearly linear, Sobol points for the others; unscented, linear: "
        "low-order rules throughout",
        default="qmc",
        advice="qmc; adaptive is faster with many objects; the others reproduce the paper.",
    )
    samples: Annotated[int, Interval(ge=16, le=65536)] = parameter(
        "samples per Gaussian (qmc, adaptive: a power of two, at least 64)",
        default=64,
        advice="64 for tracking; the paper uses 100 and 250 pseudo-random ones.",
    )
    max_nonlinearity: Positive = parameter(
        "adaptive: components are sampled above this curvature of one standard deviation, in standard "
        "deviations of the result",
        default=MAX_NONLINEARITY,
    )

    def __post_init__(self) -> None:
        # mirrored points in twelve dimensions need 48 to have a covariance of full rank
        wanting = self.samples < FEWEST_QMC_SAMPLES or self.samples & (self.samples - 1)
        if self.method in ("qmc", "adaptive") and wanting:
            expected = f"a power of two of at least {FEWEST_QMC_SAMPLES} for method {self.method}"
            raise ValueError(f"samples: expected {expected}, found {self.samples}")


# Sets drawn once and used in turn, event by event: enough that a set's own error does not repeat
# from step to step, few enough to stay in the cache.
SETS_IN_TURN = 16

# A component born with a wide prior of depth may be in view with its tail only; widened along the
# disparity, 17 % of these samples lie beyond 1.9 standard deviations on one side, instead of 3 %.
RESERVE_SAMPLES = 1024
RESERVE_WIDTH = 2.0


@dataclass(frozen=True)
class SampleSets:
    """Standard-normal sample sets, one per event in rotation."""

    method: Method  # How Gaussians are carried over (see `stereophd.core.disparity.moments`)
    # (s, rows, n): Sample sets; `turn` picks one. For ``unscented`` and ``linear`` they serve the components that lie
    # across the border of the image, which no low-order rule describes.
    sets: Array
    # (rows, m): A larger set whose third coordinate (the disparity, given the pixel) is twice as wide, for important
    # components of which a normal set finds only a corner in view.
    reserve: Array
    reserve_weights: Array  # (m,): Importance weights of the reserve
    max_nonlinearity: float = MAX_NONLINEARITY  # For ``adaptive``: components above this measure are moved by samples

    def turn(self, index: int) -> Array:
        """Return the set (rows, n) of event number `index`."""
        return np.asarray(self.sets[index % len(self.sets)])

    @property
    def size(self) -> int:
        """Number of samples of a set."""
        return int(self.sets.shape[2])


def draw_sample_sets(
    method: Method, samples: int, rows: int, seed: np.random.SeedSequence, max_nonlinearity: float = MAX_NONLINEARITY
) -> SampleSets:
    """Draw the sample sets of a run: `samples` of `rows` dimensions each, a power of two for ``qmc``.

    ``particle`` uses independent pseudo-random draws, as the paper does (IV-B a). Every other method uses scrambled
    Sobol points, mirrored (so that all odd moments vanish) and whitened, so that the mean is 0 and the covariance is
    the identity to rounding: a linear map then carries a Gaussian over exactly, and sampling adds noise only where the
    map is not linear. The seed is that of the scrambling or of the draws; `max_nonlinearity` is for ``adaptive``. For
    the methods see `SampleSets`.
    """
    return _sets(method, samples, rows, seed.entropy, seed.spawn_key, max_nonlinearity)


@lru_cache(maxsize=8)
def _sets(
    method: Method, samples: int, rows: int, entropy: int, spawn_key: tuple[int, ...], max_nonlinearity: float
) -> SampleSets:
    """Draw the sets of a seed; filters of a run that differ in their settings alone share them."""
    seed = np.random.SeedSequence(entropy, spawn_key=spawn_key)
    rngs = [np.random.default_rng(child) for child in seed.spawn(SETS_IN_TURN)]
    large = max(RESERVE_SAMPLES, samples)
    if method == "particle":
        sets = np.stack([rng.standard_normal((rows, samples)) for rng in rngs])
        reserve = rngs[0].standard_normal((rows, large))
    else:
        half = max(samples // 2, 2 * rows)
        sets = np.stack([_mirrored_sobol(half, rows, rng) for rng in rngs])
        reserve = _mirrored_sobol(large // 2, rows, rngs[0])
    # the density of a standard normal over that of one RESERVE_WIDTH times as wide
    weights = np.exp(-0.5 * reserve[2] ** 2 * (RESERVE_WIDTH**2 - 1.0))
    reserve[2] *= RESERVE_WIDTH
    return SampleSets(method, sets, reserve, weights / weights.mean(), max_nonlinearity)


def cubature_points(rows: int) -> Array:
    """Return the points (rows, 2 rows) of the unscented transform without a centre point.

    All weights are equal and positive (kappa = 0; the cubature rule of Arasaratnam and Haykin,
    2009), so that no covariance can turn indefinite.
    """
    points = np.sqrt(rows) * np.eye(rows)
    return np.concatenate([points, -points], axis=1)


def _mirrored_sobol(half: int, rows: int, rng: np.random.Generator) -> Array:
    """Scrambled Sobol normals (rows, 2 half), mirrored through 0 and whitened."""
    exponent = int(np.ceil(np.log2(half)))
    normal = normal_quantiles(sobol_points(rows, exponent, rng)[:half]).T
    cholesky = np.linalg.cholesky(normal @ normal.T / half)
    white = np.linalg.solve(cholesky, normal)
    return np.concatenate([white, -white], axis=1)
