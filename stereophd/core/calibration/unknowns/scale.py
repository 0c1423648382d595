"""The scale of a scene: which part of it is free, and the knowledge that fixes it.

Moving every camera and object away from the reference camera by a common factor changes no pixel. The size
of a scene is measured here by the root mean square distance of the cameras from the reference,

    s = sqrt(mean_k |c_k - c_reference|^2) / (the same under the prior),

and the motion model of the adjustment is stated in units of it: its noise is noise_std * s. The motion model therefore
carries no information about the size of the scene, and the likelihood is exactly flat along the scale. (With
accelerations in absolute units every knot of every trajectory would favour a small scene; with a broad prior of
velocities in an evidence, every object would favour a large one, by s^2.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose

# Less probable under the prior than this are cameras that have fallen together. Two cameras 1 cm apart have a
# probability of 8e-8 if their distance is unknown by 1.5 m.
LEAST_PROBABILITY_OF_NEARNESS = 1e-8


@dataclass(frozen=True)
class ScaleMeasurement:
    """What is known of the scale."""

    # The distance of two cameras (``baseline``), or the logarithm of s above (``log_scale``), which a ``speed`` or a
    # ``length`` of the scene measures once trajectories are fitted
    kind: str
    # `value`, `std`: Length and length, or pure numbers.
    value: float
    std: float
    cameras: tuple[int, int] = (0, 0)  # The two cameras of a baseline


def scale_is_free(parameters: ParameterSet) -> bool:
    """Whether nothing but the prior fixes the scale: at most one camera centre is known."""
    known = [c for c in parameters.cameras if (parameters.index(c.name, CENTER) < 0).all()]
    return len({tuple(camera.pose.center.tolist()) for camera in known}) <= 1


def log_scale(parameters: ParameterSet, reference: int, values: Array) -> tuple[float, Array]:
    """Logarithm of s at values (m,), and its gradient (m,); zero where the scale is not free."""
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


def collapse(parameters: ParameterSet, reference: int, values: Array) -> str | None:
    """Why the cameras lie too near together for the prior; None if they do not, or if their scale is not free."""
    if log_probability_of_nearness(parameters, reference, values) >= np.log(LEAST_PROBABILITY_OF_NEARNESS):
        return None
    return "the cameras lie together in one place, nearer than the prior allows"


def log_probability_of_nearness(parameters: ParameterSet, reference: int, values: Array) -> float:
    """Logarithm of the prior probability that the cameras of values (m,) lie as near to the reference, or nearer.

    Where two cameras are in one place every detection of one meets some of the other, at no depth: an adjustment that
    began at wrong pairs may end there. A prior of d coordinates of centres with the density p gives the ball of the
    radius R about the reference the probability p V_d R^d, with V_d the volume of the unit ball (for R small against
    the prior's standard deviations). 0 where the scale is not free, or another camera's centre has a known coordinate.
    """
    if not scale_is_free(parameters):
        return 0.0
    origin = parameters.cameras[reference].pose.center
    square, log_density, count = 0.0, 0.0, 0
    for number, camera in enumerate(parameters.cameras):
        columns = parameters.index(camera.name, CENTER)
        if number == reference:
            continue
        if (columns < 0).any():
            return 0.0
        moved, std = values[columns], parameters.prior_std[columns]
        square += float(((camera.pose.center + moved - origin) ** 2).sum())
        log_density += float((-0.5 * (moved / std) ** 2 - np.log(std * np.sqrt(2.0 * np.pi))).sum())
        count += len(columns)
    radius = np.sqrt(square)
    log_volume = 0.5 * count * np.log(np.pi) - gammaln(0.5 * count + 1.0) + count * np.log(max(radius, 1e-300))
    return float(log_density + log_volume)


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


def can_be_enlarged(cameras: Sequence[Camera], reference: int) -> bool:
    """Whether the reference stands still and no camera follows a known trajectory, whose scale is known."""
    return cameras[reference].pose.is_static and all(camera.pose.path is None for camera in cameras)


def enlarged(cameras: Sequence[Camera], reference: int, ratio: float) -> tuple[Camera, ...]:
    """Return cameras whose distances from the reference camera, and velocities, are multiplied by a factor."""
    if ratio == 1.0:
        return tuple(cameras)
    origin = cameras[reference].pose.center

    def moved(pose: Pose) -> Pose:
        center = origin + ratio * (pose.center - origin)
        return Pose(pose.rotation, center, ratio * pose.velocity, pose.rotation_rate, pose.time_s)

    return tuple(replace(camera, pose=moved(camera.pose)) for camera in cameras)


def reduced(points: Array, cameras: Sequence[Camera], reference: int, ratio: float) -> Array:
    """Return points (n, 3) before `enlarged` cameras as points before the cameras themselves."""
    origin = cameras[reference].pose.center
    return np.asarray(origin + (points - origin) / ratio) if ratio != 1.0 else points
