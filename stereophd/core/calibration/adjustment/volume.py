"""How the volume of the trajectories, half of log det A, changes with values and points, detection by detection.

With the covariance S of the point of a detection, of weight w, precision P and derivative J by the point, a change of
A by any of its unknowns changes the volume by w tr(S J^T P dJ): the detection pulls at its J with K = w P J S. As dJ by
a value is the change by the point of the derivative by the value, that is what a quantity knows about pulls along the
two rows of K (`quantities.base.Pull`). A later time of a detection also moves the weights of its knots, from those of
the position to those of the velocity. The covariances are those parts of the inverse of A that lie within its band (K. Takahashi,
J. Fagan and M.-S. Chin, "Formation of a sparse bus impedance matrix", 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class VolumeSlopes:
    """Derivatives of half of log det A at some values, its parts summing up to the whole."""

    values: Array
    seen: Seen  # What is seen of the detections
    rows: Array  # (n, 2, 3): by the derivatives of the pixels of each detection by its point
    by_point: Array  # (n, 3): by the point of each detection
    by_time: Array  # (n,): by its time, through the weights of its knots
    by_noise: Array  # (l, 6): of each link, by the unknowns of the noise of the motion

    @staticmethod
    def of(linearisation: Linearisation, values: Array, noise: Array, factor: Array, seen: Seen) -> VolumeSlopes:
        """Return the derivatives at values (m,); `factor` (12, 6 k) is that of A, lower banded."""
        inverse = np.zeros_like(factor)
        inverse_in_band(factor, inverse)
        path, rates = seen.placement.path, seen.placement.rates
        by_point = np.where(seen.visible[:, None, None], seen.by_point, 0.0)
        spread = np.zeros((2, len(by_point), 3, 3))
        for of_points, weights in zip(spread, (path.weights, rates.weights), strict=True):
            summed_covariances(inverse, path.knot, path.weights[:, :, None] * weights[:, None, :], of_points)
        weighted = linearisation.precisions @ by_point
        rows = weighted @ spread[0]
        by_time = (by_point * (weighted @ spread[1].swapaxes(1, 2))).sum(axis=(1, 2))
        of_point = np.einsum("nrab,nrb->na", seen.bends, rows)
        links = linearisation.motion.links
        covariances = np.zeros((len(links.knot), 3, 3))
        summed_covariances(inverse, links.knot, links.precisions, covariances)
        by_noise = linearisation.noise_at(values, noise).by_unknowns(covariances)
        return VolumeSlopes(values, seen, rows, of_point, by_time, by_noise)

    def by_value(
        self, linearisation: Linearisation, pixels: Array, more: Array | float = 0.0, later: Array | float = 0.0
    ) -> Array:
        """Return derivatives (n, q) by the values of the camera of each detection, and those of what adds to it.

        That are weights `pixels` (n, 2) of the pixels, `more` (n, 2, 3) of their derivatives by the points, and `later`
        (n,) of the times.
        """
        pulled = linearisation.pulled(self.seen, self.values, pixels, self.rows + more)
        return pulled + (self.by_time + later)[:, None] * linearisation.time_slopes
