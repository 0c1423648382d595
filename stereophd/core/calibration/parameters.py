"""What a calibration estimates: named parameters with priors, and the map from their values to cameras.

The values of a parameter set are offsets from the cameras at the prior mean, so the prior is

    values ~ N(mean, diag(std^2)),   mean = 0 unless stated,

and the cameras of `values` are those of the prior mean, moved (paper VII-A): the centre by an offset in the
world's axes, the rotation by a rotation vector in the camera's own axes,

    center   = center_0 + (center_x, center_y, center_z),
    rotation = exp([rotation_x, rotation_y, rotation_z]_x) rotation_0,

so that rotation_x is pitch, rotation_y yaw and rotation_z roll. Samplers and optimisers see nothing but
vectors of values: another quantity of a camera (intrinsics, lens, clock) is one more entry of `QUANTITIES`
and its part in `moved_camera`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector

Array = NDArray[np.float64]

LENGTH, RADIANS = "length", "rad"
CENTER = ("center_x", "center_y", "center_z")
ROTATION = ("rotation_x", "rotation_y", "rotation_z")
# What of a camera can be a parameter, and its unit.
QUANTITIES: Mapping[str, str] = {**dict.fromkeys(CENTER, LENGTH), **dict.fromkeys(ROTATION, RADIANS)}


@dataclass(frozen=True)
class Parameter:
    """One unknown of one camera, with its Gaussian prior.

    Attributes
    ----------
    name : str
        A key of `QUANTITIES`.
    camera : str
        Name of the camera.
    unit : str
        ``length`` or ``rad``.
    mean, std : float
        Prior of the value, in that unit.
    """

    name: str
    camera: str
    unit: str
    mean: float
    std: float

    def __post_init__(self) -> None:
        if QUANTITIES.get(self.name) != self.unit:
            raise ValueError(f"parameter {self.name} in {self.unit}: expected one of {dict(QUANTITIES)}")
        if not (0.0 < self.std < np.inf and np.isfinite(self.mean)):
            raise ValueError(
                f"{self.camera}.{self.name}: expected a finite mean and a positive standard deviation, found "
                f"{self.mean}, {self.std}"
            )


@dataclass(frozen=True)
class ParameterSet:
    """The unknowns of a set of cameras.

    Attributes
    ----------
    cameras : tuple of Camera
        At the prior mean, known ones included, in the order of the configuration.
    parameters : tuple of Parameter
        In the order of the values.
    """

    cameras: tuple[Camera, ...]
    parameters: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        unknown = {p.camera for p in self.parameters} - {c.name for c in self.cameras}
        if unknown:
            raise ValueError(f"parameters of {sorted(unknown)}: expected cameras of the set")
        if len(set(self.names)) != self.size:
            raise ValueError("expected every parameter once")

    @property
    def size(self) -> int:
        """Number of values m."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values, ``camera.quantity``."""
        return tuple(f"{p.camera}.{p.name}" for p in self.parameters)

    @property
    def prior_mean(self) -> Array:
        """Mean of the prior (m,)."""
        return np.array([p.mean for p in self.parameters])

    @property
    def prior_std(self) -> Array:
        """Standard deviations of the prior (m,)."""
        return np.array([p.std for p in self.parameters])

    def index(self, camera: str, names: tuple[str, ...]) -> NDArray[np.int64]:
        """Places of a camera's quantities among the values; -1 where one is known."""
        places = {name: i for i, name in enumerate(self.names)}
        return np.array([places.get(f"{camera}.{name}", -1) for name in names], dtype=np.int64)

    def build(self, values: ArrayLike) -> tuple[Camera, ...]:
        """Return the cameras of values (m,)."""
        offsets = np.asarray(values, dtype=np.float64)
        if offsets.shape != (self.size,):
            raise ValueError(f"expected {self.size} values, found shape {offsets.shape}")
        of_camera: dict[str, dict[str, float]] = {}
        for parameter, value in zip(self.parameters, offsets.tolist(), strict=True):
            of_camera.setdefault(parameter.camera, {})[parameter.name] = value
        return tuple(moved_camera(c, of_camera[c.name]) if c.name in of_camera else c for c in self.cameras)

    def guess(self, values: ArrayLike) -> tuple[Camera, ...]:
        """Return the prior-mean cameras from which values (m,) lead to the cameras of this set.

        With values drawn from the prior the cameras of this set are a draw from the prior about the guess.
        """
        offsets = np.asarray(values, dtype=np.float64)
        of_camera: dict[str, dict[str, float]] = {}
        for parameter, value in zip(self.parameters, offsets.tolist(), strict=True):
            of_camera.setdefault(parameter.camera, {})[parameter.name] = value
        return tuple(guess_of(c, of_camera[c.name]) if c.name in of_camera else c for c in self.cameras)

    def log_prior(self, values: ArrayLike) -> Array:
        """Log-density of the prior at values (..., m), shape (...)."""
        scaled = (np.asarray(values, dtype=np.float64) - self.prior_mean) / self.prior_std
        constant = np.log(self.prior_std).sum() + 0.5 * self.size * np.log(2.0 * np.pi)
        return np.asarray(-0.5 * (scaled**2).sum(axis=-1) - constant)

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Draw values (count, m) from the prior."""
        return np.asarray(self.prior_mean + self.prior_std * rng.standard_normal((count, self.size)))


def moved_camera(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return a camera with its quantities moved by the values of the given names."""
    pose = camera.pose
    offset = np.array([values.get(name, 0.0) for name in CENTER])
    turn = rotation_from_vector([values.get(name, 0.0) for name in ROTATION])
    moved = Pose(turn @ pose.rotation, pose.center + offset, pose.velocity, pose.rotation_rate, pose.time_s)
    return replace(camera, pose=moved)


def guess_of(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return the camera that `moved_camera` moves to this one, by the same values."""
    pose = camera.pose
    offset = np.array([values.get(name, 0.0) for name in CENTER])
    turn = rotation_from_vector([values.get(name, 0.0) for name in ROTATION])
    back = Pose(turn.T @ pose.rotation, pose.center - offset, pose.velocity, pose.rotation_rate, pose.time_s)
    return replace(camera, pose=back)


def pose_offsets(camera: Camera, other: Camera) -> Array:
    """Values (6,) of centre and rotation that move the pose of `camera` to that of `other`."""
    vector = rotation_to_vector(other.pose.rotation @ camera.pose.rotation.T)
    return np.concatenate([other.pose.center - camera.pose.center, vector])
