"""The principal point of a camera: an offset in pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import IMAGES, PIXELS, CameraView, Quantity, all_of
from stereophd.core.geometry.camera import Camera
from stereophd.core.settings import LARGEST_PX

PRINCIPAL_POINT = ("principal_point_u", "principal_point_v")


def apply(camera: Camera, values: Array) -> Camera:
    """Move the principal point by values (2,), px."""
    return replace(camera, cx=camera.cx + float(values[0]), cy=camera.cy + float(values[1]))


def difference(camera: Camera, other: Camera) -> Array:
    """Return what moves one principal point to the other."""
    return np.array([other.cx - camera.cx, other.cy - camera.cy])


def derivative(view: CameraView, values: Array) -> Array:
    """All pixels move alike."""
    return np.broadcast_to(np.eye(2), (len(view.pixels), 2, 2))


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the principal point."""
    return {"intrinsics": {"cx": camera.cx, "cy": camera.cy}}


QUANTITY = Quantity(
    name="principal_point",
    components=PRINCIPAL_POINT,
    unit=PIXELS,
    prior="principal_point_std_px",
    largest_std=LARGEST_PX,
    description="standard deviation of the principal point, px; one value or u, v",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=IMAGES,
    available=all_of(PRINCIPAL_POINT),
)
