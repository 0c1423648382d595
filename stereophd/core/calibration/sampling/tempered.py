"""Full posterior of the cameras, by one bridge from the modes that another method has found.

The posterior of the parameters x given a log Z is p(x) L(Z | x), with the multi-object evidence L of the filters
conditional on x. Particles are drawn from a proposal q: a mixture of multivariate Student t distributions at the
modes, or the prior where there is none. One stage of `calibration.sampling.bridging` leads from q to p L. A
move runs the filter over the whole log again with the same sample sets, which makes L a function of x. The estimate
of the evidence is that of the log, x integrated out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.sampling.bridging import BridgeSampler
from stereophd.core.calibration.settings import TemperedSettings
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.parameters import ParameterSet

# Log-likelihoods (k,) of parameter values (k, m).
LogLikelihood = Callable[[Array], Array]


@dataclass(frozen=True)
class TemperedPath:
    """One stage, from the modes to the posterior."""

    parameters: ParameterSet  # Unknowns and their priors
    # Evidence of parameter values, (k, m) -> (k,): `stereophd.core.calibration.sampling.likelihood.LogEvidence`.
    log_likelihood: LogLikelihood
    modes: Modes | None  # Without them the particles start from the prior, which takes many more steps
    settings: TemperedSettings

    @property
    def particles(self) -> tuple[int, ...]:
        """Number of particles of the one stage."""
        return (self.settings.particles,)

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations (m,)."""
        return self.parameters.prior_std

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draw values (count, m) from the modes, or from the prior."""
        if self.modes is None:
            return self.parameters.sample(rng, count)
        return self.modes.draw(count, self.settings.spread, rng)

    def log_densities(self, values: Array, stage: int, begin: bool) -> tuple[Array, Array]:
        """Log-densities (k,) of the proposal and of the posterior, the latter not normalised."""
        prior = self.parameters.log_prior(values)
        first = prior if self.modes is None else self.modes.log_density(values, self.settings.spread)
        return first, prior + self.log_likelihood(values)


def tempered_sampler(path: TemperedPath, seed: np.random.SeedSequence) -> BridgeSampler:
    """Return the sampler of a path, with the settings of posterior smc."""
    return BridgeSampler(path, path.settings.resample_below, path.settings.moves, seed)
