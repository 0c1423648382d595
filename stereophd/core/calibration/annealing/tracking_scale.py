"""The scale at which cameras are given to a filter, where their own is free.

Cameras and objects enlarged together give the same images, so the scale of the cameras at a start, or at an optimum,
is that of their prior, and may be wrong by a factor. The depths that the filter expects of new objects, its limit of
speed and its accelerations are lengths of the scene. With cameras four times too close together all objects are too
near by this factor, and the filter loses most of them. The filter therefore gets the cameras at the scale at which
the objects lie where its prior expects them, and its estimates are brought back.
"""

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.unknowns.scale import can_be_enlarged, scale_is_free
from stereophd.core.disparity.trips import disparity_scale

# While tracking, the cameras keep their scale if the median object is within this many standard deviations of the
# prior's mean disparity.
KEPT_WITHIN = 1.0


def depth_ratio(task: Task, fit: Fit, within: float = 0.0) -> float:
    """Factor on all lengths at which the objects of a fit lie at the depths that the filter's birth prior expects.

    The median object may stay where it is `within` so many standard deviations of the prior's disparity. 1 where the
    scale is not free.
    """
    if not _rescalable(task):
        return 1.0
    disparities = _relative_disparities(task, fit)
    of_object = [disparities[fit.observations.trajectories == j] for j in range(fit.knots.count)]
    medians = [float(np.median(known)) for one in of_object if len(known := one[np.isfinite(one)])]
    if not medians:
        return 1.0
    middle = float(np.median(medians))
    mean, std = task.filter.settings.birth.disparity_moments(task.filter.rig.packed[task.reference])
    slack = within * std / mean
    return middle / min(max(middle, 1.0 - slack), 1.0 + slack)


def _relative_disparities(task: Task, fit: Fit) -> Array:
    """Disparity (n,) of each detection of a fit, over the prior's mean; NaN of points behind the camera."""
    seen, rig = fit.observations, task.filter.rig
    points = positions(fit.adjustment.states, *interpolation(fit.knots, seen.trajectories, seen.times))
    out = np.full(len(points), np.nan)
    for number, camera in enumerate(task.parameters.build(fit.adjustment.values)):
        here = np.flatnonzero(seen.cameras == number)
        if not len(here):
            continue
        pose = camera.pose.at(float(np.median(seen.times[here])))
        depth = (points[here] - pose.center) @ pose.rotation[2]
        mean, _ = task.filter.settings.birth.disparity_moments(rig.packed[number])
        scale = disparity_scale(rig.packed[number]) / mean
        out[here] = scale / np.where(depth > 0.0, depth, np.nan)
    return out


def _rescalable(task: Task) -> bool:
    """Whether nothing but the prior fixes the scale of the cameras, about a reference that stands still."""
    can = can_be_enlarged(task.parameters.cameras, task.reference)
    return can and task.scale is None and scale_is_free(task.parameters)
