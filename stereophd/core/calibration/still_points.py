"""Still objects: one-camera tracks that are one measurement each, and relative poses from minimal sets of them.

What stands still before a camera that stands still is seen at one pixel, however many frames there are: its track is
one measurement of one ray. Two cameras share five unknowns that rays can show (rotation and direction), so five pairs
of points determine them (D. Nister, "An efficient solution to the five-point relative pose problem", IEEE PAMI 26 (6),
2004). Which point of one camera is which of the other is not known, but the prior narrows it down: a hypothesis is a
draw of the cameras and of the depths of five points of the first; each is matched to the point of the second that lies
nearest to where it would be seen; Gauss-Newton steps with the prior move the cameras to where the five pairs meet; and
all points judge the result (M. A. Fischler and R. C. Bolles, "Random sample consensus", 1981).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereophd.core.calibration.parameters import ParameterSet, taken
from stereophd.core.calibration.recording import Scans
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.rotations import rotations

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# A track is still if it scatters by no more than this many times the noise of its detections.
STILL_SCATTER = 1.5
# Errors of lenses do not average out: more detections than this make a mean no better.
EFFECTIVE_DETECTIONS = 4
# Points of a minimal set, hypotheses of a camera, and how many of them are kept.
MINIMAL, HYPOTHESES, KEPT = 5, 20000, 8
# Noise of a point that the search supposes at least, px: a finer one would end it before it comes near.
LEAST_SIGMA_PX = 0.5
# Gauss-Newton steps, and step of the numerical derivative in prior standard deviations.
STEPS, DERIVATIVE_STEP = 4, 1e-4
# Squared residual of a fitted set, and squared distance from the prior, beyond which a hypothesis is given up.
MOST_RESIDUAL, MOST_OFFSET = 20.0, 25.0
# A point counts for a hypothesis within this many standard deviations of an epipolar line.
REACH = 3.0
# Hypotheses that all points improve, and the tolerances at which they do, in standard deviations.
IMPROVED, TOLERANCES = 400, (30.0, 30.0, 20.0, 15.0, 10.0, 7.0, 5.0, 3.5, 2.5, 2.5)
# Spread of the draws about the best ones, in prior standard deviations, round by round: a search that narrows.
SPREADS = (0.5, 0.3, 0.2, 0.1)
# Hypotheses that are scored at once: bounds the memory to tens of megabytes.
BATCH = 500


@dataclass(frozen=True)
class StillTracks:
    """One-camera tracks as means.

    Attributes
    ----------
    cameras : array (k,) of int
    points : array (k, 2)
        Mean undistorted pixel.
    sigma : array (k,)
        Standard deviation of it, px.
    still : array (k,) of bool
        Whether the track scatters no more than its noise.
    """

    cameras: Integers
    points: Array
    sigma: Array
    still: NDArray[np.bool_]

    @property
    def mostly(self) -> bool:
        """Whether most tracks are still, and there are enough of them for a minimal set."""
        return bool(self.still.mean() > 0.5) if len(self.still) > MINIMAL else False


def still_tracks(scans: Scans, tracks: Sequence[tuple[int, Integers]]) -> StillTracks:
    """Return the means of one-camera tracks: (camera, detections of the recording) of each."""
    count = len(tracks)
    points, sigma, still = np.zeros((count, 2)), np.ones(count), np.zeros(count, dtype=bool)
    for j, (_, detections) in enumerate(tracks):
        rows = scans.places(detections)
        noise = 1.0 / np.sqrt(scans.precisions[rows, 0, 0].mean())
        points[j] = scans.points[rows].mean(axis=0)
        still[j] = bool(np.sqrt(scans.points[rows].var(axis=0).mean()) <= STILL_SCATTER * noise)
        sigma[j] = noise / np.sqrt(min(len(rows), EFFECTIVE_DETECTIONS))
    return StillTracks(np.array([camera for camera, _ in tracks], dtype=np.int64), points, sigma, still)


def minimal_set_draws(
    parameters: ParameterSet,
    found: StillTracks,
    reference: int,
    inverse_depth: tuple[float, float],
    rng: np.random.Generator,
) -> Array:
    """Draw cameras under which still points meet: values (k, m), best first; none where points are too few.

    Parameters
    ----------
    parameters : ParameterSet
        Unknown poses of cameras that stand still; other values stay at the prior mean.
    found : StillTracks
    reference : int
        The camera with which each other one is paired.
    inverse_depth : (float, float)
        Prior mean and standard deviation of the inverse depth before the reference camera, 1 / length.
    rng : Generator
    """
    draws = np.tile(parameters.prior_mean, (KEPT, 1))
    changed = False
    for other, camera in enumerate(parameters.cameras):
        columns = parameters.index(camera.name, ("rotation_x", "rotation_y", "rotation_z"))
        places = parameters.index(camera.name, ("center_x", "center_y", "center_z"))
        used = np.concatenate([columns, places])
        here = [np.flatnonzero(found.still & (found.cameras == c)) for c in (reference, other)]
        if other == reference or not (used >= 0).any() or min(map(len, here)) < MINIMAL:
            continue
        pair = _Pair.of(parameters, found, reference, other, here, used, inverse_depth)
        values = pair.best(rng)
        known = used >= 0
        draws[: len(values), used[known]] = values[:, known]
        changed = changed or len(values) > 0
    return draws if changed else draws[:0]


@dataclass(frozen=True)
class _Pair:
    """Points of the reference camera and of another, whose pose (rotation vector, then centre) is unknown."""

    reference: Camera
    other: Camera
    first: Array
    second: Array
    sigma: float
    mean: Array
    std: Array
    inverse_depth: tuple[float, float]

    @staticmethod
    def of(
        parameters: ParameterSet,
        found: StillTracks,
        reference: int,
        other: int,
        here: list[Integers],
        used: Integers,
        inverse_depth: tuple[float, float],
    ) -> _Pair:
        cameras = parameters.cameras[reference], parameters.cameras[other]
        rays = [
            np.column_stack([(found.points[rows] - [c.cx, c.cy]) / [c.fx, c.fy], np.ones(len(rows))])
            for rows, c in zip(here, cameras, strict=True)
        ]
        sigma = max(float(np.median(found.sigma[np.concatenate(here)])), LEAST_SIGMA_PX)
        mean, std = taken(parameters.prior_mean, used), taken(parameters.prior_std, used)
        return _Pair(*cameras, rays[0], rays[1], sigma, mean, std, inverse_depth)

    def best(self, rng: np.random.Generator) -> Array:
        """Values (k, 6) of the hypotheses that most points agree with."""
        values = self.mean + self.std * rng.standard_normal((HYPOTHESES, 6))
        a, b = self._sets(values, rng)
        for _ in range(STEPS):
            values = self._step(values, a, b)
        residual = (self._distances(values, a, b) ** 2).sum(axis=1)
        fitted = self._ranked(values[(residual < MOST_RESIDUAL) & (self._offset(values) < MOST_OFFSET)], IMPROVED)
        # few sets are right under a wide prior: draws that no set moved are improved beside them
        plain = self.mean + self.std * rng.standard_normal((IMPROVED, 6))
        values = np.concatenate([fitted, plain])
        values = self._ranked(self._improved(values), KEPT)
        for spread in SPREADS:
            moved = np.repeat(values, IMPROVED // len(values), axis=0)
            moved = moved + spread * self.std * rng.standard_normal(moved.shape)
            values = self._ranked(np.concatenate([values, self._improved(moved)]), KEPT)
        return values

    def _ranked(self, values: Array, most: int) -> Array:
        """Return the best of hypotheses, at most so many, by their gain less their distance from the prior."""
        scores = [self._gain(values[i : i + BATCH]) for i in range(0, len(values), BATCH)]
        score = np.concatenate([np.empty(0), *scores]) - self._offset(values)
        order = np.argsort(-score, kind="stable")
        # the same cameras are found again and again: one of each kind, by their score
        _, first = np.unique(np.round(score[order], 1), return_index=True)
        return np.asarray(values[order[np.sort(first)][:most]])

    def _sets(self, values: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Rays (h, 5, 3) of minimal sets: points of the first camera, and the nearest of the second to each."""
        count = len(values)
        chosen = rng.random((count, len(self.first))).argsort(axis=1)[:, :MINIMAL]
        mean, std = self.inverse_depth
        inverse = np.abs(mean + std * rng.standard_normal((count, MINIMAL)))
        a = self.first[chosen]
        turn, center = self._pose(values)
        # the point times its inverse depth, in the axes of the other camera
        world = a @ self.reference.pose.rotation
        seen = world + inverse[:, :, None] * (self.reference.pose.center - center)[:, None, :]
        seen = np.einsum("hij,hnj->hni", turn, seen)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = seen[:, :, :2] / seen[:, :, 2:]
        apart = ((pixels[:, :, None, :] - self.second[None, None, :, :2]) ** 2).sum(axis=3)
        nearest = np.where(np.isfinite(apart), apart, np.inf).argmin(axis=2)
        return a, self.second[nearest]

    def _pose(self, values: Array) -> tuple[Array, Array]:
        """Rotations (h, 3, 3) and centres (h, 3) of the other camera."""
        return rotations(values[:, :3]) @ self.other.pose.rotation, self.other.pose.center + values[:, 3:]

    def _offset(self, values: Array) -> Array:
        """Squared distance (h,) from the prior, in standard deviations."""
        known = self.std > 0.0
        return np.asarray((((values - self.mean)[:, known] / self.std[known]) ** 2).sum(axis=1))

    def _essential(self, values: Array) -> Array:
        turn, center = self._pose(values)
        along = np.einsum("hij,hj->hi", turn, self.reference.pose.center - center)
        x, y, z = along.T
        zero = np.zeros(len(values))
        cross = np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], 1)
        return np.asarray(cross @ turn @ self.reference.pose.rotation.T)

    def _distances(self, values: Array, a: Array, b: Array) -> Array:
        """Epipolar distances (h, n) of pairs of rays (h, n, 3), in standard deviations (P. D. Sampson, 1982)."""
        essential = self._essential(values)
        line_b, line_a = a @ np.swapaxes(essential, 1, 2), b @ essential
        return self._sampson((b * line_b).sum(axis=2), line_a, line_b)

    def _sampson(self, product: Array, line_a: Array, line_b: Array) -> Array:
        slope_b = (line_b[..., 0] / self.other.fx) ** 2 + (line_b[..., 1] / self.other.fy) ** 2
        slope_a = (line_a[..., 0] / self.reference.fx) ** 2 + (line_a[..., 1] / self.reference.fy) ** 2
        return np.asarray(product / (self.sigma * np.sqrt(np.maximum(slope_a + slope_b, 1e-300))))

    def _step(self, values: Array, a: Array, b: Array, tolerance: float = np.inf) -> Array:
        """One Gauss-Newton step of every hypothesis, with the prior; Cauchy weights at a finite tolerance."""
        distances = self._distances(values, a, b)
        weights = 1.0 / (1.0 + (distances / tolerance) ** 2)
        scale = tolerance if np.isfinite(tolerance) else 1.0
        jacobian = np.zeros((*distances.shape, 6))
        for k in np.flatnonzero(self.std > 0.0).tolist():
            moved = values.copy()
            moved[:, k] += DERIVATIVE_STEP * self.std[k]
            jacobian[:, :, k] = (self._distances(moved, a, b) - distances) / (DERIVATIVE_STEP * scale)
        std = np.where(self.std > 0.0, self.std, 1.0)
        weighted = weights[:, :, None] * jacobian
        matrix = np.swapaxes(weighted, 1, 2) @ jacobian + np.eye(6)
        gradient = np.einsum("hnk,hn->hk", weighted, distances / scale) + (values - self.mean) / std
        step = np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0]
        return np.asarray(values - self.std * step)

    def _squared(self, values: Array, tolerance: float) -> Array:
        """Squared distances (h, n, m) of all pairs of points: epipolar in tolerances, and of the depth in the prior's.

        Infinite where the rays meet behind the reference camera.
        """
        turn, center = self._pose(values)
        along = np.einsum("hij,hj->hi", turn, self.reference.pose.center - center)
        through = np.einsum("hij,nj->hni", turn @ self.reference.pose.rotation.T, self.first)
        essential = self._essential(values)
        line_b = np.einsum("hij,nj->hni", essential, self.first)
        line_a = np.einsum("hij,mi->hmj", essential, self.second)
        product = np.einsum("hni,mi->hnm", line_b, self.second)
        squared = (self._sampson(product, line_a[:, None], line_b[:, :, None]) / tolerance) ** 2
        # inverse depth before the reference camera: the pixel of through + inverse * along nearest to the point
        up: Array = np.zeros(squared.shape)
        down: Array = np.full(squared.shape, 1e-300)
        for axis, focal in ((0, self.other.fx), (1, self.other.fy)):
            slope = along[:, axis, None] - along[:, 2, None] * self.second[:, axis]
            offset = through[:, :, None, axis] - through[:, :, None, 2] * self.second[:, axis]
            up -= focal**2 * slope[:, None] * offset
            down += (focal * slope[:, None]) ** 2
        inverse = up / down
        squared += ((inverse - self.inverse_depth[0]) / self.inverse_depth[1]) ** 2
        squared[inverse <= 0.0] = np.inf
        return squared

    def _gain(self, values: Array) -> Array:
        """How many points of one camera meet one of the other at a plausible depth, and how well: (h,)."""
        squared = self._squared(values, 1.0)
        gains = [np.maximum(REACH**2 - squared.min(axis=axis), 0.0).sum(axis=1) for axis in (1, 2)]
        return np.asarray(np.minimum(*gains))

    def _improved(self, values: Array) -> Array:
        """Match all points anew under each hypothesis (h, 6), and move it to where they meet, tolerances falling."""
        for tolerance in TOLERANCES:
            nearest = self._squared(values, tolerance).argmin(axis=2)
            a = np.broadcast_to(self.first, (len(values), *self.first.shape))
            values = self._step(values, a, self.second[nearest], tolerance)
        return values
