"""How the objects of a scene move: by a motion model, discretised exactly, or with a body."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.motion.base import Motion
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.simulation.bodies import BodyPoint
from stereophd.core.simulation.timing import TimeGrid
from stereophd.core.simulation.walkers import Walker


@dataclass(frozen=True)
class MovingObject:
    """One object of a scene."""

    object_id: int  # its label in the truth
    birth_s: float  # exists at true times ``birth_s <= t <= death_s``
    death_s: float
    position: Array  # `position`, `velocity`: (3,): state at ``birth_s``, world frame, length and length/s
    velocity: Array
    noise_seed: int  # of its process noise: its path is computed anew at each use, and is always the same


# An object of a scene: a motion model moves it, or it has a path of its own.
SceneObject = MovingObject | BodyPoint | Walker


class Path:
    """The states of one object at ascending instants, computed window by window.

    It starts at the birth of the object and must be asked forwards in time; the motion's limit of speed does not apply.
    """

    def __init__(self, moving_object: MovingObject, motion: Motion) -> None:
        self._motion = motion
        self._object = moving_object
        self._time_s = moving_object.birth_s
        self._state = np.concatenate([moving_object.position, moving_object.velocity])
        self._generator = np.random.default_rng(moving_object.noise_seed)

    def states(self, times_s: Array) -> Array:
        """Return position and velocity (n, 6), world frame, at ascending true times (n,) of its life.

        Times must not lie before those of the call before.
        """
        if times_s.size == 0:
            return np.empty((0, 6))
        if not self._motion.noisy:
            # One product, not a running sum: the state at an instant does not depend on earlier requests.
            reach, keep, drift = self._motion.flow(times_s - self._object.birth_s)
            position, velocity = self._object.position, self._object.velocity
            return np.asarray(
                drift + np.concatenate([position + reach[:, None] * velocity, keep[:, None] * velocity], axis=1)
            )
        step = np.diff(times_s, prepend=self._time_s)
        normal = self._generator.standard_normal((times_s.size, 2, 3))
        states = walk(self._state, self._motion.arrays(step), *self._motion.shocks(step, normal))
        self._time_s, self._state = float(times_s[-1]), states[-1]
        return np.asarray(states)


@dataclass(frozen=True)
class StateWindow:
    """States of the objects that live in a window of time."""

    lower_s: float  # the window, true time, upper end excluded
    upper_s: float
    times_s: Array  # (n,): its distinct instants, ascending
    object_id: NDArray[np.int64]  # (m,): objects that live at any of them
    states: Array  # (m, n, 6): position and velocity, world frame; NaN before birth and after death


def state_windows(objects: Sequence[SceneObject], grid: TimeGrid, motion: Motion) -> Iterator[StateWindow]:
    """Yield the states of all objects at the instants of a run, in windows: memory does not grow with the run."""
    waiting = sorted(objects, key=lambda item: (item.birth_s, item.object_id), reverse=True)
    living: dict[int, tuple[SceneObject, Path | BodyPoint | Walker]] = {}
    for lower_s, upper_s in grid.windows():
        while waiting and waiting[-1].birth_s < upper_s:
            born = waiting.pop()
            living[born.object_id] = (born, Path(born, motion) if isinstance(born, MovingObject) else born)
        times_s = grid.times(lower_s, upper_s)
        states = np.full((len(living), times_s.size, 6), np.nan)
        for row, (item, path) in enumerate(living.values()):
            exists = (times_s >= item.birth_s) & (times_s <= item.death_s)
            states[row, exists] = path.states(times_s[exists])
        identifiers = np.fromiter(living, dtype=np.int64, count=len(living))
        yield StateWindow(lower_s, upper_s, times_s, identifiers, states)
        living = {key: value for key, value in living.items() if value[0].death_s >= upper_s}


@compiled
def walk(start: Array, motion: MotionArrays, position_noise: Array, velocity_noise: Array) -> Array:
    """States (n, 6) of one object after each of n successive intervals, from the state `start` (6,).

    `position_noise` and `velocity_noise` (n, 3) are what the noise adds in each interval.
    """
    out = np.empty((len(motion.reach), 6))
    state = start.copy()
    for k in range(len(motion.reach)):
        for a in range(3):
            velocity = state[3 + a]
            state[a] += motion.reach[k] * velocity + position_noise[k, a] + motion.drift[k, a]
            state[3 + a] = motion.keep[k] * velocity + velocity_noise[k, a] + motion.drift[k, 3 + a]
        out[k] = state
    return out
