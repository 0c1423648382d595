"""How objects move between two events, in the world.

States are (x, y, z, vx, vy, vz) in length and length/s. Nothing is assumed about the times of events:
a transition is made for any time step, zero and negative included.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, init=False, eq=False)
class ConstantVelocity:
    """Constant velocity disturbed by white acceleration, independent on each axis of the world.

    Parameters
    ----------
    acceleration_std : (3,) array_like
        Standard deviation of the mean acceleration over 1 s, length/s^2: the spectral density of the
        acceleration is ``acceleration_std**2`` times 1 s. Kept as a read-only array.
    max_speed : float or None
        Physical limit on the speed, length/s, for those who draw samples; `transition` is linear and
        ignores it.

    Raises
    ------
    ValueError
        If acceleration_std is not three finite numbers >= 0, or max_speed is not positive.
    """

    acceleration_std: FloatArray
    max_speed: float | None

    def __init__(self, acceleration_std: ArrayLike, max_speed: float | None = None) -> None:
        values = np.array(acceleration_std, dtype=np.float64)
        if values.shape != (3,) or not ((values >= 0.0) & np.isfinite(values)).all():
            raise ValueError(f"motion: expected three accelerations >= 0, found {acceleration_std!r}")
        if max_speed is not None and not max_speed > 0.0:
            raise ValueError(f"motion: expected a positive max_speed, found {max_speed}")
        values.setflags(write=False)
        object.__setattr__(self, "acceleration_std", values)
        object.__setattr__(self, "max_speed", None if max_speed is None else float(max_speed))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ConstantVelocity):
            return NotImplemented
        same = np.array_equal(self.acceleration_std, other.acceleration_std)
        return same and self.max_speed == other.max_speed

    def __hash__(self) -> int:
        return hash((*self.acceleration_std.tolist(), self.max_speed))

    def transition(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return the linear-Gaussian transition over a time step.

        Parameters
        ----------
        dt : float
            Time step, s; may be zero or negative.

        Returns
        -------
        transition_matrix : (6, 6) array
            F, [[I, dt I], [0, I]].
        process_covariance : (6, 6) array
            Q, positive semi-definite: per axis ``q [[|dt|^3/3, sign(dt) dt^2/2], [sign(dt) dt^2/2, |dt|]]``
            with the spectral density q.

        Notes
        -----
        Forwards this is the exact discretisation of continuous white acceleration (Y. Bar-Shalom, X. R. Li
        and T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 6.2.2).
        Backwards, x(t) = F x(t - tau) + w gives x(t - tau) = F^-1 x(t) - F^-1 w, whose noise has the
        covariance F^-1 Q(tau) F^-T: the same with the sign of the covariance between position and
        velocity reversed. That w is independent of the later state x(t), as a backward prediction takes it,
        is exact for a diffuse prior.
        """
        density = self.acceleration_std**2
        position, cross, velocity = abs(dt) ** 3 / 3.0, dt * abs(dt) / 2.0, abs(dt)
        per_axis = np.array([[position, cross], [cross, velocity]])
        transition_matrix: FloatArray = np.eye(6)
        transition_matrix[:3, 3:] = dt * np.eye(3)
        process_covariance: FloatArray = np.kron(per_axis, np.diag(density))
        return transition_matrix, process_covariance


@dataclass(frozen=True)
class Static:
    """Objects that stand still: the position stays what it is, whatever the velocity says.

    The velocity is carried along untouched, so that the transition can be inverted and covariances keep
    their rank.
    """

    @property
    def acceleration_std(self) -> FloatArray:
        """Zero (3,): nothing disturbs a static object."""
        return np.zeros(3)

    @property
    def max_speed(self) -> float | None:
        """None: the velocity has no effect."""
        return None

    def transition(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """Return F = I and Q = 0, both (6, 6), for any time step dt in s."""
        return np.eye(6), np.zeros((6, 6))


Motion: TypeAlias = ConstantVelocity | Static
