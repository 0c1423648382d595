"""The readout time of a rolling shutter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import SECONDS, TIMES, CameraView, Quantity, all_of
from stereophd.core.geometry.camera import Camera

READOUT = ("readout",)


def apply(camera: Camera, values: Array) -> Camera:
    """Add a value to the readout time, s."""
    return replace(camera, readout_s=camera.readout_s + float(values[0]))


def difference(camera: Camera, other: Camera) -> Array:
    """Return the difference of the two."""
    return np.array([other.readout_s - camera.readout_s])


def derivative(view: CameraView, values: Array) -> Array:
    """The time of a detection changes by its row over the height."""
    return np.asarray((view.rows[:, None] * view.by_time)[:, :, None])


def entry(camera: Camera) -> Mapping[str, Any]:
    """Return the readout time."""
    return {"readout_s": camera.readout_s}


QUANTITY = Quantity(
    name="readout",
    components=READOUT,
    unit=SECONDS,
    prior="readout_std_s",
    largest_std=1e3,
    description="standard deviation of the readout time of a rolling shutter, s",
    apply=apply,
    difference=difference,
    derivative=derivative,
    entry=entry,
    affects=TIMES,
    available=all_of(READOUT),
)
