"""What the Gaussian estimators share: states, their linear update, and cameras to first order.

Cameras are packed (`stereophd.core.geometry.layout`), pixels undistorted.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.geometry.projection import pinhole
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.single.base import SingleEstimate, SingleEstimator, SingleState

# Mean (d,) and covariance (d, d).
Gaussian = tuple[Array, Array]
# Predicted pixel (2,), its derivative (2, d), and the noise (2, 2) of the detection.
Observation = tuple[Array, Array, Array]


@dataclass(frozen=True)
class GaussianState(SingleState):
    """A Gaussian, in a space of the estimator's own."""

    # `mean`, `covariance`: arrays (d,), (d, d): Empty before the first detection.
    mean: Array
    covariance: Array
    home: Array  # (30,): Packed space that the Gaussian belongs to, as it was then; empty before the first detection


@dataclass(frozen=True)
class GaussianEstimator(SingleEstimator[GaussianState]):
    """An estimator of Gaussian states; see `SingleEstimator` for its fields."""

    def init(self) -> GaussianState:
        """Return the state before the first detection."""
        return GaussianState(0.0, 0.0, 0, np.empty(0), np.empty((0, 0)), np.empty(0))

    def _detected(self, state: GaussianState, event: Event, space: Array, time_s: float) -> tuple[GaussianState, float]:
        """Predict and update; a detection that the state cannot have made starts it anew.

        What cannot be linearised at the predicted mean leaves the state as it is.
        """
        predicted = self._predicted(state, space, time_s) if len(state.mean) else None
        if predicted is None:
            mean, covariance = self._first(event, space)
            home, log_likelihood = self._home(None, space), self.first_density(event)
        else:
            pixel, matrix, noise = self._observed(state, predicted, event, space)
            if not (np.isfinite(pixel).all() and np.isfinite(matrix).all()):
                return self._unchanged(state, event), 0.0
            mean, covariance, log_density = linear_update(*predicted, matrix, pixel, event.points[0], noise)
            home, log_likelihood = self._home(state, space), log_density + math.log(event.areas[0])
        after = GaussianState(event.time_s, time_s, state.n_events + 1, mean, covariance, home)
        return after, log_likelihood

    def _home(self, state: GaussianState | None, space: Array) -> Array:
        """Return the home of the next state: the space of its detection; the state is None where it starts anew."""
        return space

    @abstractmethod
    def _first(self, event: Event, space: Array) -> Gaussian:
        """Return the Gaussian of a first detection and the prior."""

    @abstractmethod
    def _predicted(self, state: GaussianState, space: Array, time_s: float) -> Gaussian | None:
        """Return the Gaussian at a time, before a detection in a packed space (30,); None if it can make none there."""

    @abstractmethod
    def _observed(self, state: GaussianState, predicted: Gaussian, event: Event, space: Array) -> Observation:
        """Return what a predicted state expects of the detection of an event, whose camera has a packed space (30,)."""

    def estimate(self, state: GaussianState) -> SingleEstimate | None:
        """Return where the object is at the state's time; None before its first detection."""
        return self._estimate(state) if len(state.mean) else None

    @abstractmethod
    def _estimate(self, state: GaussianState) -> SingleEstimate:
        """Return where an object that was seen is."""


def rotation(camera: Array) -> Array:
    """Rotation (3, 3) of a packed camera, world to camera."""
    return np.asarray(camera[ROTATION : ROTATION + 9].reshape(3, 3))


def center(camera: Array) -> Array:
    """Centre (3,) of a packed camera, in the world."""
    return np.asarray(camera[CENTER : CENTER + 3])


def project(camera: Array, point: Array) -> tuple[Array, Array]:
    """Pixel (2,) of a point (3,) in the camera's axes, and its Jacobian (2, 3).

    Defined up to the scale of the point (the Jacobian is that of the scale given), and behind the camera
    too; infinite or NaN at depth 0.
    """
    focal = camera[[FX, FY]]
    slopes, jacobian = pinhole(point[None], focal)
    return slopes[0] * focal + camera[[CX, CY]], jacobian[0]


def ray(camera: Array, pixel: Array) -> Array:
    """Direction (3,) of a pixel in the camera's axes, of depth 1."""
    return np.array([(pixel[0] - camera[CX]) / camera[FX], (pixel[1] - camera[CY]) / camera[FY], 1.0])


