"""The limit of multi-object tracking: least squares on all data so far, the true associations known.

An object moves without noise. Its parameters are (u, v, d) in the disparity space of the camera that saw it first, at
that time, and its velocity in the world: in these coordinates the first observation and the prior of the depth are
linear. The most probable parameters given all detections so far minimise

    sum_k (z_k - h_k(theta))^T R_k^-1 (z_k - h_k(theta)) + (d - mean)^2 / std^2 + |v|^2 / velocity_std^2,

found by the method of Levenberg and Marquardt for all objects at once, anew after each time, from the
parameters of the time before. The covariance is the inverse of the information there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import undistorted_detections
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import projective
from stereophd.core.motion.base import Motion
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.numerics.rows import ArrayRows

# Steps until none would lower the cost of its object by this much, relative to one plus itself.
TOLERANCE = 1e-9
MOST_STEPS = 50
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e12


@dataclass(frozen=True)
class AssociatedDetections(ArrayRows):
    """Detections of objects, in order of time."""

    row: NDArray[np.int64]  # (m,) of int: The object, as a row of the results
    time_s: Array  # (m,)
    projection: Array  # (m, 3, 4): World to undistorted pixels, of the camera at that time
    points: Array  # (m, 2): Undistorted pixels
    whitening: Array  # (m, 2, 2): W with W^T W the inverse of the noise covariance


@dataclass(frozen=True)
class _Paths:
    """First sightings of the n objects, known before all other data: place and time of each."""

    start_s: Array
    to_world: Array
    prior_disparity: Array
    prior_std: Array
    velocity_std: float
    motion: Motion


def sight(camera: Camera, time_s: float, pixels: Array, rows: NDArray[np.int64]) -> AssociatedDetections:
    """Return the detections (m, 2) of one frame, distorted pixels."""
    count = len(pixels)
    points, covariances, _ = undistorted_detections(camera, pixels, np.tile(camera.detector.sigma, (count, 1)))
    whitening = np.linalg.inv(np.linalg.cholesky(covariances)) if count else np.zeros((0, 2, 2))
    projection = np.broadcast_to(camera.at(time_s).projection_matrix, (count, 3, 4))
    return AssociatedDetections(rows, np.full(count, time_s), projection, points, whitening)


def noiseless_paths(
    detections: AssociatedDetections,
    first: Sequence[tuple[DisparitySpace, float, Array] | None],
    prior: BirthPrior,
    times_s: Array,
    motion: Motion,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Estimate all n objects after each of the (increasing) times, as if the motion had no noise.

    `first` has, for each object, its first detection: the disparity space, the time, and the undistorted pixel (2,);
    None of an object that is never seen. Returns world states (t, n, 6), NaN before the first detection, their
    covariances (t, n, 6, 6), and whether each object was seen up to that time (t, n).
    """
    count = len(first)
    paths, parameters = _begin(first, prior, motion)
    states = np.full((len(times_s), count, 6), np.nan)
    covariances = np.full((len(times_s), count, 6, 6), np.nan)
    seen = paths.start_s[None, :] <= times_s[:, None]
    for k, time_s in enumerate(times_s):
        data = detections.take(slice(int(np.searchsorted(detections.time_s, time_s, side="right"))))
        known = seen[k]
        if not known.any():
            continue
        parameters, information = _fit(paths, data, parameters)
        points, jacobian = projective(paths.to_world, parameters[:, :3])
        reach, keep, drift = motion.flow(time_s - paths.start_s[known])
        states[k, known, 3:] = keep[:, None] * parameters[known, 3:] + drift[:, 3:]
        states[k, known, :3] = points[known] + reach[:, None] * parameters[known, 3:] + drift[:, :3]
        to_state = np.zeros((int(known.sum()), 6, 6))
        to_state[:, :3, :3] = jacobian[known]
        to_state[:, :3, 3:] = reach[:, None, None] * np.eye(3)
        to_state[:, 3:, 3:] = keep[:, None, None] * np.eye(3)
        covariances[k, known] = to_state @ np.linalg.inv(information[known]) @ np.swapaxes(to_state, 1, 2)
    return states, covariances, seen


