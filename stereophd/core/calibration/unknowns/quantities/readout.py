"""The readout time of a rolling shutter."""

from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.base import SECONDS, TIMES, CameraView, Entry, Quantity
from stereophd.core.geometry.camera import Camera


class _Readout(Quantity):
    components = ("readout",)
    unit, affects = SECONDS, TIMES
    prior, largest_std = "readout_std_s", 1e3
    description = "standard deviation of the readout time of a rolling shutter, s"

    def _apply(self, camera: Camera, values: Array) -> Camera:
        """Add a value to the readout time, s."""
        return replace(camera, readout_s=camera.readout_s + float(values[0]))

    def _difference(self, camera: Camera, other: Camera) -> Array:
        return np.array([other.readout_s - camera.readout_s])

    def derivative(self, view: CameraView, values: Array) -> Array:
        """The time of a detection changes by its row over the height."""
        return np.asarray((view.rows[:, None] * view.by_time)[:, :, None])

    def _entry(self, camera: Camera) -> Entry:
        return {"readout_s": camera.readout_s}


QUANTITY = _Readout()
