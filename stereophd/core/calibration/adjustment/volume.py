"""How the volume of the trajectories, half of log det A, changes with values and points, detection by detection.

With the covariance S of the point of a detection, of weight w, precision P and derivative J by the point, a change of
A by any of its unknowns changes the volume by w tr(S J^T P dJ): the detection pulls at its J with K = w P J S. As dJ by
a value is the change by the point of the derivative by the value, that is what a quantity knows about pulls along the
two rows of K (`quantities.base.Pull`). A later time of a detection also moves the weights of its knots, from those of
the position to those of the velocity. The covariances are those parts of the inverse of A that lie within its band
(K. Takahashi, J. Fagan and M.-S. Chin, "Formation of a sparse bus impedance matrix", 1973).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.calibration.adjustment.linearisation import Linearisation, Seen
from stereophd.core.numerics.compilation.compiled import compiled


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
                if weight == 0.0 or start + 3 * max(b, c) >= size:
                    continue
                for i in range(3):
                    for j in range(3):
                        row, column = start + 3 * b + i, start + 3 * c + j
                        out[n, i, j] += weight * inverse[abs(row - column), min(row, column)]


@compiled
def _slopes(
    inverse: Array, knots: Integers, weights: Array, rates: Array, by_point: Array, precisions: Array, bends: Array
) -> tuple[Array, Array, Array]:
    """Return `rows`, `by_point` and `by_time` of `VolumeSlopes` from the inverse of A within its band.

    `weights` and `rates` (n, 4) are those of positions and velocities, `precisions` (n, 2, 2) those of what is seen.
    """
    count = len(knots)
    rows, of_point, by_time = np.zeros((count, 2, 3)), np.zeros((count, 3)), np.zeros(count)
    here, moving, pull = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for n in range(count):
        here[:], moving[:], start = 0.0, 0.0, 6 * knots[n]
        for b in range(4 if start + 6 < inverse.shape[1] else 2):
            for c in range(b + 1):
                both = weights[n, b] * weights[n, c]
                first, second = weights[n, b] * rates[n, c], rates[n, b] * weights[n, c]
                for i in range(3):
                    for j in range(3):
                        row, column = start + 3 * b + i, start + 3 * c + j
                        covariance = inverse[abs(row - column), min(row, column)]
                        here[i, j] += both * covariance
                        moving[i, j] += first * covariance
                        if c < b:
                            here[j, i] += both * covariance
                            moving[j, i] += second * covariance
        for r in range(2):
            for a in range(3):
                pull[a] = precisions[n, r, 0] * by_point[n, 0, a] + precisions[n, r, 1] * by_point[n, 1, a]
            for a in range(3):
                for b in range(3):
                    rows[n, r, a] += here[a, b] * pull[b]
                    by_time[n] += by_point[n, r, a] * moving[a, b] * pull[b]
            for a in range(3):
                for b in range(3):
                    of_point[n, a] += bends[n, r, a, b] * rows[n, r, b]
    return rows, of_point, by_time


@dataclass(frozen=True)
class VolumeSlopes:
    """Derivatives of half of log det A at some values, its parts summing up to the whole."""

    values: Array
    seen: Seen  # What is seen of the detections
    rows: Array  # (n, 2, 3): by the derivatives of the pixels of each detection by its point
    by_point: Array  # (n, 3): by the point of each detection
    by_time: Array  # (n,): by its time, through the weights of its knots
    by_noise: Array  # (l, 6): of each link, by the unknowns of the noise of the motion

    @classmethod
    def of(cls, linearisation: Linearisation, values: Array, noise: Array, factor: Array, seen: Seen) -> Self:
        """Return the derivatives at values (m,); `factor` (12, 6 k) is that of A, lower banded."""
        inverse = np.zeros_like(factor)
        inverse_in_band(factor, inverse)
        path, rates = seen.placement.path, seen.placement.rates
        precisions = np.where(seen.visible[:, None, None], linearisation.precisions, 0.0)
        rows, of_point, by_time = _slopes(
            inverse, path.knot, path.weights, rates.weights, seen.by_point, precisions, seen.bends
        )
        links = linearisation.motion.links
        covariances = np.zeros((len(links.knot), 3, 3))
        summed_covariances(inverse, links.knot, links.precisions, covariances)
        by_noise = linearisation.noise_at(values, noise).by_unknowns(covariances)
        return cls(values, seen, rows, of_point, by_time, by_noise)

    def by_value(
        self, linearisation: Linearisation, pixels: Array, more: Array | float = 0.0, later: Array | float = 0.0
    ) -> Array:
        """Return derivatives (n, q) by the values of the camera of each detection, of the volume and what adds to it.

        This is given by weights `pixels` (n, 2) of the pixels, `more` (n, 2, 3) of their derivatives by the points, and
        `later` (n,) of the times.
        """
        return linearisation.pulled(self.seen, self.values, pixels, self.rows + more, self.by_time + later)
