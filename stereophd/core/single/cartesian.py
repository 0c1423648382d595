"""Kalman filters in world space, extended and unscented: what the paper argues against (I-C, IV-B).

The state is (x, y, z) or (x, y, z, vx, vy, vz) in the world, where the motion is linear and the observation
is not. The first detection and the prior on disparity are carried to the world to first order (extended) or
by sigma points (unscented, without a centre point: all weights equal and positive); so are detections.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.numerics.linear_algebra import condition
from stereophd.core.numerics.samples import cubature_points
from stereophd.core.single.base import SingleEstimate
from stereophd.core.single.gaussian import (
    Gaussian,
    GaussianEstimator,
    GaussianState,
    Observation,
    center,
    first_gaussian,
    place,
    project,
    rotation,
)
from stereophd.core.single.settings import CartesianSettings

# A sigma point beyond infinity has no place in the world: it is put this much further away than the mean.
FARTHEST = 10.0


@dataclass(frozen=True)
class CartesianEstimator(GaussianEstimator):
    """The filters; see `SingleEstimator` for their other fields."""

    settings: CartesianSettings

    def _observed(self, state: GaussianState, predicted: Gaussian, event: Event, space: Array) -> Observation:
        mean, covariance = predicted
        if self.settings.rule == "unscented":
            pixel, matrix, spread = _regression(lambda states: _pixels(space, states), mean, covariance)
            return pixel, matrix, event.covariances[0] + spread
        pixel, jacobian = project(space, rotation(space) @ (mean[:3] - center(space)))
        matrix = np.zeros((2, len(mean)))
        matrix[:, :3] = jacobian @ rotation(space)
        return pixel, matrix, event.covariances[0]

    def _first(self, event: Event, space: Array) -> Gaussian:
        first, whole = first_gaussian(self.prior, space, event, self.state_size)
        local, covariance = first[:3], whole[:3, :3]
        if self.settings.rule == "extended":
            position, jacobian = place(space, local)
            spread = jacobian @ covariance @ jacobian.T
        else:
            samples = local + (np.linalg.cholesky(covariance) @ cubature_points(3)).T
            rays = np.column_stack([samples[:, :2], np.ones(len(samples))])
            depths = 1.0 / np.maximum(samples[:, 2:], local[2] / FARTHEST)
            points = rays * depths @ rotation(space) + center(space)
            position = points.mean(axis=0)
            spread = (points - position).T @ (points - position) / len(points)
        mean = np.append(position, first[3:])
        whole[:3, :3] = spread
        return mean, whole

    def _predicted(self, state: GaussianState, space: Array, time_s: float) -> Gaussian:
        dt = time_s - state.home_s
        if self.state_size == 3 or dt == 0.0:
            return state.mean, state.covariance
        return self.motion.transition(dt).predict(state.mean, state.covariance)

    def _estimate(self, state: GaussianState) -> SingleEstimate:
        """Return the mean, which is the mode, and the covariance."""
        size = self.state_size
        mean, covariance = np.zeros(6), np.zeros((6, 6))
        mean[:size], covariance[:size, :size] = self._predicted(state, state.home, state.time_s)
        return SingleEstimate(mean, mean, covariance)


def _pixels(camera: Array, states: Array) -> Array:
    """Pixels (n, 2) of world states (n, d)."""
    return np.array([project(camera, rotation(camera) @ (state[:3] - center(camera)))[0] for state in states])


def _regression(function: Callable[[Array], Array], mean: Array, covariance: Array) -> tuple[Array, Array, Array]:
    """Statistical linear regression of a function of a Gaussian, at the sigma points of the unscented transform.

    Returns the mean of the function (2,), the matrix (2, d) of the linear function that fits best (a Kalman update with
    it is the unscented filter's), and the covariance (2, 2) of the difference from that function.
    """
    positive = covariance.copy()
    condition(positive, np.empty_like(positive))
    deviations = (np.linalg.cholesky(positive) @ cubature_points(len(mean))).T
    values = function(mean + deviations)
    predicted = values.mean(axis=0)
    residuals = values - predicted
    matrix = np.linalg.solve(positive, deviations.T @ residuals / len(values)).T
    spread = residuals.T @ residuals / len(values) - matrix @ positive @ matrix.T
    return predicted, matrix, (spread + spread.T) / 2.0
