"""The aspect of a camera's pixels: the logarithm of a factor on fy over fx."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, RATIO, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera


class _Aspect(Quantity):
    components = ("aspect",)
    unit, affects = RATIO, IMAGES
    prior, largest_std = "aspect_std", 10.0
    description = "standard deviation of fy over fx, relative"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Multiply fy by exp(value)."""
        return replace(camera, fy=camera.fy * float(np.exp(values[0])))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([np.log(other.fy / other.fx / (camera.fy / camera.fx))])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The pixel moves along v only."""
        along = view.camera.fy * view.distorted[:, 1]
        return np.stack([np.zeros_like(along), along], axis=1)[:, :, None]

    def _entry(self, camera: Camera) -> Entry:
        return {"intrinsics": {"fx": camera.fx, "fy": camera.fy}}


QUANTITY = _Aspect()
