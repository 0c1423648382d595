"""From settings to an estimator."""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Rig
from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.random_streams import SCRAMBLE_SEED
from stereophd.core.numerics.samples import MomentsSettings, SampleSets, draw_sample_sets
from stereophd.core.single.base import AnyEstimator
from stereophd.core.single.cartesian import CartesianEstimator
from stereophd.core.single.disparity import DisparityEstimator, RectifiedEstimator
from stereophd.core.single.inverse_depth import InverseDepthEstimator
from stereophd.core.single.particle import ParticleEstimator
from stereophd.core.single.settings import (
    CartesianSettings,
    DisparityChoice,
    EstimatorChoice,
    ParticleSettings,
    RectifiedChoice,
)


def build_estimator(
    settings: EstimatorChoice,
    moments: MomentsSettings,
    rig: Rig,
    motion: Motion,
    prior: InitialPrior,
    rng: np.random.Generator,
) -> AnyEstimator:
    """Return the estimator that the settings describe; one on disparity space carries its Gaussian by these moments.

    All its randomness comes from `rng`: pseudo-random samples and particles, not low-discrepancy points (they are a
    rule, not draws). Raises ValueError if the estimator cannot work with these cameras (Algorithm 1 with cameras that
    are not rectified).
    """
    if isinstance(settings, DisparityChoice | RectifiedChoice):
        kind = RectifiedEstimator if settings.kind == "rectified" else DisparityEstimator
        return kind(rig, motion, prior, sample_sets(moments, motion, rng))
    if isinstance(settings, ParticleSettings):
        return ParticleEstimator(rig, motion, prior, settings, int(rng.integers(2**63)))
    if isinstance(settings, CartesianSettings):
        return CartesianEstimator(rig, motion, prior, settings)
    return InverseDepthEstimator(rig, motion, prior)


def sample_sets(settings: MomentsSettings, motion: Motion, rng: np.random.Generator) -> SampleSets:
    """Return the samples of an estimator's moves; those of method ``particle`` are drawn from the generator."""
    rows, scramble = motion.sample_rows, np.random.SeedSequence(SCRAMBLE_SEED)
    if settings.method == "particle":
        # the reserve, for tails in view, is a low-discrepancy set
        rule, sets = draw_sample_sets("qmc", 64, rows, scramble), np.empty((1, rows, settings.samples))
        seed = int(rng.integers(2**63))
        return FreshSamples("particle", sets, rule.reserve, rule.reserve_weights, seed=seed)
    return draw_sample_sets(settings.method, settings.samples, rows, scramble, settings.max_nonlinearity)


@dataclass(frozen=True)
class FreshSamples(SampleSets):
    """Pseudo-random samples drawn anew for every event, as the paper draws them (IV-B a).

    Filters for many objects rotate through a few sets. If one object is tracked over hundreds of events, the errors of
    the same few sets would add up.
    """

    seed: int = 0

    def turn(self, index: int) -> Array:
        """Return the samples (rows, n) of event number `index`."""
        return np.random.default_rng((self.seed, index)).standard_normal(self.sets.shape[1:])
