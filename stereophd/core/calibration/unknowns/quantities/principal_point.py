"""The principal point of a camera: an offset in pixels."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, PIXELS, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera
from stereophd.core.settings import LARGEST_PX


class _PrincipalPoint(Quantity):
    components = ("principal_point_u", "principal_point_v")
    unit, affects = PIXELS, IMAGES
    prior, largest_std = "principal_point_std_px", LARGEST_PX
    description = "standard deviation of the principal point, px; one value or u, v"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Move the principal point by values (2,), px."""
        return replace(camera, cx=camera.cx + float(values[0]), cy=camera.cy + float(values[1]))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.cx - camera.cx, other.cy - camera.cy])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """All pixels move alike."""
        return np.broadcast_to(np.eye(2), (len(view.pixels), 2, 2))

    def _entry(self, camera: Camera) -> Entry:
        return {"intrinsics": {"cx": camera.cx, "cy": camera.cy}}


QUANTITY = _PrincipalPoint()
