"""Sequential Monte Carlo along a path of densities: particles that are tempered, resampled and moved.

A path f_0, f_1, ..., f_n begins with a density that can be drawn from and ends with the one that is wanted. Stage j
leads from f_(j-1) to f_j along the bridge

    pi_b(x)  proportional to  f_(j-1)(x)^(1 - b) f_j(x)^b,      0 = b_0 < b_1 < ... = 1

(P. Del Moral, A. Doucet and A. Jasra, "Sequential Monte Carlo samplers", 2006). Every step of b is as large as leaves
the wanted effective number of particles. The particles are then resampled, and moved by Metropolis-Hastings with pi_b
as the invariant density. Proposals are Gaussian, with the covariance of the particles times a factor that follows the
acceptance. Where modes are known, each mode has the covariance of its own particles; a particle belongs to the mode
that is nearest in the mode's covariance. The acceptance ratio of a move between modes includes both proposal densities,
so that detailed balance holds. The product of the mean incremental weights estimates the ratio of the integrals of f_n
and f_0.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.sampling.paths import DensityPath
from stereophd.core.numerics.resampling import systematic
from stereophd.core.numerics.weights import effective_sample_size, normalised, step_generator, weighted_mean_covariance


@dataclass(frozen=True)
class BridgeState:
    """State after a step."""

    values: Array  # (k, m)
    # `log_begin`, `log_end`: arrays (k,): Log-densities of each particle at the beginning and at the end of the
    # stage.
    log_begin: Array
    log_end: Array
    # (k,) of int: First particle that each descends from; few of them mean that the first density missed most of the
    # last.
    ancestors: Integers
    stage: int  # Stage of the path, from 0
    temperature: float  # How far the particles are through the stage, 0 to 1
    moves_left: int  # Moves to make before the next tempering step
    step_size: float  # Factor of the proposals, in units of `OPTIMAL_STEP` / sqrt(m)
    log_evidence: float  # Estimate so far
    n_steps: int  # Steps so far: picks the random numbers

    @property
    def log_weights(self) -> Array:
        """Normalised log-weights (k,), all equal."""
        return np.full(len(self.values), -np.log(len(self.values)))

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


# Of Gaussian random walks in m dimensions: 2.38 / sqrt(m) moves best (G. O. Roberts, A. Gelman, W. R. Gilks 1997).
OPTIMAL_STEP = 2.38
# The acceptance that the factor of the proposals is steered to, and how fast.
TARGET_ACCEPTANCE, ADAPTATION = 0.3, 1.0
SMALLEST_STEP, LARGEST_STEP = 0.05, 4.0
# Bisections of a tempering step: b to about one part in a million million.
BISECTIONS = 40


@dataclass(frozen=True)
class BridgeSampler:
    """The sampler of one problem."""

    path: DensityPath
    resample_below: float  # A tempering step keeps the effective sample size at this share of the particles
    moves: int  # Metropolis-Hastings moves after each tempering step
    seed: np.random.SeedSequence

    def init(self) -> BridgeState:
        """Draw the particles from the first density."""
        values = self.path.draw(step_generator(self.seed, 0))
        begin, end = self.path.log_densities(values, 0, True)
        return BridgeState(values, begin, end, np.arange(len(values)), 0, 0.0, 0, 1.0, 0.0, 1)

    def done(self, state: BridgeState) -> bool:
        """Whether the particles represent the last density."""
        return state.stage_done and state.stage == len(self.path.stages) - 1

    def progress(self, state: BridgeState) -> tuple[int, int]:
        """Return how many thousandths of a stage are done, of those of all stages."""
        return int(1000 * (state.stage + state.temperature)), 1000 * len(self.path.stages)

    def step(self, state: BridgeState) -> tuple[BridgeState, BridgeInfo]:
        """Make a move, or a tempering step when none is left."""
        rng = step_generator(self.seed, state.n_steps)
        if state.moves_left > 0:
            return self._move(state, rng)
        return self._temper(self._next_stage(state) if state.stage_done else state, rng)

    def _next_stage(self, state: BridgeState) -> BridgeState:
        stage = state.stage + 1
        _, end = self.path.log_densities(state.values, stage, False)
        return replace(state, stage=stage, temperature=0.0, log_begin=state.log_end, log_end=end)

    def _temper(self, state: BridgeState, rng: np.random.Generator) -> tuple[BridgeState, BridgeInfo]:
        """Raise the temperature as far as the effective number of particles allows, and resample."""
        gain = state.log_end - state.log_begin
        rise = temperature_rise(gain, 1.0 - state.temperature, self.resample_below)
        log_weights, total = normalised(rise * gain)
        chosen = systematic(np.exp(log_weights), rng.random(1), self.path.stages[state.stage].particles)
        temperature = 1.0 if rise >= 1.0 - state.temperature else state.temperature + rise
        after = replace(
            state,
            values=state.values[chosen],
            log_begin=state.log_begin[chosen],
            log_end=state.log_end[chosen],
            ancestors=state.ancestors[chosen],
            temperature=temperature,
            moves_left=self.moves,
            log_evidence=state.log_evidence + total - float(np.log(len(gain))),
            n_steps=state.n_steps + 1,
        )
        share = effective_sample_size(log_weights) / len(gain)
        return after, _info("temper", after, share, float("nan"), state.step_size)

    def _move(self, state: BridgeState, rng: np.random.Generator) -> tuple[BridgeState, BridgeInfo]:
        count, size = state.values.shape
        factors = state.step_size * OPTIMAL_STEP / np.sqrt(size) * self._proposal_factors(state.values)
        mode = self._mode_of(state.values)
        noise = rng.standard_normal((count, size))
        proposed = state.values + np.einsum("kab,kb->ka", factors[mode], noise)
        proposed_mode = self._mode_of(proposed)
        begin, end = self.path.log_densities(proposed, state.stage, state.temperature < 1.0)
        change = _bridge(begin, end, state.temperature)
        change -= _bridge(state.log_begin, state.log_end, state.temperature)
        difference = proposed - state.values
        change += _log_normal(difference, factors[proposed_mode]) - _log_normal(difference, factors[mode])
        # a NaN is no reason to move
        accepted = np.log(rng.random(count)) < change
        acceptance = float(accepted.mean())
        scale = state.step_size * np.exp(ADAPTATION * (acceptance - TARGET_ACCEPTANCE))
        after = replace(
            state,
            values=np.where(accepted[:, None], proposed, state.values),
            log_begin=np.where(accepted, begin, state.log_begin),
            log_end=np.where(accepted, end, state.log_end),
            moves_left=state.moves_left - 1,
            step_size=float(np.clip(scale, SMALLEST_STEP, LARGEST_STEP)),
            n_steps=state.n_steps + 1,
        )
        return after, _info("move", after, float("nan"), acceptance, state.step_size)

    def _mode_of(self, values: Array) -> Integers:
        modes = self.path.modes
        return np.zeros(len(values), dtype=np.int64) if modes is None else modes.nearest(values)

    def _proposal_factors(self, values: Array) -> Array:
        """Cholesky factors (j, m, m) of the covariance of each mode's particles.

        A mode with too few particles takes its own covariance. In a direction in which the particles do not differ
        no proposal would ever move, so a millionth of the prior's standard deviation is added.
        """
        modes, prior_std = self.path.modes, self.path.parameters.prior_std
        size = len(prior_std)
        covariances = np.empty((1, size, size)) if modes is None else modes.covariances.copy()
        which = self._mode_of(values)
        for mode in range(len(covariances)):
            members = values[which == mode]
            if modes is None or len(members) >= 3 * size:
                covariances[mode] = _moments(members)[1]
        return np.asarray(np.linalg.cholesky(covariances + np.diag(1e-12 * prior_std**2)))


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


def _bridge(begin: Array, end: Array, temperature: float) -> Array:
    """Log-density (k,) of the bridge; at its end the density at its beginning may be missing."""
    return end.copy() if temperature >= 1.0 else np.asarray((1.0 - temperature) * begin + temperature * end)


def _moments(values: Array) -> tuple[Array, Array]:
    return weighted_mean_covariance(values, np.full(len(values), -np.log(len(values))))


def _info(kind: str, after: BridgeState, share: float, acceptance: float, step_size: float) -> BridgeInfo:
    return BridgeInfo(kind, after.stage, after.temperature, share, acceptance, step_size, *_moments(after.values))


def _log_normal(differences: Array, factors: Array) -> Array:
    """Log-density (k,) of N(0, L L^T) at differences (k, m), up to a constant; Cholesky factors L (k, m, m)."""
    scaled = np.linalg.solve(factors, differences[..., None])[..., 0]
    log_determinant = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    return np.asarray(-0.5 * (scaled**2).sum(axis=1) - log_determinant)


def acceptance_of(history: Sequence[BridgeInfo]) -> float:
    """Share of accepted proposals of the moves at the last density itself."""
    last = [info for info in history if info.stage == history[-1].stage and info.temperature >= 1.0]
    return float(np.mean([info.acceptance for info in last if info.kind == "move"]))


def least_effective(history: Sequence[BridgeInfo]) -> float:
    """Smallest effective sample size of the tempering steps, as a share of the particles."""
    return min(info.effective_sample_size for info in history if info.kind == "temper")
