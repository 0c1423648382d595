"""State and outcome of tempered sampling; see `stereophd.core.calibration.tempered`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class TemperedState:
    """State after a step.

    Attributes
    ----------
    values : array (k, m)
    log_likelihoods : array (k,)
        Evidence of each particle.
    ancestors : array (k,) of int
        First particle that each descends from.
    temperature : float
        b above.
    moves_left : int
        Moves to make before the next tempering step.
    step_size : float
        Factor of the proposals, in units of `OPTIMAL_STEP` / sqrt(m).
    log_evidence : float
        Estimate so far.
    n_steps : int
        Steps so far: picks the random numbers.
    """

    values: Array
    log_likelihoods: Array
    ancestors: Integers
    temperature: float
    moves_left: int
    step_size: float
    log_evidence: float
    n_steps: int

    @property
    def done(self) -> bool:
        """Whether the particles stand for the posterior."""
        return self.temperature >= 1.0 and self.moves_left == 0


@dataclass(frozen=True)
class TemperedInfo:
    """What a step did.

    Attributes
    ----------
    kind : str
        ``temper`` or ``move``.
    temperature : float
        After the step.
    effective_sample_size : float
        Of the weights of a tempering step before resampling; NaN of a move.
    acceptance : float
        Share of particles moved; NaN of a tempering step.
    step_size : float
        Factor of the proposals in the step.
    """

    kind: str
    temperature: float
    effective_sample_size: float
    acceptance: float
    step_size: float


@dataclass(frozen=True)
class TemperedResult:
    """Outcome of a run.

    Attributes
    ----------
    values : array (k, m)
        Particles of the posterior, all of the same weight.
    log_posteriors : array (k,)
        Log-prior plus evidence of each.
    log_evidence : float
        Log-likelihood of the log, the cameras integrated out.
    acceptance : float
        Of the moves at the posterior itself (temperature 1).
    effective_sample_size : float
        The smallest of the tempering steps.
    ancestors : int
        First particles that still have descendants: few mean that the proposal missed most of the posterior.
    history : tuple of TemperedInfo
    """

    values: Array
    log_posteriors: Array
    log_evidence: float
    acceptance: float
    effective_sample_size: float
    ancestors: int
    history: tuple[TemperedInfo, ...]

    @property
    def log_weights(self) -> Array:
        """Normalised log-weights (k,), all equal."""
        return np.full(len(self.values), -np.log(len(self.values)))
