"""Calibration quantities: their interface, and the inputs of their derivatives.

A quantity is one kind of unknown of a camera (its centre, its focal length, the offset of its clock, ...) with one or
more components. Values are offsets from the camera at the prior mean. Values of several quantities commute: the camera
does not depend on the order in which they are applied, and the negative values undo them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
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
class CameraView:
    """The view of one camera on n points of trajectories at the times of its detections."""

    camera: Camera  # At the current values
    # (n,) of bool: Whether the point lies before the camera and within the lens's `max_radius`; other rows are
    # meaningless.
    visible: NDArray[np.bool_]
    elapsed: Array  # (n,): Time since ``camera.pose.time_s``, s
    log_times: Array  # (n,): Times on the camera's own clock, s
    rows: Array  # (n,): Row of the detection over the height of the image
    points: Array  # (n, 3): The points in the camera's axes at those times, length
    # (n, 3, 3) or None: Turn of a moving camera since ``camera.pose.time_s``; None of a camera that does not turn.
    turns: Array | None
    # `undistorted`, `distorted`: arrays (n, 2): Normalised image coordinates before and after the lens.
    undistorted: Array
    distorted: Array
    # `by_point`, `by_world`: arrays (n, 2, 3): Derivative of the raw pixel with respect to the point in the camera's
    # axes, and in the world's.
    by_point: Array
    by_world: Array
    by_time: Array  # (n, 2): Derivative of the raw pixel with respect to the true time of the detection, px/s
    pixels: Array  # (n, 2): Raw pixels


def all_of(components: tuple[str, ...]) -> Callable[[Camera], tuple[str, ...]]:
    """Return the function that finds all components in any camera."""
    return partial(_components, components)


def _components(components: tuple[str, ...], camera: Camera) -> tuple[str, ...]:
    return components


def without_path(components: tuple[str, ...]) -> Callable[[Camera], tuple[str, ...]]:
    """Return the function that finds components in cameras that follow no known trajectory."""
    return partial(_by_path, components, False)


def on_path(components: tuple[str, ...]) -> Callable[[Camera], tuple[str, ...]]:
    """Return the function that finds components in cameras that follow a known trajectory."""
    return partial(_by_path, components, True)


def _by_path(components: tuple[str, ...], follows: bool, camera: Camera) -> tuple[str, ...]:
    return components if (camera.pose.path is not None) == follows else ()


@dataclass(frozen=True)
class Quantity:
    """One kind of unknown of a camera."""

    name: str  # The name of its file
    components: tuple[str, ...]  # Names of its values, unique among all quantities
    unit: str  # Unit of the values: ``length``, ``rad``, ``1``, ``px``, ``s``, ``length/s`` or ``rad/s``
    prior: str  # Key of its standard deviation in ``calibration.priors``
    description: str  # Description of that key
    apply: Callable[[Camera, Array], Camera]  # (camera, values (k,)) -> the camera moved by them
    difference: Callable[[Camera, Camera], Array]  # (camera, other) -> values (k,) that move `camera` to `other`
    # (view, values (k,)) -> derivative (n, 2, k) of the raw pixels with respect to the values.
    derivative: Callable[[CameraView, Array], Array]
    # camera -> what of ``cameras.yaml`` it determines, as nested plain values.
    entry: Callable[[Camera], Mapping[str, Any]]
    affects: str  # What of an event depends on it
    available: Callable[[Camera], tuple[str, ...]]  # camera -> components that this camera has
    # Whether the reference camera must not have it: it fixes the frame and the clock of the results.
    of_the_frame: bool = False
    named: bool = False  # Whether the prior names the components (``{k1: 0.1}``) instead of one value or one for each
    prior_unit: float = 1.0  # The unit of that key in units of the values (degrees: pi / 180)
    largest_std: float = LARGEST_LENGTH  # Largest value of that key: beyond what any set-up can mean
    # (packed cameras (h, 28 or more), camera, values (h, k)): apply values to h packed copies of a camera in place.
    pack: Callable[[Array, Camera, Array], None] | None = None

    def key(self, component: str) -> str:
        """Return how a key of a report names one of the components."""
        return component + SUFFIXES[self.unit][0]
