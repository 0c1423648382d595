"""Paths of densities from the prior, or from known modes, to the posterior of the cameras: see `sampling.bridging`.

The likelihood of a log conditional on the cameras, L(z_1..z_n | s), is a deterministic function of s, so particles of
static cameras need no jitter. Metropolis moves replace it: each runs the conditional filter again from the first event
and leaves the posterior invariant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.recording_evidence import RecordingEvidence
from stereophd.core.calibration.settings import SequentialSettings, TemperedSettings
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.parameters import ParameterSet

LogEvidence = Evidence | RecordingEvidence
# Log-likelihoods (k,) of parameter values (k, m).
LogLikelihood = Callable[[Array], Array]
# The last stage may add more events than those so far, by this factor, so that no short one is left.
LAST_GROWTH = 2.5


@dataclass(frozen=True)
class Stage:
    """What a density counts: the first events of a log, at a factor on the noise of the detections."""

    n_events: int
    inflation: float


@dataclass(frozen=True)
class BlockPath:
    """The single-cluster PHD filter of the paper (section VII-B) with moves: the posterior as the log grows.

    Of a wide prior few particles fit the first events. Tempering the likelihood leads into wrong modes. Inflating the
    noise of the detections does not, because detections with wide noise find their objects with any cameras. The path
    is therefore

        p(s),  p(s) L_k(first block | s) for falling factors k on the noise, down to 1,
        then p(s) L_1(events so far | s) for twice as many events from stage to stage, to the whole log.

    Each particle always carries the intensity of the filter conditional on it: moves recompute it, resampling copies
    it.
    """

    evidence: LogEvidence  # Evidence of the whole log
    settings: SequentialSettings

    modes = None

    @property
    def parameters(self) -> ParameterSet:
        """Unknowns and their priors."""
        return self.evidence.parameters

    @cached_property
    def stages(self) -> tuple[Stage, ...]:
        """What the density at the end of each stage counts."""
        count = self.evidence.n_events
        first = min(self.settings.block_events, count)
        annealed = [Stage(first, factor) for factor in self.settings.inflation]
        if not annealed or annealed[-1].inflation != 1.0:
            annealed.append(Stage(first, 1.0))
        # the cost of a stage is that of its events, and a bridge takes as many steps as the data need
        ends = []
        while first < count:
            first = count if LAST_GROWTH * first >= count else 2 * first
            ends.append(Stage(first, 1.0))
        return (*annealed, *ends)

    @cached_property
    def particles(self) -> tuple[int, ...]:
        """Number of particles in each stage: more while the noise is inflated."""
        settings = self.settings
        return tuple(
            max(settings.first_particles, settings.particles) if stage.inflation > 1.0 else settings.particles
            for stage in self.stages
        )

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Draw values (count, m) from the prior."""
        return self.parameters.sample(rng, count)

    def log_densities(self, values: Array, stage: int, begin: bool) -> tuple[Array, Array]:
        """Log-densities (k,) of the prior times the evidence at the beginning and the end of a stage.

        Both are of values (k, m), up to a constant. With `begin` False the first is not needed, and any array will do.
        """
        prior = self.parameters.log_prior(values)
        end = self.stages[stage]
        if stage == 0:
            return prior, prior + self._likelihoods(values, end)[0]
        start = self.stages[stage - 1]
        if start.inflation != end.inflation:
            before = self._likelihoods(values, start)[0] if begin else np.zeros(len(values))
            return prior + before, prior + self._likelihoods(values, end)[0]
        before, whole = self._likelihoods(values, start, end)
        return prior + before, prior + whole

    def _likelihoods(self, values: Array, *stages: Stage) -> Array:
        """Evidence (s, k) after the events of stages of one factor on the noise, in one run."""
        return self.evidence.after(values, [stage.n_events for stage in stages], stages[-1].inflation)


@dataclass(frozen=True)
class TemperedPath:
    """One stage, from modes that another method has found, or from the prior, to the posterior p(x) L(Z | x).

    L is the multi-object evidence of the filters conditional on x. A move runs the filter over the whole log again with
    the same sample sets, which makes L a function of x. The estimate of the evidence is that of the log, x integrated
    out.
    """

    parameters: ParameterSet  # Unknowns and their priors
    log_likelihood: LogLikelihood  # Evidence of parameter values
    modes: Modes | None  # Without them the particles start from the prior, which takes many more steps
    settings: TemperedSettings

    @property
    def particles(self) -> tuple[int, ...]:
        """Number of particles of the one stage."""
        return (self.settings.particles,)

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


DensityPath = BlockPath | TemperedPath