def _begin(
    first: Sequence[tuple[DisparitySpace, float, Array] | None], prior: BirthPrior, motion: Motion
) -> tuple[_Paths, Array]:
    count = len(first)
    start_s = np.full(count, np.inf)
    to_world = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    disparity, std = np.ones(count), np.ones(count)
    parameters = np.zeros((count, 6))
    for row, seen in enumerate(first):
        if seen is None:
            continue
        space, start_s[row], parameters[row, :2] = seen
        to_world[row] = space.inverse_projective_matrix
        disparity[row], std[row] = prior.disparity_moments(space.packed())
    parameters[:, 2] = disparity
    return _Paths(start_s, to_world, disparity, std, prior.velocity_std, motion), parameters


def _fit(paths: _Paths, data: AssociatedDetections, parameters: Array) -> tuple[Array, Array]:
    """Minimise the cost of every object; return the parameters (n, 6) and the information (n, 6, 6) there."""
    damping = np.full(len(parameters), FIRST_DAMPING)
    cost, gradient, information = _normal_equations(paths, data, parameters)
    for _ in range(MOST_STEPS):
        diagonal = np.einsum("nii->ni", information)
        damped = information + damping[:, None, None] * diagonal[:, :, None] * np.eye(6)
        step = np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        proposed = parameters + step
        new_cost, new_gradient, new_information = _normal_equations(paths, data, proposed)
        better = (new_cost <= cost) & (proposed[:, 2] > 0.0)
        damping = np.clip(np.where(better, damping * 0.1, damping * 10.0), LEAST_DAMPING, MOST_DAMPING)
        settled = (step * gradient).sum(axis=1) <= TOLERANCE * (1.0 + cost)
        parameters = np.where(better[:, None], proposed, parameters)
        cost = np.where(better, new_cost, cost)
        gradient = np.where(better[:, None], new_gradient, gradient)
        information = np.where(better[:, None, None], new_information, information)
        if settled.all():
            break
    return parameters, information


def _normal_equations(paths: _Paths, data: AssociatedDetections, parameters: Array) -> tuple[Array, Array, Array]:
    """Cost (n,), descent direction (n, 6) and information (n, 6, 6) at these parameters."""
    count = len(parameters)
    world, to_world = projective(paths.to_world, parameters[:, :3])
    flow = paths.motion.flow(data.time_s - paths.start_s[data.row])
    points = world[data.row] + flow.reach[:, None] * parameters[data.row, 3:] + flow.drift[:, :3]
    pixels, slope = projective(data.projection, points)
    slope = data.whitening @ slope
    residual = np.einsum("mij,mj->mi", data.whitening, data.points - pixels)
    jacobian = np.concatenate([slope @ to_world[data.row], flow.reach[:, None, None] * slope], axis=2)
    cost: Array = np.bincount(data.row, (residual**2).sum(axis=1), minlength=count).astype(np.float64)
    gradient = np.zeros((count, 6))
    np.add.at(gradient, data.row, np.einsum("mij,mi->mj", jacobian, residual))
    information = np.zeros((count, 6, 6))
    np.add.at(information, data.row, np.swapaxes(jacobian, 1, 2) @ jacobian)
    offset = (parameters[:, 2] - paths.prior_disparity) / paths.prior_std
    cost += offset**2 + ((parameters[:, 3:] / paths.velocity_std) ** 2).sum(axis=1)
    gradient[:, 2] -= offset / paths.prior_std
    gradient[:, 3:] -= parameters[:, 3:] / paths.velocity_std**2
    information[:, 2, 2] += 1.0 / paths.prior_std**2
    information[:, range(3, 6), range(3, 6)] += 1.0 / paths.velocity_std**2
    # an object that is not seen yet has only the information of the prior, and no pixel
    unseen = np.bincount(data.row, minlength=count) == 0
    information[unseen] = np.eye(6)
    gradient[unseen] = 0.0
    return cost, gradient, information
