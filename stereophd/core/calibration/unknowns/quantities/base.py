"""Calibration quantities: their interface, and the inputs of their derivatives.

A quantity is one kind of unknown of a camera (its centre, its focal length, the offset of its clock, ...) with one or
more components. Values are offsets from the camera at the prior mean. Values of several quantities commute: the camera
does not depend on the order in which they are applied, and the negative values undo them.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any, ClassVar

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.rows import ArrayRows
from stereophd.core.settings import LARGEST_LENGTH

LENGTH, RADIANS, RATIO, PIXELS, SECONDS = "length", "rad", "1", "px", "s"
LENGTH_PER_SECOND, RADIANS_PER_SECOND = "length/s", "rad/s"
# How a key of a report names a unit, and the unit that it is in: angles in degrees.
SUFFIXES = {
    LENGTH: ("", 1.0),
    RADIANS: ("_deg", 180.0 / np.pi),
    RATIO: ("", 1.0),
    PIXELS: ("_px", 1.0),
    SECONDS: ("_s", 1.0),
    LENGTH_PER_SECOND: ("_per_s", 1.0),
    RADIANS_PER_SECOND: ("_deg_s", 180.0 / np.pi),
}
# The part of an event that depends on a quantity: none (the camera only moves), its undistorted pixels, or its times.
MOVES, IMAGES, TIMES = "moves", "images", "times"


@dataclass(frozen=True)
class Projection(ArrayRows):
    """What cameras see of n points of trajectories, each at the time of a detection."""

    # `ahead`, `visible`: arrays (n,) of bool: Whether the point lies before the camera (other rows are meaningless),
    # and within the lens's `max_radius` too.
    ahead: Booleans
    visible: Booleans
    points: Array  # (n, 3): The points in the camera's axes at those times, length
    # `undistorted`, `distorted`: arrays (n, 2): Normalised image coordinates before and after the lens, both of a
    # point within the lens's `max_radius`.
    undistorted: Array
    distorted: Array
    pixels: Array  # (n, 2): Raw pixels
    # `by_point`, `by_world`: arrays (n, 2, 3): Derivative of the raw pixel with respect to the point in the camera's
    # axes, and in the world's.
    by_point: Array
    by_world: Array


@dataclass(frozen=True)
class Pull(ArrayRows):
    """Linear functions of the raw pixels of n points, and of their derivatives by the point: how n detections pull.

    The derivatives by the point are taken along a line for each coordinate of the pixel. Whatever moves points with
    respect to a camera changes the functions by forces and torques, as in the mechanics of a rigid body.
    """

    pixels: Array  # (n, 2): Weights of the raw pixels
    later: Array  # (n,): Weights of the true times, beside what moves the pixels
    stretches: Array  # (n, 2): Changes of the pixels along the lines
    force: Array  # (n, 3): At the point, in the world's axes
    turned_force: Array  # (n, 3): The same in the camera's axes
    torque: Array  # (n, 3): About the camera's centre, in its axes
    undistorted: Array  # (n, 2, 2): Changes of the undistorted point along each line


@dataclass(frozen=True)
class CameraView(Projection):
    """The view of one camera on points of trajectories at the times of its detections."""

    camera: Camera  # At the current values
    elapsed: Array  # (n,): Time since ``camera.pose.time_s``, s
    log_times: Array  # (n,): Times on the camera's own clock, s
    rows: Array  # (n,): Row of the detection over the height of the image
    # (n, 3, 3) or None: Turn of a moving camera since ``camera.pose.time_s``; None of a camera that does not turn.
    turns: Array | None
    drift: Array  # (n, 3): Velocity of the point with respect to the camera's centre, in the world's axes
    rates: Array | None  # (n, 3): Angular velocity of a camera about its axes, rad/s; None where it does not turn

    @cached_property
    def of_pixels(self) -> tuple[Pull, Pull]:
        """The raw pixels themselves, u and v, as pulls."""
        none = np.zeros((len(self.points), 2))
        first, second = (
            Pull(
                np.broadcast_to(np.eye(2)[r], none.shape), none[:, 0], none, self.by_world[:, r], self.by_point[:, r],
                np.cross(self.points, self.by_point[:, r]), np.broadcast_to(0.0, (*none.shape, 2)),
            )
            for r in (0, 1)
        )  # fmt: skip
        return first, second

    def by_time(self, pull: Pull) -> Array:
        """Derivatives (n, 1) of a pull with respect to the true times of the detections, per second."""
        out = pull.later + np.einsum("na,na->n", pull.force, self.drift)
        if self.rates is not None:
            out -= np.einsum("na,na->n", pull.torque, self.rates)
        return np.asarray(out[:, None])


# What of ``cameras.yaml`` a quantity determines, as nested plain values.
Entry = Mapping[str, Any]


class Quantity(ABC):
    """One kind of unknown of a camera."""

    name: ClassVar[str]
    components: ClassVar[tuple[str, ...]]  # Names of its values, unique among all quantities
    unit: ClassVar[str]  # Unit of the values: ``length``, ``rad``, ``1``, ``px``, ``s``, ``length/s`` or ``rad/s``
    prior: ClassVar[str]  # Key of its standard deviation in ``calibration.priors``
    description: ClassVar[str]  # Description of that key
    affects: ClassVar[str]  # What of an event depends on it
    # Whether only cameras that follow a known trajectory have it (True), only others (False), or all.
    on_path: ClassVar[bool | None] = None
    # Whether the reference camera must not have it: it fixes the frame and the clock of the results.
    of_the_frame: ClassVar[bool] = False
    named: ClassVar[bool] = False  # Whether the prior names the components (``{k1: 0.1}``): not one value, or one each
    prior_unit: ClassVar[float] = 1.0  # The unit of that key in units of the values (degrees: pi / 180)
    largest_std: ClassVar[float] = LARGEST_LENGTH  # Largest value of that key: beyond what any set-up can mean

    def available(self, camera: Camera) -> tuple[str, ...]:
        """Return the components that a camera has."""
        return self.components if self._is_of(camera) else ()

    def apply(self, camera: Camera, values: Array) -> Camera:
        """Return a camera moved by values (k,); the same where it does not have the quantity."""
        return self._apply(camera, values) if self._is_of(camera) else camera

    def difference(self, camera: Camera, other: Camera) -> Array:
        """Return the values (k,) that move a camera to another; zeros where it does not have the quantity."""
        return self._difference(camera, other) if self._is_of(camera) else np.zeros(len(self.components))

    def entry(self, camera: Camera) -> Entry:
        """Return what of ``cameras.yaml`` it determines."""
        return self._entry(camera) if self._is_of(camera) else {}

    @abstractmethod
    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """Derivative (n, k) of a pull at what a view has seen, with respect to the values."""

    def derivative(self, view: CameraView, values: Array) -> Array:
        """Derivative (n, 2, k) of the raw pixels of a view, with respect to the values."""
        return np.stack([self.pulled(view, pull, values) for pull in view.of_pixels], axis=1)

    def pack(self, spaces: Array, camera: Camera, values: Array) -> None:
        """Apply values (h, k) to h packed copies (h, 28 or more) of a camera in place; of poses alone."""
        raise NotImplementedError

    @abstractmethod
    def _apply(self, camera: Camera, values: Array) -> Camera: ...

    @abstractmethod
    def _difference(self, camera: Camera, other: Camera) -> Array: ...

    @abstractmethod
    def _entry(self, camera: Camera) -> Entry: ...

    def _is_of(self, camera: Camera) -> bool:
        return self.on_path in (None, camera.pose.path is not None)

    def key(self, component: str) -> str:
        """Return how a key of a report names one of the components."""
        return component + SUFFIXES[self.unit][0]


class Offset(Quantity):
    """A number or a vector that a camera holds, and that values are added to."""

    place: ClassVar[tuple[str, ...]]  # Names that lead to it in a `Camera`, and by default in ``cameras.yaml``

    def _apply(self, camera: Camera, values: Array) -> Camera:
        moved: Camera = _added(camera, self.place, values)
        return moved

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.atleast_1d(np.asarray(self._held(other) - self._held(camera), dtype=np.float64))

    def _entry(self, camera: Camera) -> Entry:
        return reduce(lambda inner, name: {name: inner}, reversed(self.place), self._held(camera))

    def _held(self, camera: Camera) -> Any:
        return reduce(getattr, self.place, camera)


def _added(holder: Any, place: tuple[str, ...], values: Array) -> Any:
    """Return a copy of what holds a number or a vector at a place, with values added to that."""
    name, *inner = place
    held = getattr(holder, name)
    if inner:
        return replace(holder, **{name: _added(held, tuple(inner), values)})
    return replace(holder, **{name: held + (values if isinstance(held, np.ndarray) else float(values[0]))})
