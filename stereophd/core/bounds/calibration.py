"""Cramer-Rao bound of a calibration: what no unbiased estimator of the cameras can beat.

The posterior bound (H. L. Van Trees, "Detection, Estimation, and Modulation Theory", 1968, section 2.4): the inverse of
the expected information of all detections about camera parameters and trajectories, plus the information of the
priors, the trajectories eliminated. Which detection belongs to which object is taken as known, and a detection
that is expected with probability p_detect counts by that part; so the bound is optimistic.
"""

from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation
from stereophd.core.calibration.adjustment.problem import SQUARED, Observations, Problem
from stereophd.core.calibration.adjustment.solver import gauss_newton_covariance
from stereophd.core.calibration.adjustment.trajectories import fit_states, interpolation, knot_spacing, place_knots
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import view_of
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.motion.base import Motion


class TruePositions(NamedTuple):
    """True position of every object at every frame of every camera."""

    objects: Integers  # (n,): 0, 1, ...
    cameras: Integers  # (n,)
    times: Array  # (n,), s
    positions: Array  # (n, 3)


def calibration_bound(
    parameters: ParameterSet,
    values: Array,
    reference: int,
    motion: Motion,
    truth: TruePositions,
    scale: ScaleMeasurement | None = None,
) -> Array:
    """Return the bound on the covariance (m, m) of parameter values whose true values are (m,), with their priors.

    Of the true positions those in view are used; `scale` is what is known of the scale.
    """
    objects, cameras, times, positions = truth
    built = parameters.build(values)
    seen = np.zeros(len(times), dtype=bool)
    precisions, log_times, heights = np.zeros((len(times), 2, 2)), np.zeros(len(times)), np.zeros(len(times))
    noise = np.inf
    for number, camera in enumerate(built):
        part = np.flatnonzero(cameras == number)
        log_times[part] = camera.clock.to_log(times[part])
        # objects that are seen move little during the readout
        view = view_of(camera, positions[part], np.zeros((len(part), 3)), times[part], log_times[part], heights[part])
        inside = camera.contains(np.where(view.visible[:, None], view.pixels, np.nan))
        heights[part] = view.pixels[:, 1] / camera.height
        seen[part] = inside
        rows = part[inside]
        precisions[rows] = camera.detector.p_detect * np.diag(camera.detector.sigma**-2.0)
        if len(rows):
            depth = float(np.median(view.points[inside, 2]))
            noise = min(noise, depth * float(camera.detector.sigma.min()) / camera.fx)
    _, numbers = np.unique(objects[seen], return_inverse=True)
    count = int(numbers.max()) + 1 if len(numbers) else 0
    detected = [times[seen][numbers == j] for j in range(count)]
    knots = place_knots(detected, knot_spacing(motion, noise), motion)
    observations = Observations(
        numbers, cameras[seen], times[seen], np.zeros((int(seen.sum()), 2)), precisions[seen], log_times[seen],
        heights[seen]
    )  # fmt: skip
    states = fit_states(
        knots, *interpolation(knots, numbers, times[seen]), positions[seen], np.full(int(seen.sum()), noise**-2)
    )
    problem = Problem(parameters, reference, knots, observations, SQUARED, scale)
    return gauss_newton_covariance(Linearisation.of(problem).at(values, states), parameters.prior_std)
