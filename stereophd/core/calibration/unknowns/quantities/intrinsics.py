"""Focal length, aspect, principal point and lens of a camera."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, PIXELS, RATIO, CameraView, Entry, Pull, Quantity
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import PARAMETERS
from stereophd.core.settings import LARGEST_PX

# Step of differences of the derivatives by coefficients, in normalised coordinates: to one side, so that they are wrong
# by this part.
STEP = 1e-7
# In place of a length of 0.
LEAST = 1e-150
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


class Focal(Quantity):
    """The focal length of a camera: the logarithm of a factor on fx and fy together."""

    name = "focal"
    components = ("focal",)
    unit, affects = RATIO, IMAGES
    prior, largest_std = "focal_std", 10.0
    description = "standard deviation of the focal length, relative; fx and fy together"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        factor = float(np.exp(values[0]))
        return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([np.log(other.fx / camera.fx)])

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """The pixel moves away from the principal point."""
        camera, (x, y) = view.camera, view.distorted.T
        out = pull.pixels[:, 0] * (camera.fx * x) + pull.pixels[:, 1] * (camera.fy * y)
        return np.asarray((out + pull.stretches[:, 0] + pull.stretches[:, 1])[:, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"intrinsics": {"fx": camera.fx, "fy": camera.fy}}


class Aspect(Quantity):
    """The aspect of a camera's pixels: the logarithm of a factor on fy over fx."""

    name = "aspect"
    components = ("aspect",)
    unit, affects = RATIO, IMAGES
    prior, largest_std = "aspect_std", 10.0
    description = "standard deviation of fy over fx, relative"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        return replace(camera, fy=camera.fy * float(np.exp(values[0])))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([np.log(other.fy / other.fx / (camera.fy / camera.fx))])

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """The pixel moves along v only."""
        along = view.camera.fy * view.distorted[:, 1]
        return np.asarray((pull.pixels[:, 1] * along + pull.stretches[:, 1])[:, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"intrinsics": {"fx": camera.fx, "fy": camera.fy}}


class PrincipalPoint(Quantity):
    """The principal point of a camera: an offset in pixels."""

    name = "principal_point"
    components = ("principal_point_u", "principal_point_v")
    unit, affects = PIXELS, IMAGES
    prior, largest_std = "principal_point_std_px", LARGEST_PX
    description = "standard deviation of the principal point, px; one value or u, v"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        return replace(camera, cx=camera.cx + float(values[0]), cy=camera.cy + float(values[1]))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.cx - camera.cx, other.cy - camera.cy])

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """All pixels move alike."""
        return pull.pixels

    def _entry(self, camera: Camera) -> Entry:
        return {"intrinsics": {"cx": camera.cx, "cy": camera.cy}}


class Distortion(Quantity):
    """The coefficients of a camera's lens model (k1, k2, p1, ...): offsets without unit."""

    name = "distortion"
    components = DISTORTION
    unit, affects = RATIO, IMAGES
    prior, largest_std = "distortion_std", 1e6
    description = "standard deviations of coefficients of the lens model by name, such as k1"
    named = True

    def available(self, camera: Camera) -> tuple[str, ...]:
        """Return the coefficients of the camera's lens model."""
        return PARAMETERS[camera.lens.model]

    def _apply(self, camera: Camera, values: Array) -> Camera:
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
        return self._slopes(view.camera, view.undistorted[:, None])

    def pulled(self, view: CameraView, pull: Pull, values: Array) -> Array:
        """The pixel moves by its derivative, which changes along the line of each coordinate."""
        before, there = self.derivative(view, values), view.undistorted[:, None]
        lengths = np.hypot(pull.undistorted[:, :, 0], pull.undistorted[:, :, 1]) / STEP
        after = self._slopes(view.camera, there + pull.undistorted / np.maximum(lengths, LEAST)[:, :, None])
        return np.asarray(
            np.einsum("nr,nrk->nk", pull.pixels, before) + np.einsum("nr,nrk->nk", lengths, after - before)
        )

    def _slopes(self, camera: Camera, undistorted: Array) -> Array:
        """Return `derivative` (n, 2, k) with either row at its own point; points (n, 2, 2), or (n, 1, 2) for both."""
        lens, (x, y) = camera.lens, undistorted.T
        s, u, v = x * x + y * y, camera.fx * x[:1], camera.fy * y[-1:]
        uv = np.concatenate([u, v])
        out = np.zeros((len(DISTORTION), 2, len(undistorted)))
        if lens.model == "fisheye":
            radius = np.sqrt(s)
            angle = np.arctan(radius)
            scale = angle / np.where(radius > 0.0, radius, 1.0)
            for name in PARAMETERS["fisheye"]:
                scale = scale * angle**2
                out[DISTORTION.index(name)] = scale * uv
        else:
            denominator = 1.0 + s * (lens.k4 + s * (lens.k5 + s * lens.k6))
            ratio = (1.0 + s * (lens.k1 + s * (lens.k2 + s * lens.k3))) / denominator
            scale = 1.0 / denominator
            for power in (1, 2, 3):
                scale = scale * s
                out[DISTORTION.index(f"k{power}")] = scale * uv
                out[DISTORTION.index(f"k{power + 3}")] = -ratio * scale * uv
            out[2] = 2.0 * u[0] * y[0], camera.fy * (s + 2.0 * y * y)[-1]
            out[3] = camera.fx * (s + 2.0 * x * x)[0], 2.0 * x[-1] * v[0]
        return out.transpose(2, 1, 0)

    def _entry(self, camera: Camera) -> Entry:
        return {
            "distortion": {"model": camera.lens.model, **{n: getattr(camera.lens, n) for n in self.available(camera)}}
        }
