"""The coefficients of a camera's lens model: offsets without unit."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, RATIO, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import PARAMETERS

DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


class _Distortion(Quantity):
    components = DISTORTION
    unit, affects = RATIO, IMAGES
    prior, largest_std = "distortion_std", 1e6
    description = "standard deviations of coefficients of the lens model by name, such as k1"
    named = True

    def available(self, camera: Camera) -> tuple[str, ...]:
        """Return the coefficients of the camera's lens model."""
        return PARAMETERS[camera.lens.model]

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add values (8,) to the coefficients."""
        moved = {
            name: getattr(camera.lens, name) + float(value)
            for name, value in zip(DISTORTION, values, strict=True)
            if name in self.available(camera)
        }
        return replace(camera, lens=replace(camera.lens, **moved)) if moved else camera

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([getattr(other.lens, name) - getattr(camera.lens, name) for name in DISTORTION])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """Derivative of the distorted point with respect to each coefficient, in pixels."""
        lens = view.camera.lens
        x, y = view.undistorted[:, 0], view.undistorted[:, 1]
        s = x * x + y * y
        out = np.zeros((len(s), 2, len(DISTORTION)))
        if lens.model == "fisheye":
            radius = np.sqrt(s)
            angle = np.arctan(radius)
            part = angle / np.where(radius > 0.0, radius, 1.0)
            for power, name in enumerate(PARAMETERS["fisheye"], 1):
                scale = part * angle ** (2 * power)
                column = DISTORTION.index(name)
                out[:, 0, column], out[:, 1, column] = scale * x, scale * y
        else:
            denominator = 1.0 + s * (lens.k4 + s * (lens.k5 + s * lens.k6))
            ratio = (1.0 + s * (lens.k1 + s * (lens.k2 + s * lens.k3))) / denominator
            for power in (1, 2, 3):
                above, below = s**power / denominator, -ratio * s**power / denominator
                column, other = DISTORTION.index(f"k{power}"), DISTORTION.index(f"k{power + 3}")
                out[:, 0, column], out[:, 1, column] = above * x, above * y
                out[:, 0, other], out[:, 1, other] = below * x, below * y
            out[:, 0, 2], out[:, 1, 2] = 2.0 * x * y, s + 2.0 * y * y
            out[:, 0, 3], out[:, 1, 3] = s + 2.0 * x * x, 2.0 * x * y
        return np.asarray(out * np.array([view.camera.fx, view.camera.fy])[:, None])

    def _entry(self, camera: Camera) -> Entry:
        return {
            "distortion": {"model": camera.lens.model, **{n: getattr(camera.lens, n) for n in self.available(camera)}}
        }


QUANTITY = _Distortion()
