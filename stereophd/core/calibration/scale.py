"""The scale of a scene: what of it is free, and what is known of it.

Moving every camera and object away from the reference camera by a common factor changes no pixel. The size
of a scene is measured here by the root mean square distance of the cameras from the reference,

    s = sqrt(mean_k |c_k - c_reference|^2) / (the same under the prior),

and the motion model of the adjustment is stated in units of it: its noise is noise_std * s. The motion model therefore
carries no information about the size of the scene, and the likelihood is exactly flat along the scale. (With
accelerations in absolute units every knot of every trajectory would favour a small scene; with a broad prior of
velocities in an evidence, every object would favour a large one, by s^2.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.parameters import ParameterSet
from stereophd.core.calibration.quantities.center import CENTER

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScaleMeasurement:
    """What is known of the scale.

    Attributes
    ----------
    kind : {"baseline", "log_scale"}
        The distance of two cameras, or the logarithm of s above.
    value, std : float
        Length and length, or pure numbers.
    cameras : tuple of int
        The two cameras of a baseline.
    """

    kind: str
    value: float
    std: float
    cameras: tuple[int, int] = (0, 0)


def scale_is_free(parameters: ParameterSet) -> bool:
    """Whether nothing but the prior fixes the scale: at most one camera centre is known."""
    known = [c for c in parameters.cameras if (parameters.index(c.name, CENTER) < 0).all()]
    return len({tuple(camera.pose.center.tolist()) for camera in known}) <= 1


def log_scale(parameters: ParameterSet, reference: int, values: Array) -> tuple[float, Array]:
    """Logarithm of s and its gradient (m,); zero where the scale is not free.

    Parameters
    ----------
    parameters : ParameterSet
    reference : int
        Index of the reference camera.
    values : array (m,)
    """
    gradient = np.zeros(parameters.size)
    if not scale_is_free(parameters):
        return 0.0, gradient
    origin = parameters.cameras[reference].pose.center
    expected, square = 0.0, 0.0
    std = parameters.prior_std
    for camera in parameters.cameras:
        columns = parameters.index(camera.name, CENTER)
        used = columns >= 0
        if not used.any():
            continue
        mean = camera.pose.center - origin
        offset = mean.copy()
        offset[used] += values[columns[used]]
        expected += float(mean @ mean + (std[columns[used]] ** 2).sum())
        square += float(offset @ offset)
        gradient[columns[used]] = offset[used]
    if square == 0.0:
        return 0.0, np.zeros(parameters.size)
    return 0.5 * float(np.log(square / expected)), gradient / square


def predicted(
    parameters: ParameterSet, reference: int, measurement: ScaleMeasurement, values: Array
) -> tuple[float, Array]:
    """Value of what a `ScaleMeasurement` measures, and its gradient (m,)."""
    if measurement.kind == "log_scale":
        return log_scale(parameters, reference, values)
    gradient = np.zeros(parameters.size)
    offset = np.zeros(3)
    signs = (1.0, -1.0)
    for sign, number in zip(signs, measurement.cameras, strict=True):
        camera = parameters.cameras[number]
        columns = parameters.index(camera.name, CENTER)
        center = camera.pose.center.copy()
        center[columns >= 0] += values[columns[columns >= 0]]
        offset += sign * center
    distance = float(np.linalg.norm(offset))
    for sign, number in zip(signs, measurement.cameras, strict=True):
        columns = parameters.index(parameters.cameras[number].name, CENTER)
        used = columns >= 0
        gradient[columns[used]] = sign * offset[used] / max(distance, 1e-300)
    return distance, gradient
