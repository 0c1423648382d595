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
    """The view of one camera on n points of trajectories at the times of its detections.

    Attributes
    ----------
    camera : Camera
        At the current values.
    visible : array (n,) of bool
        Whether the point lies before the camera and within the lens's `max_radius`; other rows are meaningless.
    elapsed : array (n,)
        Time since ``camera.pose.time_s``, s.
    log_times : array (n,)
        Times on the camera's own clock, s.
    rows : array (n,)
        Row of the detection over the height of the image.
    points : array (n, 3)
        The points in the camera's axes at those times, length.
    turns : array (n, 3, 3) or None
        Turn of a moving camera since ``camera.pose.time_s``; None of a camera that does not turn.
    undistorted, distorted : arrays (n, 2)
        Normalised image coordinates before and after the lens.
    by_point, by_world : arrays (n, 2, 3)
        Derivative of the raw pixel with respect to the point in the camera's axes, and in the world's.
    by_time : array (n, 2)
        Derivative of the raw pixel with respect to the true time of the detection, px/s.
    pixels : array (n, 2)
        Raw pixels.
    """

    camera: Camera
    visible: NDArray[np.bool_]
    elapsed: Array
    log_times: Array
    rows: Array
    points: Array
    turns: Array | None
    undistorted: Array
    distorted: Array
    by_point: Array
    by_world: Array
    by_time: Array
    pixels: Array


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
    """One kind of unknown of a camera.

    Attributes
    ----------
    name : str
        The name of its file.
    components : tuple of str
        Names of its values, unique among all quantities.
    unit : str
        Unit of the values: ``length``, ``rad``, ``1``, ``px``, ``s``, ``length/s`` or ``rad/s``.
    prior : str
        Key of its standard deviation in ``calibration.priors``.
    prior_unit : float
        The unit of that key in units of the values (degrees: pi / 180).
    largest_std : float
        Largest value of that key: beyond what any set-up can mean.
    description : str
        Description of that key.
    apply : callable
        (camera, values (k,)) -> the camera moved by them.
    difference : callable
        (camera, other) -> values (k,) that move `camera` to `other`.
    derivative : callable
        (view, values (k,)) -> derivative (n, 2, k) of the raw pixels with respect to the values.
    entry : callable
        camera -> what of ``cameras.yaml`` it determines, as nested plain values.
    affects : {"moves", "images", "times"}
        What of an event depends on it.
    of_the_frame : bool
        Whether the reference camera must not have it: it fixes the frame and the clock of the results.
    named : bool
        Whether the prior names the components (``{k1: 0.1}``) instead of one value or one for each.
    available : callable
        camera -> components that this camera has.
    pack : callable, optional
        (packed cameras (h, 28 or more), camera, values (h, k)): apply values to h packed copies of a camera in place.
    """

    name: str
    components: tuple[str, ...]
    unit: str
    prior: str
    description: str
    apply: Callable[[Camera, Array], Camera]
    difference: Callable[[Camera, Camera], Array]
    derivative: Callable[[CameraView, Array], Array]
    entry: Callable[[Camera], Mapping[str, Any]]
    affects: str
    available: Callable[[Camera], tuple[str, ...]]
    of_the_frame: bool = False
    named: bool = False
    prior_unit: float = 1.0
    largest_std: float = LARGEST_LENGTH
    pack: Callable[[Array, Camera, Array], None] | None = None

    def key(self, component: str) -> str:
        """Return how a key of a report names one of the components."""
        return component + SUFFIXES[self.unit][0]
