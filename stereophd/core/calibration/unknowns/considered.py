"""What cameras that are known with a covariance leave uncertain of tracks: consider parameters.

A filter takes its cameras as exact. An error v of their values moves a track to where its rays then meet. To first
order, with the information F_c that a detection of camera c holds about the position, the derivatives H_c and V_c of
its pixel by position and values, and its noise R_c,

    dx / dv = -(sum_c w_c F_c)^-1 sum_c w_c H_c^T R_c^-1 V_c,     F_c = H_c^T R_c^-1 H_c.

The weight w_c is the number of detections of camera c on which the estimate rests. The weights follow from its
covariance P: the non-negative ones for which sum_c w_c F_c is nearest to P^-1, in units of P. Estimates of filters, of
smoothers and of predictions are treated alike, and nothing of their past is needed. (S. F. Schmidt, "Application of
state-space methods to navigation problems", 1966, for parameters that are considered but not estimated.)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.parameters import ParameterSet, taken
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import look
from stereophd.core.geometry.rotations import cross_matrices

# Sweeps in which the weights are found, and the part of the information of a track that is taken as not of its rays.
SWEEPS, OTHER = 15, 1e-2


@dataclass(frozen=True)
class CameraUncertainty:
    """Cameras, the parameters of which they are not sure, and the covariance (m, m) of these."""

    parameters: ParameterSet  # About the cameras
    covariance: Array

    @cached_property
    def root(self) -> Array:
        """Return a root (m, m) of the covariance."""
        eigenvalues, vectors = np.linalg.eigh(self.covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(eigenvalues, 0.0)))

    def moves(self, times: Array, states: Array, covariances: Array) -> Array:
        """Derivatives (n, 3, m) of the positions of estimates at times (n,), s, by the values.

        The estimates have states (n, 6) and covariances (n, 6, 6).
        """
        count, size = len(states), self.parameters.size
        roots = np.linalg.cholesky(covariances[:, :3, :3])
        information, pulls = [], []
        for camera in self.parameters.cameras:
            log_times = (times - camera.clock.offset_s) / camera.clock.rate
            view = look(camera, states[:, :3], states[:, 3:], times, log_times, np.zeros(count))
            view = replace(view, rows=view.pixels[:, 1] / camera.height)
            inside = view.visible & ((view.pixels >= 0.0) & (view.pixels < [camera.width, camera.height])).all(axis=1)
            weighted = view.by_world * (inside[:, None] / camera.detector.sigma**2)[:, :, None]
            by_value = np.zeros((count, 2, size))
            for quantity, index in self.parameters.unknown(camera.name):
                slopes = quantity.derivative(view, taken(np.zeros(size), index))
                by_value[:, :, index[index >= 0]] += slopes[:, :, index >= 0]
            by_value[~inside] = 0.0
            information.append(np.einsum("nia,nib->nab", weighted, view.by_world))
            pulls.append(np.einsum("nia,nim->nam", weighted, by_value))
        of_rays = np.stack(information, axis=1)
        weights = _weights(np.einsum("nba,ncbd,nde->ncae", roots, of_rays, roots))
        total = np.einsum("nc,ncab->nab", weights, of_rays)
        total += OTHER * np.linalg.inv(covariances[:, :3, :3])
        return -np.linalg.solve(total, np.einsum("nc,ncam->nam", weights, np.stack(pulls, axis=1)))

    def added(self, moves: Array) -> Array:
        """Covariances (n, 6, 6) that uncertain cameras add to estimates that move so (n, 3, m): of positions alone."""
        out, shifts = np.zeros((len(moves), 6, 6)), moves @ self.root
        out[:, :3, :3] = shifts @ np.swapaxes(shifts, 1, 2)
        return out


def _weights(information: Array) -> Array:
    """Non-negative weights (n, c) with which matrices (n, c, 3, 3) add up to nearly the unit matrix, by descent."""
    products = np.einsum("niab,njab->nij", information, information)
    traces = np.trace(information, axis1=2, axis2=3)
    diagonal = np.maximum(np.einsum("nii->ni", products), 1e-300)
    weights = np.broadcast_to(3.0 / np.maximum(traces.sum(axis=1, keepdims=True), 1e-300), traces.shape).copy()
    for _ in range(SWEEPS):
        for camera in range(weights.shape[1]):
            slope = traces[:, camera] - (products[:, camera] * weights).sum(axis=1)
            weights[:, camera] = np.maximum(weights[:, camera] + slope / diagonal[:, camera], 0.0)
    return weights


@dataclass(frozen=True)
class CommonPart:
    """Sums over estimates, from which follows what of their moves is common: a similarity of the whole scene."""

    count: int
    matrix: Array  # (7, 7): Of translation, rotation and scale
    vector: Array  # (7, m): Their products with the moves by the columns of a root of the covariance
    total: float  # Sum of the squared moves

    @staticmethod
    def of(positions: Array, shifts: Array) -> CommonPart:
        """Return the sums of estimates at positions (n, 3) that move by the columns of a root so (n, 3, m)."""
        basis = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(positions), 3, 3)), -cross_matrices(positions), positions[:, :, None]],
            axis=2,
        )
        return CommonPart(
            len(positions), np.einsum("nai,naj->ij", basis, basis), np.einsum("nai,nam->im", basis, shifts),
            float((shifts**2).sum()),
        )  # fmt: skip

    def joined(self, other: CommonPart) -> CommonPart:
        """Return the sums of both."""
        return CommonPart(
            self.count + other.count, self.matrix + other.matrix, self.vector + other.vector, self.total + other.total
        )

    def stds(self) -> tuple[float, ...]:
        """Root mean squares of the moves that are common to all estimates, and of the others, length."""
        scale = np.sqrt(np.maximum(np.diag(self.matrix), 1e-300))
        solved = np.linalg.pinv(self.matrix / np.outer(scale, scale), 1e-10, True) @ (self.vector / scale[:, None])
        common = float((solved * (self.vector / scale[:, None])).sum())
        return tuple(np.sqrt(np.maximum([common, self.total - common], 0.0) / max(self.count, 1)).tolist())
