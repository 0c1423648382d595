"""Motion models: `Motion`, their interface, and what it derives from a model's equations.

States are (x, y, z, vx, vy, vz) in the world, length and length/s. A model is a linear stochastic differential
equation that does not depend on the place, driven by white acceleration on the axes of the world. Over an interval of
any length and sign it is

    p' = p + reach v + drift_p + w_p,    v' = keep v + drift_v + w_v,

with scalars `reach` and `keep` (`Motion.flow`) and Gaussian noise of covariance
``noise_std^2 [[position, cross], [cross, velocity]]`` on each axis (`Motion.noise`). Everything else follows from
these two: transitions, what compiled moves read, drawn noise, and the interpolation between two states.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.motion.arrays import MotionArrays


class Flow(NamedTuple):
    """Mean motion over intervals: `reach` and `keep` (...), `drift` (..., 6)."""

    reach: Array
    keep: Array
    drift: Array


class Noise(NamedTuple):
    """Variance of position, covariance of position and velocity, variance of velocity; each (...), for unit noise."""

    position: Array
    cross: Array
    velocity: Array


class NoiseFactor(NamedTuple):
    """Factor of the noise of intervals (n,): see `stereophd.core.motion.arrays.MotionArrays`."""

    position_noise: Array
    velocity_noise: Array
    with_velocity: Array
    alone: Array


class Transition(NamedTuple):
    """``x' = matrix x + drift + w``, w of covariance `noise`: arrays (..., 6, 6), (..., 6, 6), (..., 6)."""

    matrix: Array
    noise: Array
    drift: Array

    def predict(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Return Gaussians (..., 6), (..., 6, 6) after the intervals."""
        spread = self.matrix @ covariance @ np.swapaxes(self.matrix, -1, -2) + self.noise
        return np.einsum("...ij,...j->...i", self.matrix, mean) + self.drift, spread


class Motion(ABC):
    """A motion model; a frozen dataclass."""

    state_size: ClassVar[int] = 6  # 6, or 3 for objects that have no velocity
    # Physical limit on the speed, length/s, for those who draw samples; `transition` is linear and ignores it.
    max_speed: float | None = None

    @property
    @abstractmethod
    def noise_std(self) -> Array:
        """Standard deviation (3,) of the mean white acceleration over 1 s, length/s^2; a new array."""

    @abstractmethod
    def flow(self, dt: Array) -> Flow:
        """Return the mean motion over intervals (...), s, of any sign."""

    @abstractmethod
    def noise(self, dt: Array) -> Noise:
        """Return the covariance of the noise over intervals (...), s.

        Backwards, x(t) = F x(t - tau) + w gives x(t - tau) = F^-1 x(t) - F^-1 w, whose noise has the covariance
        F^-1 Q(tau) F^-T. That w is independent of the later state x(t), as a backward prediction takes it, is exact
        for a diffuse prior.
        """

    @property
    def moves(self) -> bool:
        """Whether objects have a velocity."""
        return self.state_size == 6

    @property
    def noisy(self) -> bool:
        """Whether the motion is disturbed at all."""
        return bool(self.noise_std.any())

    @property
    def sample_rows(self) -> int:
        """Rows of a sample of a state and of the noise of its motion."""
        return 12 if self.moves else 3

    @property
    def speed_limit(self) -> float:
        """`max_speed`, infinity for none."""
        return math.inf if self.max_speed is None else float(self.max_speed)

    def transition(self, dt: Array | float) -> Transition:
        """Return the linear-Gaussian transitions over intervals (...), s, zero and negative included."""
        interval = np.asarray(dt, dtype=np.float64)
        flow, noise = self.flow(interval), self.noise(interval)
        matrix, spread = np.zeros((2, *interval.shape, 6, 6))
        place = np.arange(3)
        speed, variances = place + 3, self.noise_std**2
        matrix[..., place, place] = 1.0
        matrix[..., place, speed], matrix[..., speed, speed] = flow.reach[..., None], flow.keep[..., None]
        spread[..., place, place] = noise.position[..., None] * variances
        spread[..., place, speed] = spread[..., speed, place] = noise.cross[..., None] * variances
        spread[..., speed, speed] = noise.velocity[..., None] * variances
        return Transition(matrix, spread, flow.drift)

    def noise_factor(self, dt: Array) -> NoiseFactor:
        """Return a factor of the noise of intervals (n,)."""
        position, cross, velocity = self.noise(dt)
        std = np.sqrt(velocity)
        with_velocity = np.divide(abs(cross), std, out=np.zeros_like(std), where=std > 0.0)
        alone = np.sqrt(np.maximum(position - with_velocity**2, 0.0))
        return NoiseFactor(np.sign(dt), std, with_velocity, alone)

    def arrays(self, dt: Array) -> MotionArrays:
        """Return what compiled code reads for intervals (n,)."""
        flow = self.flow(dt)
        return MotionArrays(flow.reach, flow.keep, *self.noise_factor(dt), flow.drift, self.noise_std, self.speed_limit)

    def shocks(self, dt: Array, normal: Array) -> tuple[Array, Array]:
        """Return noise of positions and of velocities (n, 3) over intervals (n,), from standard normals (n, 2, 3)."""
        factor = self.noise_factor(dt)
        with_velocity, alone = (normal * self.noise_std).swapaxes(0, 1)
        position = factor.with_velocity[:, None] * with_velocity + factor.alone[:, None] * alone
        return factor.position_noise[:, None] * position, factor.velocity_noise[:, None] * with_velocity

    def precision(self, dt: Array) -> Array:
        """Return the inverse covariances (n, 2, 2) of unit noise over positive intervals (n,)."""
        position, cross, velocity = self.noise(dt)
        inverse = np.empty((len(dt), 2, 2))
        inverse[:, 0, 0], inverse[:, 1, 1] = velocity, position
        inverse[:, 0, 1] = inverse[:, 1, 0] = -cross
        return np.asarray(inverse / (position * velocity - cross**2)[:, None, None])

    def between(self, elapsed: Array, interval: Array) -> tuple[Array, Array]:
        """Return the mean position between two states, given both: weights (n, 4) and offsets (n, 3).

        The weights are those of position and velocity before and after; the time after the first state and that between
        the two are (n,), s.
        """
        position, cross, _ = self.noise(elapsed)
        first = self.flow(elapsed)
        return self._bridge(elapsed, interval, (position, cross), (1.0, first.reach), first.drift[:, :3])

    def velocity_between(self, elapsed: Array, interval: Array) -> tuple[Array, Array]:
        """Return the mean velocity between two states, given both; as `between`."""
        _, cross, velocity = self.noise(elapsed)
        first = self.flow(elapsed)
        return self._bridge(elapsed, interval, (cross, velocity), (0.0, first.keep), first.drift[:, 3:])

    def straying(self, elapsed: Array, interval: Array) -> Array:
        """Variance (n,) of the position about its mean between two states, given both, for unit noise; as `between`."""
        position, cross, _ = self.noise(elapsed)
        carried = self._carried((position, cross), self.flow(interval - elapsed))
        known = np.einsum("ni,nij,nj->n", carried, self.precision(interval), carried)
        return np.asarray(np.maximum(position - known, 0.0))

    def _bridge(
        self, elapsed: Array, interval: Array, noise: tuple[Array, Array], row: tuple[float, Array], drift: Array
    ) -> tuple[Array, Array]:
        """Mean of one row of the state between two states, given both.

        With Q(t) the noise after t and F the transition of the rest of the interval D, the gain on what the state
        after is off its prediction is ``Q(t) F^T Q(D)^-1`` (the bridge of a Gauss-Markov process: T. D. Barfoot,
        C. H. Tong and S. Sarkka, RSS 2014). `noise`, `row` and `drift` are the row of Q(t), of the transition over t
        and of its drift (n, 3).
        """
        rest, whole = self.flow(interval - elapsed), self.flow(interval)
        gain = np.einsum("ni,nij->nj", self._carried(noise, rest), self.precision(interval))
        weights = np.stack(
            [row[0] - gain[:, 0], row[1] - gain[:, 0] * whole.reach - gain[:, 1] * whole.keep, *gain.T], axis=1
        )
        return weights, drift - np.einsum("ni,nia->na", gain, whole.drift.reshape(-1, 2, 3))

    @staticmethod
    def _carried(noise: tuple[Array, Array], rest: Flow) -> Array:
        """Covariances (n, 2) of a row of the state with the state after the rest of the interval."""
        return np.stack([noise[0] + noise[1] * rest.reach, noise[1] * rest.keep], axis=1)

    def knot_spacing(self, deviation: float) -> float:
        """Return how far apart (s) states may be so that the position between strays by a standard deviation (length).

        The variance of white acceleration half-way between two states is ``noise_std^2 D^3 / 192`` (Barfoot, Tong and
        Sarkka 2014); drag lessens it. Infinite without noise.
        """
        largest = float(self.noise_std.max())
        return math.inf if largest == 0.0 else float((192.0 * (deviation / largest) ** 2) ** (1.0 / 3.0))

    def straying_time(self, deviation: float) -> float:
        """Return the time (s) after which a position predicted from a known state is off by a standard deviation.

        Infinite without noise.
        """
        largest = float(self.noise_std.max())
        return math.inf if largest == 0.0 else float((np.sqrt(3.0) * deviation / largest) ** (2.0 / 3.0))


@dataclass(frozen=True)
class Accelerated(Motion):
    """A model of objects whose velocity white acceleration changes, independent on each axis of the world.

    `acceleration_std`, one or three, is the standard deviation of the mean acceleration over 1 s, length/s^2: the
    spectral density of the acceleration is ``acceleration_std**2`` times 1 s. `max_speed` is a physical limit on the
    speed, length/s, for those who draw samples; `transition` is linear and ignores it. Raises ValueError if
    acceleration_std is not finite numbers >= 0, or max_speed is not positive.
    """

    acceleration_std: ArrayLike = 0.0
    max_speed: float | None = None

    def __post_init__(self) -> None:
        given = np.asarray(self.acceleration_std, dtype=np.float64)
        if given.shape not in ((), (3,)) or not ((given >= 0.0) & np.isfinite(given)).all():
            raise ValueError(f"motion: expected three accelerations >= 0, found {self.acceleration_std!r}")
        object.__setattr__(self, "acceleration_std", tuple(np.broadcast_to(given, 3).tolist()))
        if self.max_speed is not None and not self.max_speed > 0.0:
            raise ValueError(f"motion: expected a positive max_speed, found {self.max_speed}")

    @property
    def noise_std(self) -> Array:
        """`acceleration_std` (3,), length/s^2."""
        return np.array(self.acceleration_std, dtype=np.float64)
