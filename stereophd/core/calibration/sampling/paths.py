"""Paths of densities from the prior, or from known modes, to the posterior of the cameras: see `sampling.bridging`.

The likelihood of a log conditional on the cameras, L(z_1..z_n | s), is a deterministic function of s, so particles of
static cameras need no jitter. Metropolis moves replace it: each runs the conditional filter again from the first event
and leaves the posterior invariant.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.recording_evidence import RecordingEvidence
from stereophd.core.calibration.settings import SequentialSettings, TemperedSettings
from stereophd.core.calibration.unknowns.modes import Modes
from stereophd.core.calibration.unknowns.parameters import ParameterSet

LogEvidence = Evidence | RecordingEvidence
# The last stage may add more events than those so far, by this factor, so that no short one is left.
LAST_GROWTH = 2.5


@dataclass(frozen=True)
class Stage:
    """What a density counts: the first events of a log, at a factor on the noise of the detections."""

    n_events: int
    inflation: float
    particles: int  # That lead there


@dataclass(frozen=True)
class DensityPath:
    """The densities p(s) L_k(first events | s) at the ends of stages, with factors k on the noise of the detections.

    L is the multi-object evidence of the filters conditional on s. A move runs the filter again with the same sample
    sets, which makes L a function of s. Each particle always carries the intensity of the filter conditional on it:
    moves recompute it, resampling copies it. The first density is the prior, or that of modes which another method has
    found. The estimate of the evidence is that of the log, s integrated out.
    """

    evidence: LogEvidence  # Evidence of the whole log
    stages: tuple[Stage, ...]
    modes: Modes | None = None  # Without them the particles start from the prior, which takes many more steps
    spread: float = 1.0  # Factor on the standard deviations of the modes

    @property
    def parameters(self) -> ParameterSet:
        """Unknowns and their priors."""
        return self.evidence.parameters

    def draw(self, rng: np.random.Generator) -> Array:
        """Draw the values (k, m) of the first stage's particles from the modes, or from the prior."""
        count = self.stages[0].particles
        if self.modes is None:
            return self.parameters.sample(rng, count)
        return self.modes.draw(count, self.spread, rng)

    def log_densities(self, values: Array, stage: int, begin: bool) -> tuple[Array, Array]:
        """Log-densities (k,) at the beginning and the end of a stage.

        Both are of values (k, m), up to a constant. With `begin` False the first is not needed, and any array will do.
        """
        prior = self.parameters.log_prior(values)
        end = self.stages[stage]
        if stage == 0:
            first = prior if self.modes is None else self.modes.log_density(values, self.spread)
            return first, prior + self._likelihoods(values, end)[0]
        start = self.stages[stage - 1]
        if start.inflation != end.inflation:
            before = self._likelihoods(values, start)[0] if begin else np.zeros(len(values))
            return prior + before, prior + self._likelihoods(values, end)[0]
        before, whole = self._likelihoods(values, start, end)
        return prior + before, prior + whole

    def _likelihoods(self, values: Array, *stages: Stage) -> Array:
        """Evidence (s, k) after the events of stages of one factor on the noise, in one run."""
        return self.evidence.after(values, [stage.n_events for stage in stages], stages[-1].inflation)


def growing_path(evidence: LogEvidence, settings: SequentialSettings) -> DensityPath:
    """Return the single-cluster PHD filter of the paper (section VII-B) with moves: the posterior as the log grows.

    Of a wide prior few particles fit the first events. Tempering the likelihood leads into wrong modes. Inflating the
    noise of the detections does not, because detections with wide noise find their objects with any cameras. From the
    prior the path therefore leads over the first block at falling factors on the noise, down to 1, and then at this one
    to twice as many events from stage to stage, to the whole log. There are more particles while the noise is inflated.
    """
    count, many = evidence.n_events, max(settings.first_particles, settings.particles)
    first = min(settings.block_events, count)
    stages = [Stage(first, k, many if k > 1.0 else settings.particles) for k in settings.inflation]
    if not stages or stages[-1].inflation != 1.0:
        stages.append(Stage(first, 1.0, settings.particles))
    # the cost of a stage is that of its events, and a bridge takes as many steps as the data need
    while first < count:
        first = count if LAST_GROWTH * first >= count else 2 * first
        stages.append(Stage(first, 1.0, settings.particles))
    return DensityPath(evidence, tuple(stages))


def tempered_path(evidence: LogEvidence, modes: Modes | None, settings: TemperedSettings) -> DensityPath:
    """Return the path of one stage from modes, or from the prior, to the posterior of the whole log."""
    return DensityPath(evidence, (Stage(evidence.n_events, 1.0, settings.particles),), modes, settings.spread)
