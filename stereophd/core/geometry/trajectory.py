"""Known trajectories: the poses of a body over time, and a camera mounted on it.

Between two poses the body's origin moves straight and the body turns steadily about a fixed axis (K. Shoemake,
"Animating rotation with quaternion curves", SIGGRAPH 1985: slerp), so velocity and angular velocity are constant there.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.geometry.rotations import rotations

# A quaternion whose norm differs more than this from 1 is refused rather than normalised.
LARGEST_NORM_DEFECT = 1e-3
# Columns of the poses of a trajectory.
COLUMNS = ("time_s", "x", "y", "z", "qw", "qx", "qy", "qz")


class EqualByValue:
    """A frozen dataclass that is equal to others of its kind by its values, arrays included."""

    def _key(self) -> tuple[object, ...]:
        values: list[Any] = [getattr(self, each.name) for each in fields(cast("Any", self))]
        # Adding zero makes -0.0 and 0.0 the same bytes, as they are the same number.
        return tuple((value + 0.0).tobytes() if isinstance(value, np.ndarray) else value for value in values)

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, type(self)) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())


def frozen(values: ArrayLike, shape: tuple[int, ...] | None = None, name: str = "") -> Array:
    """Return a read-only copy of an array; ValueError unless it has the shape, if one is given, and is finite."""
    array = np.array(values, dtype=np.float64)
    if shape is not None and (array.shape != shape or not np.isfinite(array).all()):
        raise ValueError(f"{name}: expected finite numbers of shape {shape}, found {values!r}")
    array.setflags(write=False)
    return array


class Motions(NamedTuple):
    """Poses and their rates at n times.

    `rotations` (n, 3, 3) lead from world axes to those of the body or camera, `centers` (n, 3) are its origin in the
    world, `velocities` (n, 3) the velocity of that, length/s, and `rates` (n, 3) its angular velocity about its own
    axes, rad/s.
    """

    rotations: Array
    centers: Array
    velocities: Array
    rates: Array


@dataclass(frozen=True, eq=False)
class BodyTrajectory(EqualByValue):
    """The poses of a body in the world, at least two rows of `COLUMNS` (n, 8).

    A row has the time, s, increasing; the origin of the body in the world, length; and the unit quaternion that turns
    the body's axes into the world's (TUM's convention). Raises ValueError if a value is not finite, times do not
    increase, or a quaternion is not of norm 1; rows are counted from 0.
    """

    poses: Array

    def __post_init__(self) -> None:
        rows = frozen(self.poses)
        if rows.ndim != 2 or rows.shape[1] != len(COLUMNS) or len(rows) < 2:
            raise ValueError(f"expected two or more poses of {len(COLUMNS)} numbers, found shape {rows.shape}")
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            raise ValueError(f"row {bad[0]}: expected finite numbers, found {rows[bad[0]].tolist()}")
        late = np.flatnonzero(np.diff(rows[:, 0]) <= 0.0)
        if len(late):
            before, after = rows[late[0], 0], rows[late[0] + 1, 0]
            raise ValueError(f"row {late[0] + 1}: expected increasing times, found {after:g} s after {before:g} s")
        norms = np.linalg.norm(rows[:, 4:], axis=1)
        off = np.flatnonzero(np.abs(norms - 1.0) > LARGEST_NORM_DEFECT)
        if len(off):
            raise ValueError(f"row {off[0]}: expected a quaternion of norm 1, found norm {norms[off[0]]:.6g}")
        object.__setattr__(self, "poses", rows)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time, s."""
        return float(self.poses[0, 0]), float(self.poses[-1, 0])

    @cached_property
    def _turns(self) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) from world to body axes, and rates (n - 1, 3) about those in each segment, rad/s."""
        from scipy.spatial.transform import Rotation  # only here: costly to import

        turns = Rotation.from_quat(self.poses[:, 4:], scalar_first=True)
        steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
        return turns.inv().as_matrix(), steps / np.diff(self.poses[:, 0])[:, None]

    def at(self, times: Array) -> Motions:
        """Return the poses of the body at times (n,), s; beyond its ends the trajectory stands still."""
        first, last = self.span
        inside = np.clip(times, first, last)
        segment = np.clip(np.searchsorted(self.poses[:, 0], inside, side="right") - 1, 0, len(self.poses) - 2)
        elapsed = (inside - self.poses[segment, 0])[:, None]
        step = (self.poses[segment + 1, 0] - self.poses[segment, 0])[:, None]
        velocities = (self.poses[segment + 1, 1:4] - self.poses[segment, 1:4]) / step
        body_axes, rates = (values[segment] for values in self._turns)
        turned = rotations(-elapsed * rates) @ body_axes
        moving = ((times >= first) & (times <= last))[:, None]
        return Motions(
            turned, self.poses[segment, 1:4] + elapsed * velocities, velocities * moving, rates * moving
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MountedPath(EqualByValue):
    """A camera that a body with a known trajectory carries.

    `rotation` (3, 3) leads from the body's axes to the camera's (hand-eye); `center` (3,) is the optical centre in the
    body's axes, length.
    """

    trajectory: BodyTrajectory
    rotation: Array
    center: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", frozen(self.rotation))
        object.__setattr__(self, "center", frozen(self.center))

    def at(self, times: Array) -> Motions:
        """Return the poses of the camera at times (n,), s."""
        body = self.trajectory.at(times)
        to_world = np.swapaxes(body.rotations, 1, 2)
        lever = np.cross(body.rates, self.center)
        return Motions(
            np.asarray(self.rotation @ body.rotations),
            body.centers + to_world @ self.center,
            body.velocities + np.einsum("nij,nj->ni", to_world, lever),
            np.asarray(body.rates @ self.rotation.T),
        )
