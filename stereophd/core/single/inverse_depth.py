"""Extended Kalman filter on inverse depth: what the paper compares disparity space with (VIII-A; its [7], [32]).

The state is (a, b, rho), the ray ``r = (a, b, 1)`` and the inverse depth of the object in the axes of the
camera that saw it first (the anchor), and the velocity in the world of a moving object. Any other camera at c
with rotation R sees, up to scale,

    R (R_0^T r + rho (c_0 - c)),

smooth through rho = 0. The pixel is a quotient of it, which the filter linearises at the predicted mean.
A moving object goes from r to ``h = r + rho R_0 (reach v + drift)`` (`core.motion`), of which a' = h_1 / h_3,
b' = h_2 / h_3, rho' = rho / h_3.
Rays by slopes and not by angles (as in [7]): the prior is then the Gaussian of disparity space, rescaled.
"""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.single import gaussian
from stereophd.core.single.base import SingleEstimate


@dataclass(frozen=True)
class InverseDepthEstimator(gaussian.GaussianEstimator):
    """The filter; the home of a state, a Gaussian on (a, b, rho) or (a, b, rho, vx, vy, vz), is its anchor."""

    def _home(self, state: gaussian.GaussianState | None, space: Array) -> Array:
        return space if state is None else state.home

    def _first(self, event: Event, space: Array) -> gaussian.Gaussian:
        return gaussian.first_gaussian(self.prior, space, event, self.state_size)

    def _observed(
        self, state: gaussian.GaussianState, predicted: gaussian.Gaussian, event: Event, space: Array
    ) -> gaussian.Observation:
        mean, back = predicted[0], gaussian.rotation(state.home).T
        # d (rho times the point in the camera's axes) / d (a, b, rho)
        in_world = np.column_stack([back[:, :2], gaussian.center(state.home) - gaussian.center(space)])
        scaled = in_world @ mean[:3] + back[:, 2]
        pixel, jacobian = gaussian.project(space, gaussian.rotation(space) @ scaled)
        matrix = np.zeros((2, len(mean)))
        matrix[:, :3] = jacobian @ gaussian.rotation(space) @ in_world
        return pixel, matrix, event.covariances[0]

    def _predicted(self, state: gaussian.GaussianState, space: Array, time_s: float) -> gaussian.Gaussian:
        dt = time_s - state.home_s
        if self.state_size == 3 or dt == 0.0:
            return state.mean, state.covariance
        moved, noise, drift = self.motion.transition(dt)
        reach, keep = moved[0, 3], moved[3, 3]
        axes = gaussian.rotation(state.home)
        rho, velocity = state.mean[2], state.mean[3:]
        h = np.array([state.mean[0], state.mean[1], 1.0]) + rho * reach * axes @ velocity + rho * axes @ drift[:3]
        mean = state.mean.copy()
        mean[3:] = keep * velocity + drift[3:]
        mean[0], mean[1], mean[2] = h[0] / h[2], h[1] / h[2], rho / h[2]
        # columns: a, b, rho, velocity, noise of position
        d_h = np.zeros((3, 9))
        d_h[0, 0] = d_h[1, 1] = 1.0
        d_h[:, 2] = reach * axes @ velocity + axes @ drift[:3]
        d_h[:, 3:6] = rho * reach * axes
        d_h[:, 6:] = rho * axes
        d_rho = np.zeros(9)
        d_rho[2] = 1.0
        jacobian = np.stack([d_h[0] - mean[0] * d_h[2], d_h[1] - mean[1] * d_h[2], d_rho - mean[2] * d_h[2]]) / h[2]
        transition = np.eye(6)
        transition[:3] = jacobian[:, :6]
        transition[3:, 3:] = keep * np.eye(3)
        into = np.eye(6)
        into[:3, :3] = jacobian[:, 6:]
        return mean, transition @ state.covariance @ transition.T + into @ noise @ into.T

    def _estimate(self, state: gaussian.GaussianState) -> SingleEstimate:
        """Return the mean mapped to the world, with its covariance to first order."""
        mean, covariance = self._predicted(state, state.home, state.time_s)
        if not mean[2] > 0.0:
            return SingleEstimate(np.full(6, np.nan), np.full(6, np.nan), np.full((6, 6), np.nan))
        out, jacobian = np.zeros(6), np.eye(6, len(mean))
        out[:3], jacobian[:3, :3] = gaussian.place(state.home, mean)
        out[3 : len(mean)] = mean[3:]
        return SingleEstimate(out, out, jacobian @ covariance @ jacobian.T)
