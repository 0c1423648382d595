"""How the volume of the trajectories, half of log det A, changes with values and points, detection by detection.

With the covariance S of the point of a detection, of weight w, precision P and derivative J by the point, a change of
A by any of its unknowns changes the volume by w tr(S J^T P dJ). The second derivatives of the pixel by a value that
this needs are differences of first ones, along the two rows of K = w P J S: dJ by a value is the change by the point of
the derivative by the value. A later time of a detection also moves the weights of its knots, from those of the position
to those of the velocity. The covariances are those parts of the inverse of A that lie within its band (K. Takahashi,
J. Fagan and M.-S. Chin, "Formation of a sparse bus impedance matrix", 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation, Seen
from stereophd.core.numerics.compilation.compiled import compiled

# Step of the differences, in pixels: to one side, so that they are wrong by this part of the focal length.
STEP_PX = 1e-4
# Stands for a norm of 0, of what is not seen; its inverse squared is a number.
LEAST_NORM = 1e-150


@compiled
def inverse_in_band(factor: Array, inverse: Array) -> None:
    """Fill in the inverse (b, n) of a matrix within its band, from its Cholesky factor (b, n), both lower banded."""
    width, size = factor.shape
    for j in range(size - 1, -1, -1):
        last = min(j + width, size)
        for i in range(last - 1, j - 1, -1):
            total = 1.0 / factor[0, j] if i == j else 0.0
            for k in range(j + 1, last):
                total -= factor[k - j, j] * inverse[abs(k - i), min(k, i)]
            inverse[i - j, j] = total / factor[0, j]


@compiled
def summed_covariances(inverse: Array, knots: Integers, weights: Array, out: Array) -> None:
    """Add up the covariances of a knot and the next one, position and velocity each, with weights (n, 4, 4)."""
    size = inverse.shape[1]
    for n in range(knots.shape[0]):
        start = 6 * knots[n]
        for b in range(4):
            for c in range(4):
                weight = weights[n, b, c]
                if weight == 0.0:
                    continue
                for i in range(3):
                    for j in range(3):
                        row, column = start + 3 * b + i, start + 3 * c + j
                        if row < size and column < size:
                            out[n, i, j] += weight * inverse[abs(row - column), min(row, column)]


@compiled
def _of_points(
    inverse: Array, knots: Integers, weights: Array, rates: Array, by_point: Array, weighted: Array, bends: Array,
    rows: Array, of_points: Array, by_time: Array,
) -> None:  # fmt: skip
    """Fill in `rows`, `by_point` and `by_time` of `VolumeSlopes`, from w P J (n, 2, 3) and what detections see.

    Positions and velocities have weights and rates (n, 4); of the point and its later place S and S' are covariances.
    """
    size, spread, later = inverse.shape[1], np.empty((3, 3)), np.empty((3, 3))
    for n in range(knots.shape[0]):
        start = 6 * knots[n]
        spread[:], later[:] = 0.0, 0.0
        for b in range(4):
            for c in range(b + 1):
                row, column = start + 3 * b, start + 3 * c
                if row >= size or (weights[n, b] == 0.0 and weights[n, c] == 0.0):
                    continue
                for i in range(3):
                    for j in range(3):
                        covariance = inverse[abs(row + i - column - j), min(row + i, column + j)]
                        spread[i, j] += weights[n, b] * weights[n, c] * covariance
                        later[i, j] += weights[n, b] * rates[n, c] * covariance
                        if c < b:
                            spread[j, i] += weights[n, b] * weights[n, c] * covariance
                            later[j, i] += weights[n, c] * rates[n, b] * covariance
        for r in range(2):
            for a in range(3):
                rows[n, r, a] = 0.0
                for i in range(3):
                    rows[n, r, a] += weighted[n, r, i] * spread[i, a]
                    by_time[n] += by_point[n, r, i] * weighted[n, r, a] * later[i, a]
            for a in range(3):
                for i in range(3):
                    of_points[n, a] += bends[n, r, a, i] * rows[n, r, i]


@dataclass(frozen=True)
class VolumeSlopes:
    """Derivatives of half of log det A at some values, its parts summing up to the whole."""

    values: Array
    seen: Seen  # What is seen of the detections, with second derivatives
    rows: Array  # (n, 2, 3): by the derivatives of the pixels of each detection by its point
    by_point: Array  # (n, 3): by the point of each detection
    by_time: Array  # (n,): by its time, through the weights of its knots
    by_noise: Array  # (l, 6): of each link, by the unknowns of the noise of the motion

    @staticmethod
    def of(linearisation: Linearisation, values: Array, noise: Array, factor: Array, seen: Seen) -> VolumeSlopes:
        """Return the derivatives at values (m,); `factor` (12, 6 k) is that of A, lower banded."""
        inverse = np.zeros_like(factor)
        inverse_in_band(factor, inverse)
        path, rates, sights = seen.placement.path, seen.placement.rates, seen.placement.sights
        seen = seen._replace(bends=sights.bends(seen.points, seen.visible))
        by_point, count = np.where(seen.visible[:, None, None], seen.by_point, 0.0), len(seen.world)
        rows, of_points, by_time = np.empty((count, 2, 3)), np.zeros((count, 3)), np.zeros(count)
        weighted = linearisation.precisions @ by_point
        _of_points(
            inverse, path.knot, path.weights, rates.weights, by_point, weighted, seen.bends, rows, of_points, by_time
        )
        links = linearisation.motion.links
        covariances = np.zeros((len(links.knot), 3, 3))
        summed_covariances(inverse, links.knot, links.precisions, covariances)
        by_noise = linearisation.noise_at(values, noise).by_unknowns(covariances)
        return VolumeSlopes(values, seen, rows, of_points, by_time, by_noise)

    def by_value(self, linearisation: Linearisation, more: Array | float = 0.0, later: Array | float = 0.0) -> Array:
        """Return derivatives (n, q) by the values of the camera of each detection.

        `more` (n, 2, 3) and `later` (n,) add to those by the derivatives of the pixels and by the times.
        """
        before = self.seen
        if not before.by_value.shape[2]:  # all values are held
            return np.zeros((len(before.world), 0))
        rows, out = self.rows + more, (self.by_time + later)[:, None] * linearisation.time_slopes
        steps = STEP_PX / np.maximum(np.linalg.norm(before.by_point, axis=(1, 2)), LEAST_NORM)
        for r in (0, 1):
            size = np.linalg.norm(rows[:, r], axis=1)
            moved = rows[:, r] * (steps / np.maximum(size, LEAST_NORM))[:, None]
            after = linearisation.seen(before.placement, self.values, before.world + moved, before.velocities)
            length = np.where(before.visible & after.visible, size / steps, 0.0)
            out += length[:, None] * (after.by_value[:, r] - before.by_value[:, r])
        return out
