"""Distances of the rays of two cameras from each other's epipolar lines, and where they come nearest to each other.

The rays of one object before two cameras meet. With the essential matrix E of the cameras and the rays x_a, x_b at one
time,

    r = x_b^T E x_a / |gradient of the numerator with respect to the four pixels, each in units of its noise|

is the distance from that to first order (P. D. Sampson, 1982; R. Hartley and A. Zisserman, "Multiple View Geometry in
Computer Vision", section 11.4.3), free of scale.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.two_views.track_rays import Rays, ray_poses


def essential_matrices(rotations_a: Array, centers_a: Array, rotations_b: Array, centers_b: Array) -> Array:
    """Essential matrices E (..., 3, 3) of two poses, from rotations (..., 3, 3) and centres (..., 3) in the world.

    x_b^T E x_a = 0 for rays that meet, each in the axes of its camera.
    """
    steps = np.einsum("...ij,...j->...i", rotations_b, centers_a - centers_b)
    return np.asarray(cross_matrices(steps) @ rotations_b @ np.swapaxes(rotations_a, -1, -2))


class SampsonDistances(NamedTuple):
    """Distances of rays of two cameras from each other's epipolar lines, and what they are made of."""

    signed: Array  # (...,)
    factors: Array  # (...,): of the numerators: over the length of their gradient
    # (..., 3): the epipolar lines in the images of both cameras, those of the rays of the other one
    lines_a: Array
    lines_b: Array


def sampson_distances(
    essential: Array, rays_a: Array, rays_b: Array, scales_a: Array | float = 1.0, scales_b: Array | float = 1.0
) -> SampsonDistances:
    """Return the distances of rays (..., n, 3) of two cameras by essential matrices (..., 3, 3).

    `scales_a`, `scales_b` (2,): the noise's worth of a unit of slope, focal length over standard deviation of a pixel;
    with focal lengths alone the distances are in pixels, without them in slopes. NaN where a ray is, and of cameras at
    one place.
    """
    lines_b, lines_a = rays_a @ np.swapaxes(essential, -1, -2), rays_b @ essential
    variance = ((lines_b[..., :2] / scales_b) ** 2).sum(axis=-1) + ((lines_a[..., :2] / scales_a) ** 2).sum(axis=-1)
    # rays that look at each other's camera have no lines
    variance = np.maximum(variance, 1e-300 * (essential**2).sum(axis=(-2, -1))[..., None])
    with np.errstate(invalid="ignore", divide="ignore"):
        factors = np.asarray(1.0 / np.sqrt(variance))
        return SampsonDistances(np.einsum("...i,...i->...", rays_b, lines_b) * factors, factors, lines_a, lines_b)


def ray_distances(cameras: Sequence[Camera], rays: Rays, sigma: Array) -> Array:
    """Signed distances (r,) of rows of rays, in units of the noise `sigma` (r,), px; NaN where they were not seen."""
    focal = np.array([[camera.fx, camera.fy] for camera in cameras])
    if all(camera.pose.is_static for camera in cameras):
        turns, centers = (np.stack([getattr(c.pose, name) for c in cameras]) for name in ("rotation", "center"))
        essential = essential_matrices(turns[:, None], centers[:, None], turns, centers).reshape(-1, 3, 3)
        which = rays.cameras[:, 0] * len(cameras) + rays.cameras[:, 1]
    else:
        turns, centers = ray_poses(cameras, rays)
        essential = essential_matrices(turns[:, 0], centers[:, 0], turns[:, 1], centers[:, 1])
        which = np.arange(len(rays.times))
    out = np.empty(len(rays.times))
    _sampson_rows(essential, which, rays.rays, focal, rays.cameras, sigma, out)
    out[~rays.seen] = np.nan
    return out


@compiled
def _sampson(
    matrix: Array, a: Array, b0: float, b1: float, b2: float, scales_a: Array, scales_b: Array, least: float
) -> float:
    """`sampson_distances` of the ray a (3,) and another one by an essential matrix, of at least this variance."""
    a0, a1, a2 = a[0], a[1], a[2]
    line_b0 = matrix[0, 0] * a0 + matrix[0, 1] * a1 + matrix[0, 2] * a2
    line_b1 = matrix[1, 0] * a0 + matrix[1, 1] * a1 + matrix[1, 2] * a2
    line_b2 = matrix[2, 0] * a0 + matrix[2, 1] * a1 + matrix[2, 2] * a2
    line_a0 = matrix[0, 0] * b0 + matrix[1, 0] * b1 + matrix[2, 0] * b2
    line_a1 = matrix[0, 1] * b0 + matrix[1, 1] * b1 + matrix[2, 1] * b2
    variance = (line_a0 / scales_a[0]) ** 2 + (line_a1 / scales_a[1]) ** 2
    variance += (line_b0 / scales_b[0]) ** 2 + (line_b1 / scales_b[1]) ** 2
    return float((b0 * line_b0 + b1 * line_b1 + b2 * line_b2) / math.sqrt(max(variance, least)))