def velocity_covariance(prior: InitialPrior, space: Array, pixel: Array, rho: float) -> Array:
    """Prior covariance (3, 3) of the velocity in the world, about 0, of an object of known inverse depth."""
    if prior.disparity_velocity_std_px_s is None:
        return prior.velocity_spread**2 * np.eye(3)
    # v = (r' - r rho' / rho) / rho in the camera's axes, with r' = (du / fx, dv / fy, 0), rho' = dd / (f b)
    per_pixel = np.diag([1.0 / space[FX], 1.0 / space[FY], 0.0]) / rho
    per_pixel[:, 2] = -ray(space, pixel) / (disparity_scale(space) * rho**2)
    jacobian = rotation(space).T @ per_pixel
    return np.asarray(jacobian @ np.diag(np.square(prior.disparity_velocity_std_px_s)) @ jacobian.T)


def first_gaussian(prior: InitialPrior, camera: Array, event: Event, size: int) -> Gaussian:
    """Gaussian (d,), (d, d) of an object seen for the first time: slopes and inverse depth, and velocity in the world.

    Slopes and inverse depth (a, b, rho) are in the camera's axes.
    """
    # rho = d / (f b)
    rho, rho_std = (value / disparity_scale(camera) for value in prior.disparity_moments(camera))
    mean, covariance = np.zeros(size), np.zeros((size, size))
    mean[:3] = ray(camera, event.points[0])
    mean[2] = rho
    focal = camera[[FX, FY]]
    covariance[:2, :2] = event.covariances[0] / np.outer(focal, focal)
    covariance[2, 2] = rho_std**2
    if size == 6:
        covariance[3:, 3:] = velocity_covariance(prior, camera, event.points[0], rho)
    return mean, covariance


def place(camera: Array, local: Array) -> tuple[Array, Array]:
    """World position (3,) of slopes and inverse depth (a, b, rho) in a camera's axes, and its Jacobian (3, 3)."""
    back, rho = rotation(camera).T, local[2]
    point = back @ [local[0], local[1], 1.0] / rho
    return center(camera) + point, np.column_stack([back[:, 0] / rho, back[:, 1] / rho, -point / rho])


@compiled
def linear_update(
    mean: Array, covariance: Array, matrix: Array, predicted: Array, point: Array, noise: Array
) -> tuple[Array, Array, float]:
    """Kalman update of a Gaussian (d,), (d, d) with one detection (2,), (2, 2).

    The observation is linearised: by the matrix (2, d) about the mean, where it is `predicted` (2,), px. Returns mean
    and covariance, by Joseph's form, which stays positive definite, and the logarithm of the predicted density of the
    detection.
    """
    size = mean.shape[0]
    cross = np.zeros((size, 2))
    for a in range(size):
        for o in range(2):
            for b in range(size):
                cross[a, o] += covariance[a, b] * matrix[o, b]
    s00, s01, s11 = noise[0, 0], noise[0, 1], noise[1, 1]
    for a in range(size):
        s00 += matrix[0, a] * cross[a, 0]
        s01 += matrix[0, a] * cross[a, 1]
        s11 += matrix[1, a] * cross[a, 1]
    determinant = s00 * s11 - s01 * s01
    du, dv = point[0] - predicted[0], point[1] - predicted[1]
    out_mean = mean.copy()
    gain = np.empty((size, 2))
    left = np.eye(size)
    for a in range(size):
        gain[a, 0] = (cross[a, 0] * s11 - cross[a, 1] * s01) / determinant
        gain[a, 1] = (cross[a, 1] * s00 - cross[a, 0] * s01) / determinant
        out_mean[a] += gain[a, 0] * du + gain[a, 1] * dv
        for b in range(size):
            left[a, b] -= gain[a, 0] * matrix[0, b] + gain[a, 1] * matrix[1, b]
    out_covariance = left @ covariance @ left.T + gain @ noise @ gain.T
    squared = (s11 * du * du - 2.0 * s01 * du * dv + s00 * dv * dv) / determinant
    log_likelihood = -0.5 * squared - math.log(2.0 * math.pi) - 0.5 * math.log(determinant)
    return out_mean, 0.5 * (out_covariance + out_covariance.T), log_likelihood
