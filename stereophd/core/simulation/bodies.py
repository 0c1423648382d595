"""Rigid bodies of a scene that sway and turn: the corners of a board, or the ends of a wand, in a hand.

Each coordinate of a body's centre and of its rotation vector is a sum of harmonics of random period and phase: a smooth
random path of stated standard deviation that stays near its middle however long the run is.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.rotations import left_jacobians, rotations

# Harmonics of each coordinate.
HARMONICS = 4


@dataclass(frozen=True)
class BodyPoses:
    """Poses of a body at some times, and how they change."""

    times_s: Array  # (n,): True times
    # `centers`, `velocities`: (n, 3): Of the origin of its axes, world frame, length and length/s.
    centers: Array
    rotations: Array  # (n, 3, 3): Of the sway: applied after the mean rotation `Body.rotation`
    velocities: Array
    turning: Array  # (n, 3): Angular velocities, world frame, rad/s


@dataclass(frozen=True)
class Body:
    """A rigid body and its path."""

    points: Array  # (n, 3): its points, in its own axes, length
    center: Array  # (3,): world frame, where the origin of its axes is on average
    rotation: Array  # (3, 3): from its axes to the world, on average
    start_s: float  # true time from which the phases count
    # (h, 6): of the harmonics of the centre, length, and of the rotation vector in the axes of the world, rad
    amplitudes: Array
    frequencies: Array  # (h, 6): rad/s
    phases: Array  # (h, 6): rad
    # Poses of the last call of `poses`: all points of a body are asked for the same times, one after the other.
    _latest: list[BodyPoses] = field(default_factory=list, init=False, repr=False, compare=False)

    @classmethod
    def drawn(
        cls,
        points: Array,
        center: Array,
        rotation: Array,
        std: Array,
        period_s: tuple[float, float],
        start_s: float,
        generator: np.random.Generator,
    ) -> Self:
        """Draw the path of a body.

        `std` (6,) are standard deviations over time: of the centre, length, and of the rotation vector, rad. `period_s`
        is the shortest and the longest period of a harmonic, s; the logarithm of the period is uniform. The rest is as
        in `Body`.
        """
        shape = (HARMONICS, 6)
        shortest, longest = np.log(period_s).tolist()
        periods = np.exp(generator.uniform(shortest, longest, shape))
        phases = generator.uniform(0.0, 2.0 * np.pi, shape)
        amplitudes = np.broadcast_to(std * np.sqrt(2.0 / HARMONICS), shape)
        return cls(points, center, rotation, start_s, amplitudes, 2.0 * np.pi / periods, phases)

    def states(self, point: int, times_s: Array) -> Array:
        """Return position and velocity (n, 6), world frame, of one point at true times (n,)."""
        poses = self.poses(times_s)
        arm = poses.rotations @ (self.rotation @ self.points[point])
        return np.concatenate([poses.centers + arm, poses.velocities + np.cross(poses.turning, arm)], axis=1)

    def poses(self, times_s: Array) -> BodyPoses:
        """Return the poses at true times (n,); those of the last call are not computed again."""
        if self._latest and np.array_equal(self._latest[0].times_s, times_s):
            return self._latest[0]
        angles = self.frequencies * (times_s[:, None, None] - self.start_s) + self.phases
        sway = (self.amplitudes * np.cos(angles)).sum(axis=1)
        rate = -(self.amplitudes * self.frequencies * np.sin(angles)).sum(axis=1)
        turning = np.einsum("nij,nj->ni", left_jacobians(sway[:, 3:]), rate[:, 3:])
        latest = BodyPoses(times_s, self.center + sway[:, :3], rotations(sway[:, 3:]), rate[:, :3], turning)
        self._latest[:] = [latest]
        return latest


@dataclass(frozen=True)
class BodyPoint:
    """One point of a body, as an object of a scene."""

    object_id: int  # its label in the truth
    body: Body
    point: int  # which of the body's points
    birth_s: float  # exists at true times ``birth_s <= t <= death_s``
    death_s: float = np.inf

    def states(self, times_s: Array) -> Array:
        """Return position and velocity (n, 6), world frame, at true times (n,)."""
        return self.body.states(self.point, times_s)
