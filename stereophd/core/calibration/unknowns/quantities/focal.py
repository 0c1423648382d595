"""The focal length of a camera: the logarithm of a factor on fx and fy together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, RATIO, CameraView, Quantity, all_of
from stereophd.core.geometry.camera import Camera

FOCAL = ("focal",)


def apply(camera: Camera, values: Array) -> Camera:
    """Multiply both focal lengths by exp(value)."""
    factor = float(np.exp(values[0]))
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def difference(camera: Camera, other: Camera) -> Array:
    """Return the logarithm of the ratio of the focal lengths along u."""
    return np.array([np.log(other.fx / camera.fx)])


def derivative(view: CameraView, values: Array) -> Array:
    """The pixel moves away from the principal point."""
    return np.asarray((view.distorted * [view.camera.fx, view.camera.fy])[:, :, None])


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return both focal lengths."""
    return {"intrinsics": {"fx": camera.fx, "fy": camera.fy}}


QUANTITY = Quantity(
    name="focal",
    components=FOCAL,
    unit=RATIO,
    prior="focal_std",
    largest_std=10.0,
    description="standard deviation of the focal length, relative; fx and fy together",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=IMAGES,
    available=all_of(FOCAL),
)
