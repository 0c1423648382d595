"""People who walk between places, keep clear of one another, and stop to meet.

Each walker heads for a place at its own speed, and is pushed aside by those near it (D. Helbing and P. Molnar, "Social
force model for pedestrian dynamics", Physical Review E 51, 1995). Where it arrives it rests for a while; then it goes
to another place, or to another walker, beside whom it stops.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array

# Steps of the walk, s: states between them are interpolated.
STEP_S = 0.05
# Time in which a walker reaches its speed, s, and how strongly (times its speed, per that time) and how far (in
# spacings) others push it.
RELAXATION_S = 0.5
PUSH, RANGE = 2.0, 0.4
# Largest acceleration, in speeds per relaxation time.
STRONGEST = 2.0
# A place counts as reached within so many spacings.
ARRIVED = 1.0


@dataclass(frozen=True)
class Crowd:
    """How walkers walk; lengths along two axes of the ground."""

    count: int
    low: Array  # (2,): Corner of the area
    high: Array  # (2,)
    speed: float  # Mean over the walkers, length/s; each has its own within a quarter of it
    spacing: float  # Least distance of two walkers, length
    rest_s: float  # Mean time at a place
    meet: float  # Probability that the next place is beside another walker

    def walk(self, duration_s: float, generator: np.random.Generator) -> Array:
        """Return places and velocities (count, steps, 4) from time 0 in steps of `STEP_S`."""
        steps = int(np.ceil(duration_s / STEP_S)) + 2
        speeds = self.speed * generator.uniform(0.75, 1.25, self.count)
        places = generator.uniform(self.low, self.high, (self.count, 2))
        velocities = np.zeros((self.count, 2))
        goals, rests = generator.uniform(self.low, self.high, (self.count, 2)), np.zeros(self.count)
        out = np.empty((self.count, steps, 4))
        for step in range(steps):
            out[:, step, :2], out[:, step, 2:] = places, velocities
            goals, rests = self._next_goals(places, goals, rests, generator)
            wanted = goals - places
            distance = np.linalg.norm(wanted, axis=1)
            slower = np.minimum(distance / self.spacing, 1.0) * (rests <= 0.0)
            pull = wanted * (speeds * slower / np.maximum(distance, 1e-12))[:, None] - velocities
            acceleration = pull + speeds[:, None] * self._push(places)
            strength = np.linalg.norm(acceleration, axis=1) / (STRONGEST * speeds)
            velocities = velocities + acceleration / np.maximum(strength, 1.0)[:, None] * (STEP_S / RELAXATION_S)
            places = places + velocities * STEP_S
        return out

    def _next_goals(
        self, places: Array, goals: Array, rests: Array, generator: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return where walkers head for, and how much longer they rest where they are."""
        goals, rests = goals.copy(), rests - STEP_S
        arrived = (np.linalg.norm(goals - places, axis=1) < ARRIVED * self.spacing) & (rests <= 0.0)
        for walker in np.flatnonzero(arrived).tolist():
            rests[walker] = generator.exponential(self.rest_s)
            goals[walker] = generator.uniform(self.low, self.high)
            if self.count > 1 and generator.random() < self.meet:
                other = (walker + 1 + generator.integers(self.count - 1)) % self.count
                angle = generator.uniform(0.0, 2.0 * np.pi)
                beside = places[other] + 2.0 * self.spacing * np.array([np.cos(angle), np.sin(angle)])
                goals[walker] = np.clip(beside, self.low, self.high)
        return goals, rests

    def _push(self, places: Array) -> Array:
        """Return how others push each walker (count, 2), times its speed."""
        apart = places[:, None] - places
        distance = np.maximum(np.linalg.norm(apart, axis=2), 1e-9)
        strength = PUSH * np.exp((1.0 - distance / self.spacing) / RANGE)
        np.fill_diagonal(strength, 0.0)
        return np.asarray((apart * (strength / distance)[:, :, None]).sum(axis=1))


@dataclass(frozen=True)
class Walker:
    """One walker of a scene, who is there from the start to the end."""

    object_id: int
    birth_s: float
    walked: Array  # (steps, 4): Place and velocity along the axes of the ground
    axes: Array  # (2, 3): Those axes, world frame
    middle: Array  # (3,): World frame, of the place (0, 0): the ground, and half the height above it

    @property
    def death_s(self) -> float:
        """It stays."""
        return float(np.inf)

    def states(self, times_s: Array) -> Array:
        """Return position and velocity (n, 6), world frame, at true times (n,)."""
        steps = np.clip((times_s - self.birth_s) / STEP_S, 0.0, len(self.walked) - 1.001)
        first = steps.astype(np.int64)
        share = (steps - first)[:, None]
        states = (1.0 - share) * self.walked[first] + share * self.walked[first + 1]
        return np.concatenate([self.middle + states[:, :2] @ self.axes, states[:, 2:] @ self.axes], axis=1)
