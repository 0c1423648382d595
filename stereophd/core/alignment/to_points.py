"""Points of known place that are seen in the images: the corners of a court, surveyed marks, the height of a ledge.

A point at q in the frame of the cameras is at s R q + T in the world. Each pixel in which a camera sees it, and each of
its coordinates that is known, is an observation; the points, the similarity and, in a calibration, the values of the
cameras are unknown together.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.alignment.start import turns_between
from stereophd.core.alignment.to_track import MOST_ROTATION, MOST_SCALE
from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import nearest_points
from stereophd.core.metrics.truth.registration import Alignment, Registration, stepped

# Fits with weights by the residuals of the one before, at most, and the squared length of the last step in standard
# deviations.
MOST_STEPS, SETTLED = 30, 1e-6
# Points that two cameras see, and the least width of their scatter across a line, as a part of its length.
LEAST_POINTS, LEAST_WIDTH = 3, 0.02
# A place without a deviation is known to this part of the extent of all.
EXACT = 1e-4
# Where the weight of a pixel is a half: medians of all distances, and standard deviations at least.
REACH, LEAST_REACH = 2.0, 3.0
# The largest part of their extent by which points may miss their places: a name that was mistaken, or another unit.
MOST_MISSED = 0.2

Build = Callable[[Array], Sequence[Camera]]


@dataclass(frozen=True)
class ControlPoints:
    """Pixels of points whose places in the world are known, all or some of their coordinates."""

    camera: Integers  # (n,): Number of the camera of each pixel
    pixels: Array  # (n, 2): Distorted
    sigma_px: Array  # (n,): Standard deviation along u and v
    point: Integers  # (n,): Number of the point, 0 to p - 1
    places: Array  # (p, 3): In the world, length; NaN where a coordinate is not known
    std: Array  # (p,): Standard deviation along each axis, length; NaN where it is not stated
    names: tuple[str, ...]  # Of the points
    length_unit: str | None

    @property
    def is_complete(self) -> Booleans:
        """Whether all three coordinates of a point are known, (p,)."""
        return np.asarray(np.isfinite(self.places).all(axis=1), dtype=np.bool_)

    @property
    def extent(self) -> float:
        """Root mean square distance of the complete points from their middle, length."""
        return float(np.sqrt(self.places[self.is_complete].var(axis=0).sum()))

    @property
    def precisions(self) -> Array:
        """Precisions (p, 3) of the coordinates, 0 of those that are not known."""
        std = np.where(np.isnan(self.std), EXACT * self.extent, self.std)
        return np.asarray(np.isfinite(self.places) / std[:, None] ** 2)


def align_to_points(cameras: Sequence[Camera], points: ControlPoints, any_scale: bool) -> Alignment:
    """Align cameras that stand still with points of known place.

    Raises ValueError, which names what is missing, where the points do not determine the similarity.
    """
    return adjust_to_points(points, lambda _: cameras, np.zeros(0), np.zeros(0), np.zeros((0, 0)), any_scale)[1]


def adjust_to_points(
    points: ControlPoints, build: Build, values: Array, means: Array, precision: Array, any_scale: bool
) -> tuple[Array, Alignment, Array]:
    """Adjust values (m,), known beforehand by means and a precision (m, m), and the similarity to points.

    Returns the values, the alignment, and the covariance (m + 9, m + 9) of both. The covariances are enlarged where the
    points fit worse than their deviations say.
    """
    from scipy.optimize import least_squares  # costly to import

    places = _triangulated(build(values), points)
    found = _similarity(places, points, any_scale)
    # what one camera alone sees begins at its place
    lost = np.isnan(places).any(axis=1)
    back = (np.where(np.isnan(points.places), 0.0, points.places) - found.translation) @ found.rotation / found.scale
    places[lost & points.is_complete] = back[lost & points.is_complete]
    used: Booleans = np.asarray(np.isfinite(places).all(axis=1), dtype=np.bool_)
    known = np.isfinite(points.places) & used[:, None]
    size, count, root = len(values), int(used.sum()), np.linalg.cholesky(precision).T
    free = size + 6 + any_scale
    # a residual depends on the values, the similarity, and its own point
    owner = np.concatenate([np.repeat(points.point, 2), np.nonzero(known)[0], np.full(size, -1)])
    pattern = np.hstack([np.ones((len(owner), free)), owner[:, None] == np.repeat(np.flatnonzero(used), 3)])

    def moved(unknowns: Array) -> tuple[Array, Registration, Array]:
        step, at = np.zeros(9), places.copy()
        step[: free - size], at[used] = unknowns[size:free], unknowns[free:].reshape(-1, 3)
        return unknowns[:size], stepped(found, step, center, count), at

    def residuals(unknowns: Array, deviations: Array) -> Array:
        now, world, at = moved(unknowns)
        errors = (points.pixels - _projected(build(now), points, at)) / deviations[:, None]
        missed = ((points.places - world.positions(at)) * np.sqrt(points.precisions))[known]
        return np.concatenate([np.nan_to_num(errors).ravel(), missed, root @ (now - means)])

    for _ in range(MOST_STEPS):
        center = found.positions(places[used]).mean(axis=0)
        start = np.concatenate([values, np.zeros(free - size), places[used].ravel()])
        distances = np.linalg.norm(residuals(start, points.sigma_px)[: points.pixels.size].reshape(-1, 2), axis=1)
        # Cauchy weights: a pixel that was given another point's name counts little
        reach = max(REACH * float(np.median(distances)), LEAST_REACH)
        deviations = points.sigma_px * np.sqrt(1.0 + (distances / reach) ** 2)
        fit = least_squares(residuals, start, x_scale="jac", jac_sparsity=pattern, args=(deviations,))
        values, found, places = moved(fit.x)
        if ((fit.jac @ (fit.x - start)) ** 2).sum() < SETTLED:
            break
    beyond = 2 * int(used[points.point].sum()) + int(known.sum()) - 3 * count - 6 - any_scale
    worse = max(2.0 * fit.cost / beyond, 1.0) if beyond > 0 else 1.0
    covariance = np.zeros((size + 9, size + 9))
    covariance[:free, :free] = worse * np.linalg.inv((fit.jac.T @ fit.jac).toarray())[:free, :free]
    missed = np.linalg.norm(found.positions(_triangulated(build(values), points)) - points.places, axis=1)
    alignment = Alignment(found, center, covariance[size:, size:], distances=missed[np.isfinite(missed)])
    _refuse_unlike(alignment, points.extent)
    return values, alignment, covariance


def reprojection_errors(points: ControlPoints, cameras: Sequence[Camera]) -> Array:
    """Distances (n,), px, of pixels from where cameras in the world see the known places; NaN of incomplete ones."""
    return np.asarray(np.linalg.norm(points.pixels - _projected(cameras, points, points.places), axis=1))


def _projected(cameras: Sequence[Camera], points: ControlPoints, places: Array) -> Array:
    pixels = np.full((len(points.camera), 2), np.nan)
    for number, camera in enumerate(cameras):
        rows = points.camera == number
        pixels[rows] = camera.project(places[points.point[rows]])
    return pixels


def _triangulated(cameras: Sequence[Camera], points: ControlPoints) -> Array:
    """Points (p, 3) nearest to their rays; NaN where fewer than two cameras see one."""
    rays, centers = np.empty((len(points.camera), 3)), np.empty((len(points.camera), 3))
    for number, camera in enumerate(cameras):
        rows = points.camera == number
        rays[rows], centers[rows] = camera.rays(points.pixels[rows]) @ camera.pose.rotation, camera.pose.center
    return nearest_points(rays, centers, points.point, len(points.places))


def _similarity(places: Array, points: ControlPoints, any_scale: bool) -> Registration:
    """Return the similarity from triangulated points to their places."""
    both = points.is_complete & np.isfinite(places).all(axis=1)
    if both.sum() < LEAST_POINTS:
        raise ValueError(
            f"expected {LEAST_POINTS} or more points of known x, y and z that two cameras see, found {both.sum()}"
        )
    a, b = (positions[both] - positions[both].mean(axis=0) for positions in (places, points.places))
    widths = np.linalg.svd(b, compute_uv=False)
    if widths[1] < LEAST_WIDTH * widths[0]:
        raise ValueError("the points are on one straight line, which leaves the rotation about it open")
    left, right, agreement = turns_between((b.T @ a)[None])
    rotation = left[0] @ right[0]
    scale = float(agreement[0] / (a**2).sum()) if any_scale else 1.0
    translation = points.places[both].mean(axis=0) - scale * rotation @ places[both].mean(axis=0)
    return Registration(rotation, translation, scale, 0.0, 0.0, 1.0, int(both.sum()))


def _refuse_unlike(found: Alignment, extent: float) -> None:
    """Raise ValueError where points and places differ in shape, or leave the similarity open."""
    missed = float(np.median(found.distances)) if len(found.distances) else 0.0
    if missed > MOST_MISSED * extent:
        raise ValueError(
            f"the points have another shape than their places: they miss them by {missed:.3g} (median), and their "
            f"places are {extent:.3g} apart; are names, columns and units right?"
        )
    rotation = float(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3]).max()))
    if rotation > MOST_ROTATION or found.std[6] > MOST_SCALE:
        raise ValueError(
            f"the points leave the rotation ({np.rad2deg(rotation):.1f} degrees) or the scale "
            f"({100.0 * found.std[6]:.1f} %) open: add points that are further apart, and seen by more cameras"
        )
