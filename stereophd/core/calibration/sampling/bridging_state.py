"""State and outcome of a bridging sampler; see `stereophd.core.calibration.sampling.bridging`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers


@dataclass(frozen=True)
class BridgeState:
    """State after a step."""

    values: Array  # (k, m)
    # `log_begin`, `log_end`: arrays (k,): Log-densities of each particle at the beginning and at the end of the
    # stage.
    log_begin: Array
    log_end: Array
    ancestors: Integers  # (k,) of int: First particle that each descends from
    stage: int  # Stage of the path, from 0
    temperature: float  # How far the particles are through the stage, 0 to 1
    moves_left: int  # Moves to make before the next tempering step
    step_size: float  # Factor of the proposals, in units of `OPTIMAL_STEP` / sqrt(m)
    log_evidence: float  # Estimate so far
    n_steps: int  # Steps so far: picks the random numbers

    @property
    def stage_done(self) -> bool:
        """Whether the particles represent the density at the end of the stage."""
        return self.temperature >= 1.0 and self.moves_left == 0


@dataclass(frozen=True)
class BridgeInfo:
    """Diagnostics of a step."""

    kind: str  # ``temper`` or ``move``
    stage: int
    temperature: float  # After the step
    # Effective sample size of the weights of a tempering step before resampling; NaN of a move.
    effective_sample_size: float
    acceptance: float  # Share of particles moved; NaN of a tempering step
    step_size: float  # Factor of the proposals in the step
    # `mean`, `covariance`: arrays (m,), (m, m): Moments of the particles after the step.
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class BridgeResult:
    """Outcome of a run."""

    values: Array  # (k, m): Particles of the last density, all of the same weight
    log_densities: Array  # (k,): The last log-density of each
    log_evidence: float  # Logarithm of the ratio of the integrals of the last density and the first
    acceptance: float  # Share of accepted proposals of the moves at the last density itself
    effective_sample_size: float  # The smallest of the tempering steps, as a share of the particles
    # First particles that still have descendants: few mean that the first density missed most of the last.
    ancestors: int
    history: tuple[BridgeInfo, ...]

    @property
    def log_weights(self) -> Array:
        """Normalised log-weights (k,), all equal."""
        return np.full(len(self.values), -np.log(len(self.values)))
