"""First-order pieces that the Kalman filters outside disparity space are made of.

Cameras are packed (`stereophd.core.geometry.layout`), pixels undistorted.
"""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.prior import InitialPrior
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.geometry.projection import pinhole


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


def inverse_depth_prior(prior: InitialPrior, space: Array) -> tuple[float, float]:
    """Mean and standard deviation of the inverse depth: rho = d / (f b)."""
    mean, std = prior.disparity_moments(space)
    return mean / disparity_scale(space), std / disparity_scale(space)


def velocity_covariance(prior: InitialPrior, space: Array, pixel: Array, rho: float) -> Array:
    """Prior covariance (3, 3) of the velocity in the world, about 0, of an object of known inverse depth."""
    if prior.disparity_velocity_std_px_s is None:
        return prior.velocity_spread**2 * np.eye(3)
    # v = (r' - r rho' / rho) / rho in the camera's axes, with r' = (du / fx, dv / fy, 0), rho' = dd / (f b)
    per_pixel = np.diag([1.0 / space[FX], 1.0 / space[FY], 0.0]) / rho
    per_pixel[:, 2] = -ray(space, pixel) / (disparity_scale(space) * rho**2)
    jacobian = rotation(space).T @ per_pixel
    return np.asarray(jacobian @ np.diag(np.square(prior.disparity_velocity_std_px_s)) @ jacobian.T)
