"""Sequential calibration: the single-cluster PHD filter of the paper (section VII-B).

The joint first moment of cameras s and objects y is mu(y, s) = mu(y | s) p(s), eq. (6): particles s_k with weights
w_k stand for the cameras, and each carries the PHD filter conditional on it. An event with detections Z gives

    w_k  <-  w_k L^c(Z | s_k) / sum_j w_j L^c(Z | s_j),

with the multi-object likelihood L^c of the conditional filter. When the effective number of particles falls
below a fraction of their number they are resampled (systematically), intensities included.

Cameras that stand still leave resampled particles on top of one another. Roughening (N. J. Gordon, D. J. Salmond and
A. F. M. Smith, 1993) adds noise of the standard deviation K E_j N^(-1/m) to parameter j after resampling, E_j being the
range of the particles, m the number of parameters. It is jitter, and does not make up for a prior of which only a
particle or two fit the first frames, where the filter settles on a wrong pose (see calibration_methods.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.sampling.likelihood import hypothesis_spaces
from stereophd.core.calibration.settings import SequentialSettings
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.disparity.events import Event
from stereophd.core.multi.camera_hypotheses.batch import BatchState, FilterBatch
from stereophd.core.numerics.resampling import systematic
from stereophd.core.numerics.weights import effective_sample_size, normalised, step_generator, weighted_mean_covariance

# Streams of random numbers: the prior's draws, and then one for each event.
PRIOR_STREAM, FIRST_EVENT_STREAM = 0, 1


@dataclass(frozen=True)
class SequentialState:
    """State after an event: k camera particles, each with its conditional intensity."""

    values: Array  # (k, m): Parameter values
    log_weights: Array  # (k,): Normalised
    filters: BatchState  # Conditional intensities
    log_evidence: float  # Log-likelihood of all events so far, the cameras integrated out (product of mean weights)


@dataclass(frozen=True)
class SequentialInfo:
    """Diagnostics of an event."""

    time_s: float  # Of the event, s
    # `mean`, `covariance`: arrays (m,), (m, m): Moments of the particles, before resampling.
    mean: Array
    covariance: Array
    effective_sample_size: float  # Before resampling
    resampled: bool
    log_likelihood: float  # Log-likelihood of the event given those before, the cameras integrated out


@dataclass(frozen=True)
class SequentialSampler:
    """One pass over a log: the last state has the posterior, and there is one info for each event."""

    parameters: ParameterSet
    events: Sequence[Event]  # In order of time
    batch: FilterBatch
    settings: SequentialSettings
    seed: np.random.SeedSequence

    def init(self) -> SequentialState:
        """Draw the particles from the prior."""
        count = self.settings.particles
        values = self.parameters.sample(step_generator(self.seed, PRIOR_STREAM), count)
        return SequentialState(values, np.full(count, -np.log(count)), self.batch.init(count), 0.0)

    def done(self, state: SequentialState) -> bool:
        """Whether all events have been seen."""
        return state.filters.n_events == len(self.events)

    def progress(self, state: SequentialState) -> tuple[int, int]:
        """Return how many events have been seen, of how many."""
        return state.filters.n_events, len(self.events)

    def step(self, state: SequentialState) -> tuple[SequentialState, SequentialInfo]:
        """Move the cameras, update every conditional filter and the weights by the next event, resample if need be."""
        event, settings = self.events[state.filters.n_events], self.settings
        rng = step_generator(self.seed, FIRST_EVENT_STREAM + state.filters.n_events)
        values = state.values
        spaces = hypothesis_spaces(self.parameters, values, self.batch.template.rig)
        filters, log_likelihoods = self.batch.step(state.filters, event, spaces)
        log_weights, log_likelihood = normalised(state.log_weights + log_likelihoods)
        mean, covariance = weighted_mean_covariance(values, log_weights)
        effective = effective_sample_size(log_weights)
        resampled = effective < settings.resample_below * len(values)
        if resampled:
            chosen = systematic(np.exp(log_weights), rng.random(1))
            values, filters = roughened(values[chosen], settings.roughening, rng), filters.take(chosen)
            log_weights = np.full(len(values), -np.log(len(values)))
        after = SequentialState(values, log_weights, filters, state.log_evidence + log_likelihood)
        return after, SequentialInfo(event.time_s, mean, covariance, effective, resampled, log_likelihood)


def roughened(values: Array, factor: float, rng: np.random.Generator) -> Array:
    """Add the noise of Gordon, Salmond and Smith (1993) to particles (k, m)."""
    if factor == 0.0:
        return values
    count, size = values.shape
    std = factor * np.ptp(values, axis=0) * count ** (-1.0 / size)
    return np.asarray(values + std * rng.standard_normal(values.shape))
