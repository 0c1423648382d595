"""What calibrated cameras leave uncertain, from and to the rows of ``cameras.yaml``, and in the frame of a world."""

from collections.abc import Sequence

import numpy as np

from stereophd.core.alignment.frames import moved_camera
from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.considered import CameraUncertainty
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.truth.registration import Registration, stepped
from stereophd.io.cameras.models import CovarianceRows, covariance_of

# What a world moves of every camera.
POSE_AND_CLOCK = (
    *(f"{name}_{axis}" for name in ("center", "rotation") for axis in "xyz"), "clock_offset", "clock_rate",
)  # fmt: skip


def stated_uncertainty(cameras: Sequence[Camera], rows: CovarianceRows | None) -> CameraUncertainty | None:
    """Return what rows of ``cameras.yaml`` state of cameras; None if they state nothing."""
    if not rows:
        return None
    covariance = covariance_of(rows, tuple(camera.name for camera in cameras))
    names = [name.rpartition(".")[::2] for name in rows]
    stds = np.sqrt(np.diag(covariance)).tolist()
    parameters = tuple(Parameter(part, camera, 0.0, std) for (camera, part), std in zip(names, stds, strict=True))
    return CameraUncertainty(ParameterSet(tuple(cameras), parameters), covariance)


def rows_of(uncertainty: CameraUncertainty) -> CovarianceRows:
    """Return the rows of ``cameras.yaml``; cameras that share a value have a row each."""
    parameters = uncertainty.parameters.parameters
    every = [(f"{name}.{one.name}", place) for place, one in enumerate(parameters) for name in one.cameras]
    places = [place for _, place in every]
    whole = uncertainty.covariance[np.ix_(places, places)]
    return {name: whole[row, : row + 1].tolist() for row, (name, _) in enumerate(every)}


def in_world(
    uncertainty: CameraUncertainty, registration: Registration, center: Array, covariance: Array
) -> CameraUncertainty:
    """Return the uncertainty of cameras that were moved into a world.

    `covariance` (m + 9, m + 9) is that of the values and of the nine of the world, which turn and scale about a centre.
    """
    before = uncertainty.parameters
    known = {(name, one.name) for one in before.parameters for name in one.cameras}
    names = [
        (camera.name, part)
        for camera in before.cameras
        for part in (
            *POSE_AND_CLOCK,
            *sorted(part for name, part in known if name == camera.name and part not in POSE_AND_CLOCK),
        )
    ]

    def moved(values: Array) -> list[Camera]:
        world = stepped(registration, values[before.size :], center, registration.estimates)
        return [moved_camera(camera, world) for camera in before.build(values[: before.size])]

    nothing = np.zeros(before.size + 9)
    after = ParameterSet(tuple(moved(nothing)), tuple(Parameter(part, camera, 0.0, 1.0) for camera, part in names))
    steps = np.maximum(np.sqrt(np.diag(covariance)), 1e-12)
    columns = [
        (after.difference(moved(step * unit)) - after.difference(moved(-step * unit))) / (2.0 * step)
        for step, unit in zip(steps, np.eye(len(steps)), strict=True)
    ]
    jacobian = np.column_stack(columns)
    whole = jacobian @ covariance @ jacobian.T
    kept = np.flatnonzero(np.diag(whole) > 1e-24)
    stds = np.sqrt(np.diag(whole))
    parameters = tuple(Parameter(names[k][1], names[k][0], 0.0, float(stds[k])) for k in kept)
    return CameraUncertainty(ParameterSet(after.cameras, parameters), whole[np.ix_(kept, kept)])
