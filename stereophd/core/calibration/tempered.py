"""Full posterior of the cameras: particles, tempered and moved by Metropolis-Hastings (sequential Monte Carlo).

The posterior of the parameters x given a log Z is p(x) L(Z | x), with the multi-object evidence L of the filters
conditional on x. Particles are drawn from a proposal q: a mixture of multivariate Student t distributions at the
modes that another method has found, or the prior where there is none. The densities

    pi_b(x)  proportional to  q(x)^(1 - b) (p(x) L(Z | x))^b,      0 = b_0 < b_1 < ... = 1,

lead from one to the other (P. Del Moral, A. Doucet and A. Jasra, "Sequential Monte Carlo samplers", 2006): every
step of b is as large as leaves the wanted effective number of particles; they are resampled; and they are moved by
Metropolis-Hastings, the filter re-run over the whole log with the same sample sets, which makes L a function of x.
Proposals are Gaussian, with the covariance of the particles times a factor that follows the acceptance. The
covariance is taken from the particles of each mode by itself (a particle belongs to the mode that it is nearest to in
the mode's covariance); where a move changes mode the two proposal densities enter the acceptance, so that detailed
balance holds. The product of the mean incremental weights estimates the log's evidence, x integrated out.

The sampler is `init` and `step` over a frozen state of arrays; random numbers depend on the seed and the step's
number alone, so a run continued from any state gives what it would have given.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.modes import Modes
from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.settings import TemperedSettings
from stereophd.core.calibration.tempered_state import TemperedInfo, TemperedResult, TemperedState
from stereophd.core.numerics.resampling import systematic
from stereophd.core.numerics.weights import (
    effective_sample_size,
    normalised,
    step_generator,
    weighted_mean_covariance,
)

__all__ = [
    "Modes",
    "TemperedInfo",
    "TemperedResult",
    "TemperedSampler",
    "TemperedSettings",
    "TemperedState",
    "run",
    "temperature_rise",
]

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Log-likelihoods (k,) of parameter values (k, m).
LogLikelihood = Callable[[Array], Array]

# Of Gaussian random walks in m dimensions: 2.38 / sqrt(m) moves best (G. O. Roberts, A. Gelman, W. R. Gilks 1997).
OPTIMAL_STEP = 2.38
# The acceptance that the factor of the proposals is steered to, and how fast.
TARGET_ACCEPTANCE, ADAPTATION = 0.3, 1.0
SMALLEST_STEP, LARGEST_STEP = 0.05, 4.0
# Bisections of a tempering step: b to about one part in a million million.
BISECTIONS = 40


# Called after every step with the state and the history so far.
AfterStep = Callable[[TemperedState, Sequence[TemperedInfo]], None]


@dataclass(frozen=True)
class TemperedSampler:
    """The sampler of one problem.

    Attributes
    ----------
    parameters : ParameterSet
        Unknowns and their priors.
    log_likelihood : callable
        Evidence of parameter values, (k, m) -> (k,): `stereophd.core.calibration.likelihood.Evidence`.
    modes : Modes or None
        Without them the particles start from the prior, which takes many more steps.
    settings : TemperedSettings
    seed : SeedSequence
    """

    parameters: ParameterSet
    log_likelihood: LogLikelihood
    modes: Modes | None
    settings: TemperedSettings
    seed: np.random.SeedSequence

    def init(self) -> TemperedState:
        """Draw the particles from the proposal."""
        count = self.settings.particles
        rng = step_generator(self.seed, 0)
        if self.modes is None:
            values = self.parameters.sample(rng, count)
        else:
            values = self.modes.draw(count, self.settings.spread, rng)
        log_likelihoods = self.log_likelihood(values)
        return TemperedState(values, log_likelihoods, np.arange(count), 0.0, 0, 1.0, 0.0, 1)

    def step(self, state: TemperedState) -> tuple[TemperedState, TemperedInfo]:
        """Make a move, or a tempering step when none is left."""
        rng = step_generator(self.seed, state.n_steps)
        return self._move(state, rng) if state.moves_left > 0 else self._temper(state, rng)

    def _temper(self, state: TemperedState, rng: np.random.Generator) -> tuple[TemperedState, TemperedInfo]:
        """Raise the temperature as far as the effective number of particles allows, and resample."""
        gain = self.parameters.log_prior(state.values) + state.log_likelihoods - self.log_proposal(state.values)
        rise = temperature_rise(gain, 1.0 - state.temperature, self.settings.resample_below)
        log_weights, total = normalised(rise * gain)
        chosen = systematic(np.exp(log_weights), rng.random(1))
        temperature = 1.0 if rise >= 1.0 - state.temperature else state.temperature + rise
        after = replace(
            state,
            values=state.values[chosen],
            log_likelihoods=state.log_likelihoods[chosen],
            ancestors=state.ancestors[chosen],
            temperature=temperature,
            moves_left=self.settings.moves,
            log_evidence=state.log_evidence + total - float(np.log(len(chosen))),
            n_steps=state.n_steps + 1,
        )
        effective = effective_sample_size(log_weights)
        return after, TemperedInfo("temper", temperature, effective, float("nan"), state.step_size)

    def _move(self, state: TemperedState, rng: np.random.Generator) -> tuple[TemperedState, TemperedInfo]:
        """Move every particle once."""
        count, size = state.values.shape
        factors = state.step_size * OPTIMAL_STEP / np.sqrt(size) * self._proposal_factors(state.values)
        here = self._mode_of(state.values)
        noise = rng.standard_normal((count, size))
        proposed = state.values + np.einsum("kab,kb->ka", factors[here], noise)
        there = self._mode_of(proposed)
        log_likelihoods = self.log_likelihood(proposed)
        change = self._log_target(proposed, log_likelihoods, state.temperature)
        change -= self._log_target(state.values, state.log_likelihoods, state.temperature)
        difference = proposed - state.values
        change += _log_normal(difference, factors[there]) - _log_normal(difference, factors[here])
        # a NaN is no reason to move
        accepted = np.log(rng.random(count)) < change
        acceptance = float(accepted.mean())
        scale = state.step_size * np.exp(ADAPTATION * (acceptance - TARGET_ACCEPTANCE))
        after = replace(
            state,
            values=np.where(accepted[:, None], proposed, state.values),
            log_likelihoods=np.where(accepted, log_likelihoods, state.log_likelihoods),
            moves_left=state.moves_left - 1,
            step_size=float(np.clip(scale, SMALLEST_STEP, LARGEST_STEP)),
            n_steps=state.n_steps + 1,
        )
        return after, TemperedInfo("move", state.temperature, float("nan"), acceptance, state.step_size)

    def _log_target(self, values: Array, log_likelihoods: Array, temperature: float) -> Array:
        posterior = self.parameters.log_prior(values) + log_likelihoods
        if temperature >= 1.0:
            return np.asarray(posterior)
        return np.asarray((1.0 - temperature) * self.log_proposal(values) + temperature * posterior)

    def log_proposal(self, values: Array) -> Array:
        """Log-density (k,) of the distribution of the first particles at values (k, m)."""
        if self.modes is None:
            return self.parameters.log_prior(values)
        return self.modes.log_density(values, self.settings.spread)

    def _mode_of(self, values: Array) -> Integers:
        return np.zeros(len(values), dtype=np.int64) if self.modes is None else self.modes.nearest(values)

    def _proposal_factors(self, values: Array) -> Array:
        """Cholesky factors (j, m, m) of the covariance of each mode's particles.

        A mode with too few particles to tell takes its own covariance; in a direction in which the particles do
        not differ nothing would ever move, so a millionth of the prior's variance is added.
        """
        size = self.parameters.size
        covariances = np.empty((1, size, size)) if self.modes is None else self.modes.covariances.copy()
        which = self._mode_of(values)
        for mode in range(len(covariances)):
            members = values[which == mode]
            if self.modes is None or len(members) >= 3 * size:
                equal = np.full(len(members), -np.log(len(members)))
                covariances[mode] = weighted_mean_covariance(members, equal)[1]
        return np.asarray(np.linalg.cholesky(covariances + np.diag(1e-12 * self.parameters.prior_std**2)))


def temperature_rise(gain: Array, most: float, fraction: float) -> float:
    """Largest rise of the temperature, up to `most`, that leaves a fraction of the particles effective.

    `gain` (k,) is the log-weight per unit of temperature.
    """

    def enough(rise: float) -> bool:
        return effective_sample_size(normalised(rise * gain)[0]) >= fraction * len(gain)

    if enough(most):
        return most
    low, high = 0.0, most
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    # at least a little, so that the sampler ends
    return max(low, 1e-9 * most)


def _log_normal(differences: Array, factors: Array) -> Array:
    """Log-density (k,) of N(0, L L^T) at differences (k, m), up to a constant; Cholesky factors L (k, m, m)."""
    scaled = np.linalg.solve(factors, differences[..., None])[..., 0]
    log_determinant = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(-0.5 * (scaled**2).sum(axis=1) - log_determinant)


def run(
    sampler: TemperedSampler,
    resume: tuple[TemperedState, Sequence[TemperedInfo]] | None = None,
    after_step: AfterStep | None = None,
) -> TemperedResult:
    """Sample the posterior.

    Parameters
    ----------
    sampler : TemperedSampler
    resume : tuple, optional
        State and history that `after_step` was given: the run continues there, to the same result.
    after_step : callable, optional
        For progress and checkpoints; an exception that it raises ends the run.

    Returns
    -------
    TemperedResult
    """
    state = sampler.init() if resume is None else resume[0]
    history: list[TemperedInfo] = [] if resume is None else list(resume[1])
    while not state.done:
        state, info = sampler.step(state)
        history.append(info)
        if after_step is not None:
            after_step(state, history)
    moves = [info.acceptance for info in history if info.kind == "move" and info.temperature >= 1.0]
    return TemperedResult(
        values=state.values,
        log_posteriors=sampler.parameters.log_prior(state.values) + state.log_likelihoods,
        log_evidence=state.log_evidence,
        acceptance=float(np.mean(moves)),
        effective_sample_size=min(info.effective_sample_size for info in history if info.kind == "temper"),
        ancestors=len(np.unique(state.ancestors)),
        history=tuple(history),
    )
