"""A control track in the adjustment: places of one object, in a world and on a clock of their own.

A trajectory x(t) of the cameras' frame is at q = s R x(t) + T in the world. With the similarity and the map of time
t -> true time unknown beside the values of the cameras, a place y measured at a true time is an observation of the
trajectory at the time t that belongs to it, of the residual y - q: the knots about t, and nine values, move it. It
enters the same normal equations as a detection, along three axes instead of two.
"""

from dataclasses import dataclass, replace

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment import normal_equations
from stereophd.core.calibration.adjustment.linearisation import Linearisation, NormalEquations
from stereophd.core.calibration.adjustment.problem import Loss
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions, slopes, straying
from stereophd.core.metrics.truth.registration import Registration, derivatives, stepped

# Values of the world: rotation (3), translation (3), log scale, shift and rate of the clock.
WORLD = 9


@dataclass(frozen=True)
class ControlledLinearisation:
    """A problem with a control track of some of its trajectories."""

    linearisation: Linearisation
    time_s: Array  # (n,): On the clock of the control
    places: Array  # (n, 3): In its frame
    trajectories: Integers  # (n,): Which trajectory each place is of
    std: float  # Standard deviation of a place along each axis
    start: Registration  # The values of the world are offsets from it, about `center`
    center: Array  # (3,)
    world_std: Array  # (9,): Prior standard deviations of these
    loss: Loss

    def world(self, values: Array) -> Registration:
        """Return the similarity and the map of time of all values."""
        return stepped(self.start, values[-WORLD:], self.center, self.start.estimates)

    def residuals(self, values: Array, states: Array) -> tuple[Array, Array, Registration, Array]:
        """Residuals (n, 3), times (n,) of the trajectories, the world, and places (n, 3) of the trajectories in it."""
        world = self.world(values)
        times = world.track_times(self.time_s)
        moved = world.positions(
            positions(states, *interpolation(self.linearisation.problem.knots, self.trajectories, times))
        )
        return self.places - moved, times, world, moved

    def at(self, values: Array, states: Array) -> NormalEquations:
        """Return the normal equations of all values (m + 9,) and the knots; the cost is that without the control."""
        found = self.linearisation.at(values[:-WORLD], states)
        count = len(values)
        errors, times, world, moved = self.residuals(values, states)
        path = interpolation(self.linearisation.problem.knots, self.trajectories, times)
        velocities = world.velocities(
            positions(states, *slopes(self.linearisation.problem.knots, self.trajectories, times))
        )
        by_value = derivatives(moved - self.center, velocities, times - world.at_s)
        by_point = np.broadcast_to(world.scale * world.rotation, (len(times), 3, 3))
        bands, state_vector = found.bands.copy(), found.state_vector.copy()
        coupling, matrix = np.zeros((len(state_vector), count)), np.zeros((count, count))
        coupling[:, :-WORLD], matrix[:-WORLD, :-WORLD] = found.coupling, found.matrix
        vector = np.append(found.value_vector, -values[-WORLD:] / self.world_std**2)
        matrix[-WORLD:, -WORLD:] = np.diag(self.world_std**-2)
        # between detections the object may be elsewhere than the knots say
        knots = self.linearisation.problem.knots
        noise = self.linearisation.noise_at(values[:-WORLD]).std.max()
        astray = (world.scale * noise) ** 2 * straying(knots, self.trajectories, times)
        precisions = np.zeros((len(times), 2, 2))
        precisions[:, 0, 0] = 1.0 / (self.std**2 + astray)
        for axis in range(3):  # the second component of each measurement has no weight
            pair = [axis, (axis + 1) % 3]
            normal_equations.accumulate(
                np.zeros(len(times), dtype=np.int64), np.ascontiguousarray(errors[:, pair]),
                np.ones(len(times), dtype=np.bool_), precisions, np.ones(len(times)),
                np.ascontiguousarray(by_point[:, pair]), np.ascontiguousarray(by_value[:, pair]), path.knot,
                path.weights, np.arange(count - WORLD, count)[None], self.loss.kind, self.loss.scale,
                bands, coupling, matrix, state_vector, vector, np.empty(len(times)),
            )  # fmt: skip
        return replace(
            found, bands=bands, coupling=coupling, matrix=matrix, state_vector=state_vector,
            value_vector=vector,
        )  # fmt: skip
