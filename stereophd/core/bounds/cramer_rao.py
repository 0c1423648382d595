"""Cramer-Rao bounds: how well any unbiased estimator can locate or track an object.

Localisation. With detections z_i ~ N(h_i(x), R_i) the information of a static object is

    J = sum_i G_i^T R_i^-1 G_i,  G_i = d h_i / d x,

here in the coordinates of the world, and in those of a camera's disparity space by J_y = A^T J A with A = dx / dy
(reparametrisation; D. Clark and S. Ivekovic, FUSION 2010, the paper's [8]). A Gaussian prior on disparity adds
1 / sigma_d^2 to J_y; the bound on the covariance is the inverse, and back in the world A J_y^-1 A^T.

Tracking. For x_{k+1} = F x_k + w, w ~ N(0, Q), the posterior information follows the recursion

    J_{k+1} = (Q + F J_k^-1 F^T)^-1 + E[G^T R^-1 G]

(P. Tichavsky, C. Muravchik and A. Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear
filtering", IEEE Trans. Signal Processing 46 (5), 1998), the expectation over trajectories.

Information matrices are (d, d), covariances their inverses; lengths and pixels as everywhere.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.bounds.known_association import AssociatedDetections
from stereophd.core.disparity.events import undistorted_detections
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import projective
from stereophd.core.multi.filter_settings.common import BirthPrior

# An information matrix of worse condition leaves a direction undetermined: the bound is infinite.
WORST_CONDITION = 1e15


def detection_information(camera: Camera, points: Array) -> Array:
    """Information (n, 3, 3) on a position in one detection by a camera, of points (n, 3) in view of it.

    The camera does not move here; for one that moves, pass the camera at its time (`Camera.at`).
    """
    _, jacobian = projective(camera.projection_matrix, points)
    # the detector's noise, stated for the distorted pixel, carried through the lens
    sigma = np.tile(camera.detector.sigma, (len(points), 1))
    _, noise, _ = undistorted_detections(camera, camera.project(points), sigma)
    weighted = np.linalg.solve(noise, jacobian)
    return np.asarray(np.swapaxes(jacobian, 1, 2) @ weighted)


def disparity_jacobian(space: DisparitySpace, point: Array) -> Array:
    """Jacobian (3, 3) of (u, v, d) by the position in the world, at a point (3,) of the world."""
    return np.asarray(projective(space.projective_matrix, point[None])[1][0])


def state_jacobian(space: DisparitySpace, state: Array) -> Array:
    """Jacobian (6, 6) of (u, v, d, du, dv, dd) by (x, y, z, vx, vy, vz), at a world state (6,).

    With y = h / s and the rows P, p of P_d, ``D = dy/dx = (P - y p) / s`` and the velocity is D v, of which the
    derivative by x is ``-(D (p v) + (D v) p) / s``.
    """
    position = disparity_jacobian(space, state[:3])
    divisor = space.projective_matrix[3]
    scale = divisor[:3] @ state[:3] + divisor[3]
    velocity = position @ state[3:]
    jacobian = np.kron(np.eye(2), position)
    jacobian[3:, :3] = -(position * (divisor[:3] @ state[3:]) + np.outer(velocity, divisor[:3])) / scale
    return np.asarray(jacobian)


def prior_information(space: DisparitySpace, point: Array, disparity_std: float) -> Array:
    """Information (3, 3) on a position in the world in a Gaussian prior on its disparity."""
    slope = disparity_jacobian(space, point)[2]
    return np.outer(slope, slope) / disparity_std**2


def localisation_bounds(information: Iterable[Array], prior: Array | None = None) -> Array:
    """Bounds (k, 3, 3) on the covariance of the position after each of several detections.

    The information (3, 3) about the position in each is in the world, or all in one disparity space; `prior` is that
    before the first. Infinite where the position is not determined.
    """
    before = np.zeros((3, 3)) if prior is None else prior
    return inverse_information(np.cumsum([before, *information], axis=0)[1:])


def inverse_information(information: Array) -> Array:
    """Bounds on the covariance: inverses of information matrices (..., d, d), infinite where singular."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    out = np.full(information.shape, np.inf)
    usable = np.asarray((np.isfinite(diagonal) & (diagonal > 0.0)).all(axis=-1))
    scale = np.sqrt(np.where(usable[..., None], diagonal, 1.0))
    scale = scale[..., :, None] * scale[..., None, :]
    scaled = np.where(usable[..., None, None], information, np.eye(information.shape[-1])) / scale
    values = np.linalg.eigvalsh(scaled)
    usable &= values[..., 0] * WORST_CONDITION > values[..., -1]
    covariance = np.linalg.inv(scaled[usable]) / scale[usable]
    out[usable] = (covariance + np.swapaxes(covariance, -1, -2)) / 2.0
    return out


