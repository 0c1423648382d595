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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet, taken
from stereophd.core.calibration.unknowns.quantities.pixel_derivatives import view_of
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.core.numerics.compilation.compiled import compiled

# Sweeps in which the weights are found, and the part of the information of a track that is taken as not of its rays.
SWEEPS, OTHER = 15, 1e-2
# A covariance with an eigenvalue below this part of the largest is singular.
SINGULAR = 1e-10
# The least eigenvalue: its inverse and its square are still far within the range of numbers. Moves depend on the shape
# of a covariance and not on its size, so those of a zero covariance are those of any round one.
LEAST = float(np.finfo(np.float64).tiny) ** (1.0 / 3.0)


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

        The estimates have states (n, 6) and covariances (n, 6, 6). Those of positions that are singular count as
        regular ones, a part `SINGULAR` of the largest eigenvalue wide, and at least `LEAST`.
        """
        count, size = len(states), self.parameters.size
        eigenvalues, vectors = np.linalg.eigh(covariances[:, :3, :3])
        eigenvalues = np.maximum(eigenvalues, np.maximum(SINGULAR * eigenvalues[:, -1:], LEAST))
        roots = vectors * np.sqrt(eigenvalues)[:, None, :]
        inverse = (vectors / eigenvalues[:, None, :]) @ np.swapaxes(vectors, 1, 2)
        information, pulls = [], []
        for camera in self.parameters.cameras:
            log_times = (times - camera.clock.offset_s) / camera.clock.rate
            view = view_of(camera, states[:, :3], states[:, 3:], times, log_times, np.zeros(count))
            view = replace(view, rows=view.pixels[:, 1] / camera.height)
            inside = view.visible & ((view.pixels >= 0.0) & (view.pixels < [camera.width, camera.height])).all(axis=1)
            weighted = np.swapaxes(view.by_world, 1, 2) * (inside[:, None] / camera.detector.sigma**2)[:, None, :]
            by_value = np.zeros((count, 2, size))
            for quantity, index in self.parameters.unknown(camera.name):
                slopes = quantity.derivative(view, taken(np.zeros(size), index))
                by_value[:, :, index[index >= 0]] += slopes[:, :, index >= 0]
            by_value[~inside] = 0.0
            information.append(weighted @ view.by_world)
            pulls.append(weighted @ by_value)
        of_rays, of_values = np.stack(information, axis=1), np.stack(pulls, axis=1)
        weights = _weights(np.swapaxes(roots, 1, 2)[:, None] @ of_rays @ roots[:, None])[:, :, None, None]
        total = (weights * of_rays).sum(axis=1) + OTHER * inverse
        return -np.linalg.solve(total, (weights * of_values).sum(axis=1))

    def added(self, moves: Array) -> Array:
        """Covariances (n, 6, 6) that uncertain cameras add to estimates that move so (n, 3, m): of positions alone."""
        out, shifts = np.zeros((len(moves), 6, 6)), moves @ self.root
        out[:, :3, :3] = shifts @ np.swapaxes(shifts, 1, 2)
        return out


def moves_of_a_pixel(
    cameras: Sequence[Camera], times: Array, states: Array, covariances: Array
) -> tuple[float, float] | None:
    """Return how far a camera that is turned until its detections lie one pixel off moves estimates (see `moves`).

    Medians over the estimates: of a length, and of standard deviations that they state; for the worst camera and
    direction. None without estimates whose covariance is positive definite.
    """
    usable: Booleans = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    eigenvalues = np.linalg.eigvalsh(covariances[usable, :3, :3])
    usable[usable] = eigenvalues[:, 0] > SINGULAR * eigenvalues[:, -1]
    if not usable.any():
        return None
    parameters = [Parameter(f"rotation_{axis}", camera.name, 0.0, 1.0) for camera in cameras for axis in "xy"]
    turned = CameraUncertainty(ParameterSet(tuple(cameras), tuple(parameters)), np.eye(len(parameters)))
    pixels = np.ravel([(1.0 / camera.fy, 1.0 / camera.fx) for camera in cameras])
    moves = turned.moves(times[usable], states[usable], covariances[usable]) * pixels
    relative = np.linalg.solve(np.linalg.cholesky(covariances[usable, :3, :3]), moves)
    lengths, stds = (
        np.linalg.norm(each.reshape(len(each), 3, -1, 2), 2, axis=(1, 3)).max(axis=1) for each in (moves, relative)
    )
    return float(np.median(lengths)), float(np.median(stds))


@compiled
def _weights(information: Array) -> Array:
    """Non-negative weights (n, c) with which matrices (n, c, 3, 3) add up to nearly the unit matrix, by descent."""
    count, cameras = information.shape[:2]
    weights = np.empty((count, cameras))
    products, traces = np.empty((cameras, cameras)), np.empty(cameras)
    for n in range(count):
        for i in range(cameras):
            traces[i] = np.trace(information[n, i])
            for j in range(cameras):
                products[i, j] = (information[n, i] * information[n, j]).sum()
        weights[n] = 3.0 / max(traces.sum(), 1e-300)
        for _ in range(SWEEPS):
            for i in range(cameras):
                slope = traces[i] - (products[i] * weights[n]).sum()
                weights[n, i] = max(weights[n, i] + slope / max(products[i, i], 1e-300), 0.0)
    return weights


@dataclass(frozen=True)
class CommonPart:
    """Sums over estimates, from which follows what of their moves is common: a similarity of the whole scene."""

    count: int
    matrix: Array  # (7, 7): Of translation, rotation and scale
    vector: Array  # (7, m): Their products with the moves by the columns of a root of the covariance
    total: float  # Sum of the squared moves

    @staticmethod
    def of_none(size: int) -> "CommonPart":
        """Return the sums of no estimate, for m parameters."""
        return CommonPart(0, np.zeros((7, 7)), np.zeros((7, size)), 0.0)

    def including(self, positions: Array, shifts: Array) -> "CommonPart":
        """Return the sums with estimates at positions (n, 3) that move by the columns of a root so (n, 3, m).

        They are added one by one: however they are handed over, the sums are the same to the last bit.
        """
        basis = np.concatenate(
            [np.broadcast_to(np.eye(3), (len(positions), 3, 3)), -cross_matrices(positions), positions[:, :, None]],
            axis=2,
        )
        matrix, vector = self.matrix.copy(), self.vector.copy()
        total = _add_one_by_one(basis, np.ascontiguousarray(shifts), matrix, vector, self.total)
        return CommonPart(self.count + len(positions), matrix, vector, total)

    def stds(self) -> tuple[float, ...]:
        """Root mean squares of the moves that are common to all estimates, and of the others, length."""
        scale = np.sqrt(np.maximum(np.diag(self.matrix), 1e-300))
        solved = np.linalg.pinv(self.matrix / np.outer(scale, scale), 1e-10, True) @ (self.vector / scale[:, None])
        common = float((solved * (self.vector / scale[:, None])).sum())
        return tuple(np.sqrt(np.maximum([common, self.total - common], 0.0) / max(self.count, 1)).tolist())


@compiled
def _add_one_by_one(basis: Array, shifts: Array, matrix: Array, vector: Array, total: float) -> float:
    """Add the products of a basis (n, 3, 7) with itself and with shifts (n, 3, m); return the total with theirs."""
    for n in range(len(basis)):
        for axis in range(3):
            for i in range(7):
                matrix[i] += basis[n, axis, i] * basis[n, axis]
                vector[i] += basis[n, axis, i] * shifts[n, axis]
            for shift in shifts[n, axis]:
                total += shift * shift
    return total
