"""Unknowns of a calibration: named parameters with priors, and the map from their values to cameras.

The values of a parameter set are offsets from the cameras at the prior mean, so the prior is

    values ~ N(mean, diag(std^2)),   mean = 0 unless stated,

and the cameras of `values` are those of the prior mean, moved by each quantity of
`stereophd.core.calibration.unknowns.quantities`. Samplers and optimisers see nothing but vectors of values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.unknowns.quantities.base import LENGTH_PER_SECOND, MOVES, RADIANS_PER_SECOND, Quantity
from stereophd.core.calibration.unknowns.quantities.registry import component_names, quantities, quantity_of
from stereophd.core.geometry.camera import Camera

# Values must be this probable under the prior to agree with it.
LEAST_PRIOR_PROBABILITY = 1e-6


@dataclass(frozen=True)
class Parameter:
    """One unknown of one camera, or of several that share it, with its Gaussian prior."""

    name: str  # A component of a quantity (`stereophd.core.calibration.unknowns.quantities.registry`)
    camera: str  # Name of the camera
    # `mean`, `std`: Prior of the value, in the unit of the quantity.
    mean: float
    std: float
    shared_with: tuple[str, ...] = ()  # Other cameras that have the same value

    def __post_init__(self) -> None:
        if self.name not in component_names():
            raise ValueError(f"parameter {self.name}: expected one of {', '.join(component_names())}")
        if not (0.0 < self.std < np.inf and np.isfinite(self.mean)):
            raise ValueError(
                f"{self.camera}.{self.name}: expected a finite mean and a positive standard deviation, found "
                f"{self.mean}, {self.std}"
            )

    @property
    def quantity(self) -> Quantity:
        """The quantity that the parameter is a component of."""
        return quantity_of(self.name)

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return self.quantity.unit

    @property
    def cameras(self) -> tuple[str, ...]:
        """All cameras that have the value."""
        return (self.camera, *self.shared_with)


@dataclass(frozen=True)
class ParameterSet:
    """The unknowns of a set of cameras."""

    cameras: tuple[Camera, ...]  # At the prior mean, known ones included, in the order of the configuration
    parameters: tuple[Parameter, ...]  # In the order of the values

    def __post_init__(self) -> None:
        unknown = {name for p in self.parameters for name in p.cameras} - {c.name for c in self.cameras}
        if unknown:
            raise ValueError(f"parameters of {sorted(unknown)}: expected cameras of the set")
        if len({(camera, p.name) for p in self.parameters for camera in p.cameras}) != sum(
            len(p.cameras) for p in self.parameters
        ):
            raise ValueError("expected every parameter once")

    @property
    def size(self) -> int:
        """Number of values m."""
        return len(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values, ``camera.component``."""
        return tuple(f"{p.camera}.{p.name}" for p in self.parameters)

    @property
    def prior_mean(self) -> Array:
        """Mean of the prior (m,)."""
        return np.array([p.mean for p in self.parameters])

    @property
    def prior_std(self) -> Array:
        """Standard deviations of the prior (m,)."""
        return np.array([p.std for p in self.parameters])

    @property
    def clock_offset_stds(self) -> Array:
        """Prior standard deviations (k,) of the offsets of unknown clocks, s."""
        return np.array([p.std for p in self.parameters if p.name == "clock_offset"])

    @cached_property
    def _places(self) -> dict[tuple[str, str], int]:
        return {(camera, p.name): i for i, p in enumerate(self.parameters) for camera in p.cameras}

    @cached_property
    def _unknown(self) -> dict[str, tuple[tuple[Quantity, Integers], ...]]:
        """Quantities of each camera that have an unknown component, with the places of all their components."""
        out = {}
        for camera in self.cameras:
            places = [(quantity, self.index(camera.name, quantity.components)) for quantity in quantities()]
            out[camera.name] = tuple((quantity, index) for quantity, index in places if (index >= 0).any())
        return out

    def unknown(self, camera: str) -> tuple[tuple[Quantity, Integers], ...]:
        """Quantities of a camera that are unknown, each with the places of its components; -1 where one is known."""
        return self._unknown[camera]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The quantities that have an unknown component, in the order of the registry."""
        names = {p.quantity.name for p in self.parameters}
        return tuple(quantity for quantity in quantities() if quantity.name in names)

    @property
    def only_moves(self) -> bool:
        """Whether cameras only move: the undistorted pixels and the times of the detections are known."""
        return all(quantity.affects == MOVES for quantity in self.quantities)

    @property
    def same_events(self) -> bool:
        """Whether all values make the same events of a recording.

        Detections of a rolling shutter that moves are turned by its motion (`stereophd.core.disparity.events`).
        """
        rolling = any(c.readout_s != 0.0 and (self.has_rates or not c.pose.is_static) for c in self.cameras)
        return self.only_moves and not rolling

    @property
    def only_poses(self) -> bool:
        """Whether nothing but poses of cameras that stand still is unknown."""
        return self.only_moves and not self.has_rates

    @property
    def has_rates(self) -> bool:
        """Whether a velocity or rotation rate of a camera is unknown."""
        return any(quantity.unit in (LENGTH_PER_SECOND, RADIANS_PER_SECOND) for quantity in self.quantities)

    def index(self, camera: str, names: Sequence[str]) -> Integers:
        """Places of components of a camera among the values; -1 where one is known."""
        return np.array([self._places.get((camera, name), -1) for name in names], dtype=np.int64)

    def build(self, values: ArrayLike) -> tuple[Camera, ...]:
        """Return the cameras of values (m,)."""
        return tuple(self._moved(camera, self._checked(values)) for camera in self.cameras)

    def rebuilt(self, cameras: Sequence[Camera], values: ArrayLike, index: int) -> tuple[Camera, ...]:
        """Return the cameras of values (m,) that differ from those of `cameras` in one value at most."""
        offsets, names = self._checked(values), self.parameters[index].cameras
        return tuple(
            self._moved(nominal, offsets) if nominal.name in names else camera
            for nominal, camera in zip(self.cameras, cameras, strict=True)
        )

    def guess(self, values: ArrayLike) -> tuple[Camera, ...]:
        """Return the prior-mean cameras that the values (m,) turn into the cameras of this set.

        With values drawn from the prior the cameras of this set are a draw from the prior about the guess.
        """
        return tuple(self._moved(camera, -self._checked(values)) for camera in self.cameras)

    def _checked(self, values: ArrayLike) -> Array:
        offsets = np.asarray(values, dtype=np.float64)
        if offsets.shape != (self.size,):
            raise ValueError(f"expected {self.size} values, found shape {offsets.shape}")
        return offsets

    def _moved(self, camera: Camera, values: Array) -> Camera:
        for quantity, index in self._unknown[camera.name]:
            camera = quantity.apply(camera, taken(values, index))
        return camera

    def difference(self, cameras: Sequence[Camera]) -> Array:
        """Return the values (m,) that lead from the prior mean to cameras, given in any order.

        Quantities that are no parameter are left out; of a shared parameter the mean over its cameras is returned.
        """
        by_name = {camera.name: camera for camera in cameras}
        totals, counts = np.zeros(self.size), np.zeros(self.size)
        for camera in self.cameras:
            for quantity, index in self._unknown[camera.name]:
                found = quantity.difference(camera, by_name[camera.name])
                used = index >= 0
                totals[index[used]] += found[used]
                counts[index[used]] += 1.0
        return np.asarray(totals / np.maximum(counts, 1.0))

    def about(self, cameras: Sequence[Camera]) -> Self:
        """Return the same parameters about other cameras."""
        return replace(self, cameras=tuple(cameras))

    def log_prior(self, values: ArrayLike) -> Array:
        """Log-density of the prior at values (..., m), shape (...)."""
        scaled = (np.asarray(values, dtype=np.float64) - self.prior_mean) / self.prior_std
        constant = np.log(self.prior_std).sum() + 0.5 * self.size * np.log(2.0 * np.pi)
        return np.asarray(-0.5 * (scaled**2).sum(axis=-1) - constant)

    def prior_disagreement(self, values: ArrayLike) -> str | None:
        """Why values (m,) do not agree with the prior; None if they do."""
        scaled = (np.asarray(values, dtype=np.float64) - self.prior_mean) / self.prior_std
        distance = float((scaled**2).sum())
        from scipy.special import chdtrc  # costly to import, and scipy.stats costs even more

        if chdtrc(self.size, distance) < LEAST_PRIOR_PROBABILITY:
            return f"the cameras lie {np.sqrt(distance):.1f} standard deviations from the prior"
        return None

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """Draw values (count, m) from the prior."""
        return np.asarray(self.prior_mean + self.prior_std * rng.standard_normal((count, self.size)))


def taken(values: Array, index: Integers) -> Array:
    """Values (..., k) at the places of `ParameterSet.index`, zero where one is known."""
    return np.where(index >= 0, values[..., index], 0.0)
