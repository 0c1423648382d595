"""The scale at which cameras are given to a filter, where their own is free.

Cameras and objects enlarged together give the same images, so the scale of the cameras at a start, or at an optimum,
is that of their prior, and may be wrong by a factor. The depths that the filter expects of new objects, its limit of
speed and its accelerations are lengths of the scene. With cameras four times too close together all objects are too
near by this factor, and the filter loses most of them. The filter therefore gets the cameras at the scale at which
the objects lie where its prior expects them, and its estimates are brought back.
"""

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.trajectories import interpolation, positions
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.pairing.choice import Pairing
from stereophd.core.calibration.pairing.refinement import meeting_points
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
    seen = fit.observations
    points = positions(fit.adjustment.states, *interpolation(fit.knots, seen.trajectories, seen.times))
    return _ratio(task, fit.adjustment.values, points, (seen.times, seen.cameras, seen.trajectories), within)


def paired_ratio(task: Task, pairing: Pairing) -> float:
    """`depth_ratio` of the objects of paired one-camera tracks, by where their rays meet."""
    rows, times, points = meeting_points(task.parameters, task.pairs, pairing)
    pair = task.pairs.pair[rows]
    of_points = np.repeat(times, 2), task.pairs.cameras[pair].ravel(), np.repeat(pair, 2)
    return _ratio(task, pairing.values, np.repeat(points, 2, axis=0), of_points, KEPT_WITHIN)


def _ratio(
    task: Task, values: Array, points: Array, of_points: tuple[Array, Integers, Integers], within: float
) -> float:
    """`depth_ratio` at values (m,) of points (n, 3): of their times, the cameras that see them, and objects (n,)."""
    if not _rescalable(task):
        return 1.0
    (times, cameras, objects), rig, birth = of_points, task.filter.rig, task.filter.settings.birth
    disparities = np.full(len(points), np.nan)  # over the prior's mean; NaN of points behind the camera
    for number in np.unique(cameras).tolist():
        here = np.flatnonzero(cameras == number)
        pose = task.parameters.build(values)[number].pose.at(float(np.median(times[here])))
        depth = (points[here] - pose.center) @ pose.rotation[2]
        mean, _ = birth.disparity_moments(rig.packed[number])
        disparities[here] = disparity_scale(rig.packed[number]) / mean / np.where(depth > 0.0, depth, np.nan)
    is_known = np.isfinite(disparities)
    medians = [np.median(disparities[is_known & (objects == j)]) for j in np.unique(objects[is_known])]
    if not medians:
        return 1.0
    middle = float(np.median(medians))
    mean, std = birth.disparity_moments(rig.packed[task.reference])
    slack = within * std / mean
    return middle / min(max(middle, 1.0 - slack), 1.0 + slack)


def _rescalable(task: Task) -> bool:
    """Whether nothing but the prior fixes the scale of the cameras, about a reference that stands still."""
    can = can_be_enlarged(task.parameters.cameras, task.reference)
    return can and task.scale is None and scale_is_free(task.parameters)