def posterior_bounds(first: Array, transitions: Array, noises: Array, information: Array) -> Array:
    """Posterior bounds on the covariance of a state over time (Tichavsky, Muravchik and Nehorai 1998).

    With the information averaged over all trajectories this is the bound of the cited paper. With the information of
    one trajectory it is the covariance of a Kalman filter linearised at the truth; its mean over trajectories is the
    larger, hence sharper, bound of the two. The reason: far away, the direction of the weakest information turns with
    the bearing, and information averaged over bearings has no such direction.

    `first` (..., d, d) is the information at the first event, its detection included, of several trajectories at once
    with leading axes. `transitions` and `noises` (k, d, d) are F and Q of the steps to the following events (for events
    at one time the identity and 0), `information` (k, ..., d, d) is that of their detections. Returns (k + 1, ..., d,
    d), after each event; infinite while the state is not determined.

    Q may be singular. While the information is singular it has no inverse: F is then applied to the information itself,
    and Q is left out. A bound without process noise is lower, and still a bound.
    """
    current = np.array(first, dtype=float)
    out = [inverse_information(current)]
    for transition, noise, gained in zip(transitions, noises, information, strict=True):
        known = np.isfinite(out[-1]).all(axis=(-2, -1))
        predicted = np.empty_like(current)
        predicted[known] = np.linalg.inv(transition @ out[-1][known] @ transition.T + noise)
        back = np.linalg.inv(transition)
        predicted[~known] = back.T @ current[~known] @ back
        current = (predicted + np.swapaxes(predicted, -1, -2)) / 2.0 + gained
        out.append(inverse_information(current))
    return np.array(out)


def mean_error_norm(covariance: Array) -> float:
    """Mean length of an error e ~ N(0, C), infinite if C (d, d) is; d is at most 3.

    It is the mean length sqrt(8 / pi) of a unit error in three dimensions, times the mean of sqrt(u^T C u) over
    directions u: Carlson's symmetric elliptic integral R_G of the eigenvalues of C, those that are missing zero.
    """
    if not np.isfinite(covariance).all():
        return math.inf
    from scipy.special import elliprg  # costly to import

    values = np.zeros(3)
    values[: len(covariance)] = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    return float(math.sqrt(8.0 / math.pi) * elliprg(*values))


def static_point_information(
    detections: AssociatedDetections, positions: Array, first: Sequence[DisparitySpace | None], prior: BirthPrior
) -> Array:
    """Return the information (n, 3, 3) of points, in 1 / length^2; the inverse bounds the covariance of estimates.

    It is the sum over the detections of a point of H^T R^-1 H, H the derivative of the pixel with respect to the point
    (R. Hartley and A. Zisserman, "Multiple View Geometry in Computer Vision", section 5.2), plus that of the prior of
    its disparity before the camera that saw it first.
    True positions (n, 3) are in the world. `first` has the space of the camera that saw each point first; None of a
    point that no camera saw, whose information is 0.
    """
    information = np.zeros((len(positions), 3, 3))
    slopes = detections.whitening @ projective(detections.projection, positions[detections.row])[1]
    np.add.at(information, detections.row, np.swapaxes(slopes, 1, 2) @ slopes)
    for row, space in enumerate(first):
        if space is not None:
            _, std = prior.disparity_moments(space.packed())
            information[row] += prior_information(space, positions[row], std)
    return information
