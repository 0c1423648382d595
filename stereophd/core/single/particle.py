"""Particle filter in world space: what the paper compares disparity space with (VIII-A, VIII-B; its [3]).

Sequential importance resampling with the motion as proposal. Particles are positions (and velocities) in the world:
they start on the ray of the first detection, at depths from the prior on disparity of which only positive values have a
place in the world. Weights are logarithms, or plain numbers (``linear``). Plain numbers underflow if all particles of a
prior are more than 38 standard deviations from a detection; the filter then keeps its earlier weights.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.world_moments import states_in_world
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.resampling import SCHEMES
from stereophd.core.numerics.weights import normalised
from stereophd.core.single.base import SingleEstimate, SingleEstimator, SingleState
from stereophd.core.single.settings import ParticleSettings

# A prior of disparity that has less than one sample in this many at positive values is refused.
MOST_DRAWS = 1000


@dataclass(frozen=True)
class ParticleState(SingleState):
    """Weighted particles."""

    particles: Array  # (d, n): In the world, at the time of the last detection; empty before the first
    weights: Array  # (n,): Sum to 1
    log_weights: Array  # (n,): Their logarithms, to a constant; of weights kept as numbers not used


@compiled
def log_likelihoods(particles: Array, camera: Array, point: Array, noise: Array) -> Array:
    """Logarithms (n,) of the density of a detection given each particle (d, n); -inf behind the camera."""
    out = np.empty(particles.shape[1])
    determinant = noise[0, 0] * noise[1, 1] - noise[0, 1] * noise[0, 1]
    p00, p01, p11 = noise[1, 1] / determinant, -noise[0, 1] / determinant, noise[0, 0] / determinant
    constant = -math.log(2.0 * math.pi) - 0.5 * math.log(determinant)
    r = camera[ROTATION : ROTATION + 9]
    cx, cy, cz = camera[CENTER], camera[CENTER + 1], camera[CENTER + 2]
    for i in range(particles.shape[1]):
        x, y, z = particles[0, i] - cx, particles[1, i] - cy, particles[2, i] - cz
        depth = r[6] * x + r[7] * y + r[8] * z
        du = camera[FX] * (r[0] * x + r[1] * y + r[2] * z) / depth + camera[CX] - point[0]
        dv = camera[FY] * (r[3] * x + r[4] * y + r[5] * z) / depth + camera[CY] - point[1]
        squared = p00 * du * du + 2.0 * p01 * du * dv + p11 * dv * dv
        out[i] = constant - 0.5 * squared if depth > 0.0 else -np.inf
    return out


@compiled
def _disturb(particles: Array, index: NDArray[np.int64], motion: MotionArrays, normal: Array) -> Array:
    """Pick particles (6, n) and move them by the only interval of `motion`; `normal` (6, n)."""
    out = np.empty(particles.shape)
    std, limit, drift = motion.noise_std, motion.max_speed, motion.drift[0]
    velocity_scale, position_scale = motion.velocity_noise[0], motion.position_noise[0]
    for i in range(particles.shape[1]):
        k = index[i]
        speed = math.sqrt(particles[3, k] ** 2 + particles[4, k] ** 2 + particles[5, k] ** 2)
        slow = limit / speed if speed > limit else 1.0
        for a in range(3):
            velocity = slow * particles[3 + a, k]
            shock = std[a] * normal[a, i]
            position_shock = position_scale * (
                motion.with_velocity[0] * shock + motion.alone[0] * std[a] * normal[3 + a, i]
            )
            out[a, i] = particles[a, k] + motion.reach[0] * velocity + position_shock + drift[a]
            out[3 + a, i] = motion.keep[0] * velocity + velocity_scale * shock + drift[3 + a]
    return out


def _moments(particles: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (6,) and covariance (6, 6) of weighted particles (d, n)."""
    size = len(particles)
    mean, covariance = np.zeros(6), np.zeros((6, 6))
    mean[:size] = particles @ weights
    covariance[:size, :size] = np.cov(particles, aweights=weights, ddof=0)
    return mean, covariance


