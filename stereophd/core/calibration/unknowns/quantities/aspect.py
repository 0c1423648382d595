"""The aspect of a camera's pixels: the logarithm of a factor on fy over fx."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, RATIO, CameraView, Quantity, all_of
from stereophd.core.geometry.camera import Camera

ASPECT = ("aspect",)


def apply(camera: Camera, values: Array) -> Camera:
    """Multiply fy by exp(value)."""
    return replace(camera, fy=camera.fy * float(np.exp(values[0])))


def difference(camera: Camera, other: Camera) -> Array:
    """Return the logarithm of the ratio of fy over fx."""
    return np.array([np.log(other.fy / other.fx / (camera.fy / camera.fx))])


def derivative(view: CameraView, values: Array) -> Array:
    """The pixel moves along v only."""
    along = view.camera.fy * view.distorted[:, 1]
    return np.stack([np.zeros_like(along), along], axis=1)[:, :, None]


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return both focal lengths."""
    return {"intrinsics": {"fx": camera.fx, "fy": camera.fy}}


QUANTITY = Quantity(
    name="aspect",
    components=ASPECT,
    unit=RATIO,
    prior="aspect_std",
    largest_std=10.0,
    description="standard deviation of fy over fx, relative",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=IMAGES,
    available=all_of(ASPECT),
)
