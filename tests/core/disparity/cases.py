"""Cameras, Gaussians and plain NumPy oracles that the tests of disparity space share."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.initial import initial_moments
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.motion.base import Motion
from stereophd.core.multi.births.undetected import newborn_prior
from stereophd.core.multi.filter_settings.common import BirthPrior
from tests.scenes import build_camera

LENSES = {
    "none": Lens(),
    "radial": Lens("radial", k1=-0.15),
    "brown_conrady": Lens("brown_conrady", k1=0.11, k2=-0.05, p1=-0.002, p2=0.003, k3=0.01),
    "fisheye": Lens("fisheye", k1=-0.012, k2=0.004, k3=-0.003, k4=0.0004),
}


def make_camera(
    turn: ArrayLike = (0.0, 0.0, 0.0),
    center: ArrayLike = (0.0, 0.0, 0.0),
    lens: Lens | None = None,
    p_detect: float = 0.95,
    focal: tuple[float, float] = (898.9, 880.0),
    sigma: tuple[float, float] = (1.4, 1.2),
    clutter: float = 10.0,
) -> Camera:
    """An 800x600 camera with a pose given by a rotation vector (rad) and a centre."""
    detector = {"noise": sigma, "p_detect": p_detect, "clutter": clutter}
    return build_camera("camera", center, turn, focal=focal, middle=(400.0, 300.0), **detector, lens=lens or Lens())


def make_space(
    camera: Camera, baseline: float = 1.0, rectification: Literal["horizontal", "vertical"] = "horizontal"
) -> DisparitySpace:
    """Disparity space of a camera."""
    return DisparitySpace(camera, baseline, rectification)


def converging(half_distance: float, angle: float, **options: object) -> tuple[DisparitySpace, DisparitySpace]:
    """Spaces of two cameras left and right of the origin, both turned inward by an angle (rad)."""
    left = make_camera((0.0, -angle, 0.0), (-half_distance, 0.0, 0.0), **options)  # type: ignore[arg-type]
    right = make_camera((0.0, angle, 0.0), (half_distance, 0.0, 0.0), **options)  # type: ignore[arg-type]
    return make_space(left), make_space(right)


def random_covariance(rng: np.random.Generator, stds: ArrayLike) -> Array:
    """A covariance with these standard deviations and random correlations."""
    std = np.asarray(stds, dtype=float)
    root = rng.standard_normal((len(std), 2 * len(std)))
    covariance = root @ root.T
    diagonal = np.sqrt(np.diag(covariance))
    return covariance / np.outer(diagonal, diagonal) * np.outer(std, std)


def state_in(space: DisparitySpace, world: ArrayLike) -> Array:
    """State (3,) or (6,) in a disparity space of a state in the world."""
    return space.from_world(np.atleast_2d(np.asarray(world, dtype=float)))[0]


def limit_speed(world: Array, max_speed: float) -> Array:
    """World states (n, 6) with speeds above the limit scaled back to it."""
    speed = np.linalg.norm(world[:, 3:], axis=1)
    slow = np.minimum(1.0, max_speed / np.maximum(speed, 1e-300))
    return np.column_stack([world[:, :3], world[:, 3:] * slow[:, None]])


def sampled_noise(samples: Array, motion: Motion, dt: float) -> Array:
    """Noise (n, 6) of the motion in the world, from rows 6 to 11 of a sample set: velocity first, then position."""
    velocity_first = [3, 4, 5, 0, 1, 2]
    noise = motion.transition(dt).noise[np.ix_(velocity_first, velocity_first)]
    factor = np.zeros((6, 6))
    for axis in range(3):
        block = noise[np.ix_([axis, 3 + axis], [axis, 3 + axis])]
        std = np.sqrt(block[0, 0])
        cross = block[0, 1] / std if std > 0.0 else 0.0
        factor[axis, axis], factor[3 + axis, axis] = std, cross
        factor[3 + axis, 3 + axis] = np.sign(dt) * np.sqrt(max(block[1, 1] - cross**2, 0.0))
    return (factor @ samples[6:12]).T[:, velocity_first]


def oracle_world(
    mean: Array, covariance: Array, samples: Array, home: DisparitySpace, dt: float, motion: Motion
) -> Array:
    """Samples (n, d) of a Gaussian in a disparity space, in the world and moved by dt."""
    size = len(mean)
    states = mean + samples[:size].T @ np.linalg.cholesky(covariance).T
    world = home.to_world(states)
    if size == 3:
        return world
    world = limit_speed(world, motion.speed_limit)
    matrix, _, drift = motion.transition(dt)
    return world @ matrix.T + drift + sampled_noise(samples, motion, dt)


def oracle_trip(
    mean: Array,
    covariance: Array,
    samples: Array,
    home: DisparitySpace,
    destination: DisparitySpace,
    dt: float,
    motion: Motion,
) -> tuple[Array, NDArray[np.bool_]]:
    """Samples (n, d) of a Gaussian in the destination's space, and which of them its camera sees."""
    world = oracle_world(mean, covariance, samples, home, dt, motion)
    return destination.from_world(world), destination.camera.in_view(world[:, :3])


def weighted(points: Array, weights: Array) -> tuple[Array, Array]:
    """Mean and covariance of weighted points (n, d)."""
    total = weights.sum()
    mean = weights @ points / total
    centred = points - mean
    return mean, (centred * weights[:, None]).T @ centred / total


def in_deviations(error: Array, covariance: Array) -> Array:
    """Errors of a mean, or of a covariance, in standard deviations (or products of two)."""
    std = np.sqrt(np.diag(covariance))
    return np.abs(error) / (std if error.ndim == 1 else np.outer(std, std))


def birth_moments(
    event: Event, space: np.ndarray, prior: BirthPrior, size: int, region: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians of the objects that the detections of an event may have given birth to."""
    first = newborn_prior(space, prior, region)
    return initial_moments(event.points, event.covariances, first, size, event.readings(space))