@dataclass(frozen=True)
class ParticleEstimator(SingleEstimator[ParticleState]):
    """The particle filter."""

    settings: ParticleSettings
    seed: int  # Seed of all random numbers: those of an event are drawn from the seed and the number of the event

    def init(self) -> ParticleState:
        """Return the state before the first detection."""
        return ParticleState(0.0, 0.0, 0, np.empty((self.state_size, 0)), np.empty(0), np.empty(0))

    def _detected(self, state: ParticleState, event: Event, space: Array, time_s: float) -> tuple[ParticleState, float]:
        """Resample, if due, move the particles to the event's time, and weigh them by its detection."""
        rng = np.random.default_rng((self.seed, state.n_events))
        if len(state.weights) == 0:
            particles = self._first(event, space, rng)
            weights = np.full(particles.shape[1], 1.0 / particles.shape[1])
            log_weights, log_likelihood = np.log(weights), self.first_density(event)
        else:
            particles, weights, log_weights = self._predict(state, time_s, rng)
            likelihood = log_likelihoods(particles, space, event.points[0], event.covariances[0])
            weights, log_weights, evidence = self._update(weights, log_weights, likelihood)
            log_likelihood = evidence + math.log(event.areas[0])
        after = ParticleState(event.time_s, time_s, state.n_events + 1, particles, weights, log_weights)
        return after, log_likelihood

    def _first(self, event: Event, space: Array, rng: np.random.Generator) -> Array:
        """Particles (d, n) on the ray of the first detection."""
        count, size = self.settings.particles, self.state_size
        means, covariances = self.prior.moments(event.points, event.covariances, space, size)
        states = np.empty((count, size))
        states[:, :2] = rng.multivariate_normal(means[0, :2], covariances[0, :2, :2], count)
        states[:, 2] = _positive_normals(*self.prior.disparity_moments(space), count, rng)
        in_disparity = size == 6 and self.prior.disparity_velocity_std_px_s is not None
        if size == 6:
            stds = self.prior.disparity_velocity_std_px_s if in_disparity else (0.0, 0.0, 0.0)
            states[:, 3:] = rng.standard_normal((count, 3)) * np.array(stds)
        particles = states_in_world(states, space, self.motion.arrays(np.zeros(1))).T[:size].copy()
        if size == 6 and not in_disparity:
            particles[3:] = rng.standard_normal((3, count)) * self.prior.velocity_spread
        return particles

    def _predict(self, state: ParticleState, time_s: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Particles, weights and their logarithms at a time, resampled first if few particles carry the weight."""
        count = len(state.weights)
        dt = time_s - state.home_s
        # the effective number of particles
        due = 1.0 / np.dot(state.weights, state.weights) < self.settings.resample_below * count
        index = np.arange(count)
        weights, log_weights = state.weights, state.log_weights
        if due:
            index = SCHEMES[self.settings.resampling](weights, rng.random(count + 1))
            weights = np.full(count, 1.0 / count)
            log_weights = np.log(weights)
        particles = state.particles
        if due and self.settings.regularised:
            particles, index = particles[:, index] + self._kernel(state, rng), np.arange(count)
        if self.motion.moves and dt != 0.0:
            normal = rng.standard_normal((6, count))
            particles = _disturb(particles, index, self.motion.arrays(np.array([dt])), normal)
        elif due:
            particles = np.ascontiguousarray(particles[:, index])
        return particles, weights, log_weights

    def _kernel(self, state: ParticleState, rng: np.random.Generator) -> Array:
        """Draws (d, n) of the Gaussian kernel of least error for a Gaussian (Musso, Oudjane and Le Gland 2001)."""
        size, count = state.particles.shape
        width = (4.0 / (count * (size + 2.0))) ** (1.0 / (size + 4.0))
        covariance = _moments(state.particles, state.weights)[1][:size, :size]
        values, vectors = np.linalg.eigh(covariance)
        factor = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(width * factor @ rng.standard_normal((size, count)))

    def _update(self, weights: Array, log_weights: Array, log_likelihood: Array) -> tuple[Array, Array, float]:
        """Weights and their logarithms after a detection, and the logarithm of its predicted density."""
        if self.settings.weights == "linear":
            updated = weights * np.exp(log_likelihood)
            total = float(updated.sum())
            if total > 0.0:
                return updated / total, log_weights, math.log(total)
        elif log_likelihood.max() > -np.inf:
            log_weights, evidence = normalised(log_weights + log_likelihood)
            return np.exp(log_weights), log_weights, evidence
        # no particle can have made the detection: the smallest number there is
        return weights, log_weights, math.log(np.finfo(float).tiny)

    def estimate(self, state: ParticleState) -> SingleEstimate | None:
        """Return the weighted mean and covariance, and the particle of the largest weight."""
        if len(state.weights) == 0:
            return None
        mean, covariance = _moments(state.particles, state.weights)
        mode = np.zeros(6)
        mode[: self.state_size] = state.particles[:, int(np.argmax(state.weights))]
        dt = state.time_s - state.home_s
        if dt != 0.0:
            transition = self.motion.transition(dt)
            mean, covariance = transition.predict(mean, covariance)
            mode = transition.matrix @ mode + transition.drift
        return SingleEstimate(mean, mode, covariance)


def _positive_normals(mean: float, std: float, count: int, rng: np.random.Generator) -> Array:
    """Draws (n,) of a normal distribution given that it is positive."""
    out = np.empty(0)
    for _ in range(MOST_DRAWS):
        draws = mean + std * rng.standard_normal(count)
        out = np.concatenate([out, draws[draws > 0.0]])
        if len(out) >= count:
            return out[:count]
    raise ValueError(f"prior: expected positive disparities to be likely, found mean {mean:g} and std {std:g} px")