@compiled
def _sampson_rows(
    essential: Array, which: Integers, rays: Array, focal: Array, cameras: Integers, sigma: Array, out: Array
) -> None:
    """`sampson_distances` of rows (r,), each with one of several essential matrices (e, 3, 3)."""
    for n in range(len(out)):
        a, b, of_a, of_b = rays[n, 0], rays[n, 1], focal[cameras[n, 0]], focal[cameras[n, 1]]
        out[n] = _sampson(essential[which[n]], a, b[0], b[1], b[2], of_a, of_b, 1e-300) / sigma[n]


# Rays are parallel at a sine of their angle below the root of this: their depths are cut off.
LEAST_SQUARED_SINE = 1e-12
# Rays at a smaller angle (sine) meet anywhere: the depth has no sign.
LEAST_SINE = 1e-3


@compiled
def distances_in_front(
    essential: Array, rays_a: Array, rays_b: Array, scales_a: Array, scales_b: Array, turn: Array, between: Array
) -> tuple[Array, Array]:
    """Distances (s, n, k) of rays (n, 3) and (s, n, k, 3), and depths before A of where they come nearest.

    Distances are those of `sampson_distances`, infinite where rays do not meet in front of both cameras. `turn` (3, 3)
    leads from the axes of B to those of A, and `between` (3,) to B, in the axes of A.
    """
    distances, depths = np.empty(rays_b.shape[:3]), np.empty(rays_b.shape[:3])
    least = 1e-300 * (essential**2).sum()
    for s in range(rays_b.shape[0]):
        for n in range(rays_b.shape[1]):
            a = rays_a[n]
            aa = a[0] ** 2 + a[1] ** 2 + a[2] ** 2
            da = a[0] * between[0] + a[1] * between[1] + a[2] * between[2]
            for k in range(rays_b.shape[2]):
                b0, b1, b2 = rays_b[s, n, k, 0], rays_b[s, n, k, 1], rays_b[s, n, k, 2]
                bb, ab, db = b0 * b0 + b1 * b1 + b2 * b2, 0.0, 0.0
                for i in range(3):
                    turned = turn[i, 0] * b0 + turn[i, 1] * b1 + turn[i, 2] * b2
                    ab, db = ab + a[i] * turned, db + between[i] * turned
                determinant = max(aa * bb - ab * ab, LEAST_SQUARED_SINE * aa * bb)
                depths[s, n, k] = (da * bb - db * ab) / determinant
                is_ahead = depths[s, n, k] > 0.0 and da * ab - db * aa > 0.0
                distance = _sampson(essential, a, b0, b1, b2, scales_a, scales_b, least)
                met = (is_ahead or determinant < LEAST_SINE**2 * aa * bb) and math.isfinite(distance)
                distances[s, n, k] = distance if met else math.inf
    return distances, depths


def nearest_depths(rays_a: Array, rays_b: Array, between: Array) -> tuple[Array, Array, Array]:
    """Depths (...,) along both rays where they come nearest to each other, and the sine (...,) of their angle.

    Rays (..., 3) are in the axes of the world, and a depth is in units of their lengths, so that it is the depth before
    the camera where the third component in the camera's axes is 1. `between` (..., 3) is the centre of the second
    camera less that of the first.
    """
    aa, bb, ab, da, db = (
        np.einsum("...i,...i->...", one, other)
        for one, other in (
            (rays_a, rays_a), (rays_b, rays_b), (rays_a, rays_b), (rays_a, between), (rays_b, between),
        )
    )  # fmt: skip
    determinant = np.maximum(aa * bb - ab**2, LEAST_SQUARED_SINE * aa * bb)
    with np.errstate(invalid="ignore"):
        return ((da * bb - db * ab) / determinant, (da * ab - db * aa) / determinant, np.sqrt(determinant / (aa * bb)))
