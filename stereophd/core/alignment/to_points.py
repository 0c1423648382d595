"""Points of known place that are seen in the images: the corners of a court, surveyed marks, the height of a ledge.

A point at q in the frame of the cameras is at s R q + T in the world. Each pixel in which a camera sees it, and each of
its coordinates that is known, is an observation; the points, the similarity and, in a calibration, the values of the
cameras are unknown together. The points meet no trajectory and no clock, so that they are eliminated one by one, and
least squares over the rest is small.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stereophd.core.alignment.start import turns_between
from stereophd.core.alignment.to_track import MOST_ROTATION, MOST_SCALE
from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.projection import nearest_points
from stereophd.core.metrics.truth.registration import Alignment, Registration, derivatives, stepped

# Steps at most, the squared length of the last one in standard deviations, and the step of a numerical derivative in
# parts of a standard deviation of a value, or of the distance of a point.
MOST_STEPS, SETTLED, SMALL = 30, 1e-6, 1e-5
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
    size = len(values)
    places = _triangulated(build(values), points)
    found = _similarity(places, points, any_scale)
    # what one camera alone sees begins at its place
    lost = np.isnan(places).any(axis=1)
    back = (np.where(np.isnan(points.places), 0.0, points.places) - found.translation) @ found.rotation / found.scale
    places[lost & points.is_complete] = back[lost & points.is_complete]
    used: Booleans = np.asarray(np.isfinite(places).all(axis=1), dtype=np.bool_)
    free = np.arange(size + 6 + any_scale)
    for _ in range(MOST_STEPS):
        center = found.positions(places[used]).mean(axis=0)
        matrix, vector, eliminated, cost = _normal_equations(points, build, values, precision, found, center, places)
        matrix[:size, :size] += precision
        vector[:size] -= precision @ (values - means)
        step = np.zeros(size + 7)
        step[free] = np.linalg.solve(matrix[np.ix_(free, free)], vector[free])
        values = values + step[:size]
        found = stepped(found, np.append(step[size:], [0.0, 0.0]), center, int(used.sum()))
        places = places + eliminated[:, :, -1] - eliminated[:, :, :-1] @ step
        if step[free] @ matrix[np.ix_(free, free)] @ step[free] < SETTLED:
            break
    coordinates = int(np.isfinite(points.places[used]).sum())
    beyond = 2 * int(used[points.point].sum()) + coordinates - 3 * int(used.sum()) - 6 - any_scale
    cost += float((values - means) @ precision @ (values - means))
    worse = max(cost / beyond, 1.0) if beyond > 0 else 1.0
    covariance = np.zeros((size + 9, size + 9))
    covariance[np.ix_(free, free)] = worse * np.linalg.inv(matrix[np.ix_(free, free)])
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


def _normal_equations(
    points: ControlPoints, build: Build, values: Array, precision: Array, found: Registration, center: Array,
    places: Array,
) -> tuple[Array, Array, Array, float]:  # fmt: skip
    """Normal equations (m + 7) of values and similarity, the points eliminated (p, 3, m + 8), and the cost."""
    size, cameras = len(values), build(values)
    projected = _projected(cameras, points, places)
    seen: Booleans = np.asarray(np.isfinite(projected).all(axis=1), dtype=np.bool_)
    errors = np.where(seen[:, None], points.pixels - projected, 0.0) / points.sigma_px[:, None]
    distances = np.linalg.norm(errors, axis=1)
    # Cauchy weights: a pixel that was given another point's name counts little
    deviations = points.sigma_px * np.sqrt(
        1.0 + (distances / max(REACH * float(np.median(distances)), LEAST_REACH)) ** 2
    )
    errors *= (points.sigma_px / deviations)[:, None]
    far = SMALL * np.abs(places - np.mean([camera.pose.center for camera in cameras], axis=0)).max(axis=1)

    def slope(pixels: Array, step: Array | float) -> Array:
        change = (pixels - projected) / np.broadcast_to(step, len(projected))[:, None] / deviations[:, None]
        return np.where(seen[:, None], change, 0.0)

    by_place = np.stack(
        [slope(_projected(cameras, points, places + far[:, None] * axis), far[points.point]) for axis in np.eye(3)], 2
    )
    by_value = np.zeros((len(errors), 2, size + 7))
    steps = SMALL / np.sqrt(np.diag(precision))
    for column, step in enumerate(steps):
        moved = values + step * (np.arange(size) == column)
        by_value[:, :, column] = slope(_projected(build(moved), points, places), step)
    # the known coordinates of each point: their residuals, and what moves them
    moved_places = found.positions(places)
    weights = np.where(np.isfinite(places), points.precisions, 0.0)
    missed = np.where(weights > 0.0, points.places - moved_places, 0.0)
    turned = found.scale * found.rotation
    by_world = np.zeros((len(places), 3, size + 7))
    by_world[:, :, size:] = np.nan_to_num(derivatives(moved_places - center, missed, 0.0 * missed[:, 0]))[:, :, :7]
    weighted = weights[:, :, None] * by_world
    square, mixed, right = turned.T @ (weights[:, :, None] * turned), turned.T @ weighted, (weights * missed) @ turned
    np.add.at(square, points.point, np.swapaxes(by_place, 1, 2) @ by_place)
    np.add.at(mixed, points.point, np.swapaxes(by_place, 1, 2) @ by_value)
    np.add.at(right, points.point, np.einsum("nij,ni->nj", by_place, errors))
    # a point that nothing holds stays where it is
    square[np.isnan(places).any(axis=1)] = np.eye(3)
    eliminated = np.linalg.solve(square, np.concatenate([mixed, right[:, :, None]], axis=2))
    matrix = np.einsum("nij,nik->jk", by_value, by_value) + np.einsum("pij,pik->jk", weighted, by_world)
    vector = np.einsum("nij,ni->j", by_value, errors) + np.einsum("pij,pi->j", weighted, missed)
    matrix -= np.einsum("pij,pik->jk", mixed, eliminated[:, :, :-1])
    vector -= np.einsum("pij,pi->j", mixed, eliminated[:, :, -1])
    return matrix, vector, eliminated, float((errors**2).sum() + (weights * missed**2).sum())


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
