"""The focal length of a camera: the logarithm of a factor on fx and fy together."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, RATIO, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera


class _Focal(Quantity):
    components = ("focal",)
    unit, affects = RATIO, IMAGES
    prior, largest_std = "focal_std", 10.0
    description = "standard deviation of the focal length, relative; fx and fy together"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Multiply both focal lengths by exp(value)."""
        factor = float(np.exp(values[0]))
        return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([np.log(other.fx / camera.fx)])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The pixel moves away from the principal point."""
        return np.asarray((view.distorted * [view.camera.fx, view.camera.fy])[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"intrinsics": {"fx": camera.fx, "fy": camera.fy}}


QUANTITY = _Focal()
