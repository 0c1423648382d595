"""How tracks follow cameras that are not where they should be, and what residuals say about the cameras' poses.

The response of a track is the derivative of its state with respect to the pose of each camera: three turns, rad, and
three moves, both along the camera's axes. A detection moves the response by the gain of the filter, as it moves the
state. Residuals of a filter are independent, so the information that they hold about the poses adds up (Willsky and
Jones 1976).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.numerics.compilation.compiled import compiled

# The size of a knock, rad, and as a part of the distance of the tracks: standard deviation of each unknown, and of what
# a pose was off by before; and the part of it by which a pose may seem to change without a knock.
USUAL, TOLERATED = math.radians(0.5), 0.02
# What may change: all unknowns, or any one of them alone; precisions of each, in squares of the usual size.
SUPPOSED = np.vstack([np.ones(6), 1e6 - (1e6 - 1.0) * np.eye(6)])
# Information beyond the inverse of this is lost to rounding: the noise counts as that much larger.
ROUNDING = 1e-10
# Number of unknowns that a block must inform, for its misfit to count.
LEAST_EXPECTED = 1.0


@dataclass(frozen=True)
class PoseChange:
    """A change of a camera's pose."""

    # Logarithm of the Bayes factor for it: without a change it exceeds c with a probability of at most exp(-c)
    evidence: float
    blocks: int  # In how many of the last blocks it shows
    turns: Array  # (3,): About the camera's axes, rad
    moves: Array  # (3,): Along them, in distances of the tracks
    # Squared misfit of the first block to those before it, in what the model expects; None where that says little
    misfit: float | None


class Pinhole(NamedTuple):
    """A camera without a lens, for kernels."""

    rotation: Array  # (3, 3)
    center: Array  # (3,)
    fx: float  # px, as the next three
    fy: float
    cx: float
    cy: float


class Predicted(NamedTuple):
    """A track predicted into an image."""

    place: Array  # (3,): Along the camera's axes
    pixel: Array  # (2,)
    seen: Array  # (2, 3): Derivative of the pixel with respect to the position
    shared: Array  # (2, 6): Covariance of the pixel with the state
    spread: Array  # (2, 2): Covariance of the pixel, and of a detection about it once its noise is added


@compiled
def predict_track(state: Array, covariance: Array, since_s: float, camera: Pinhole, out: Predicted) -> None:
    """Predict a track into an image, after a time since its state."""
    rotation, center = camera.rotation, camera.center
    place, pixel, seen, shared, spread = out.place, out.pixel, out.seen, out.shared, out.spread
    for a in range(3):
        place[a] = 0.0
        for b in range(3):
            place[a] += rotation[a, b] * (state[b] + since_s * state[b + 3] - center[b])
    pixel[0], pixel[1] = camera.fx * place[0] / place[2] + camera.cx, camera.fy * place[1] / place[2] + camera.cy
    for b in range(3):
        seen[0, b] = camera.fx / place[2] * (rotation[0, b] - place[0] / place[2] * rotation[2, b])
        seen[1, b] = camera.fy / place[2] * (rotation[1, b] - place[1] / place[2] * rotation[2, b])
    for r in range(2):
        for b in range(6):
            shared[r, b] = 0.0
            for a in range(3):
                shared[r, b] += seen[r, a] * (covariance[a, b] + since_s * covariance[a + 3, b])
        for b in range(3):
            shared[r, b] += since_s * shared[r, b + 3]
    for r in range(2):
        for s in range(2):
            spread[r, s] = 0.0
            for a in range(3):
                spread[r, s] += shared[r, a] * seen[s, a]


@compiled
def square_of(u: float, v: float, covariance: Array) -> float:
    """Return the squared length of a residual (u, v), in the variances of a covariance (2, 2)."""
    a, b, c = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    return float((c * u * u - 2.0 * b * u * v + a * v * v) / (a * c - b * b))


@compiled
def follow_detection(response: Array, predicted: Predicted, camera: Pinhole, index: int) -> Array:
    """Move the response (6, 6 c) of a track by a detection of the camera with an index.

    Returns the derivative of the residual with respect to the poses (2, 6 c).
    """
    place, seen, shared, spread = predicted.place, predicted.seen, predicted.shared, predicted.spread
    out, focal = np.empty((2, response.shape[1])), (camera.fx, camera.fy)
    for r in range(2):
        for q in range(out.shape[1]):
            out[r, q] = -(seen[r, 0] * response[0, q] + seen[r, 1] * response[1, q] + seen[r, 2] * response[2, q])
        per_length = focal[r] / place[2]
        along = -per_length * place[r] / place[2]
        out[r, 6 * index + 3 + r] -= per_length
        out[r, 6 * index + 5] -= along
        # a turn w moves the place p by w x p
        out[r, 6 * index + 1 - r] += per_length * place[2] * (1.0 if r == 0 else -1.0)
        out[r, 6 * index + 2] += per_length * place[1 - r] * (-1.0 if r == 0 else 1.0)
        out[r, 6 * index] += along * place[1]
        out[r, 6 * index + 1] -= along * place[0]
    a, b, c = spread[0, 0], spread[0, 1], spread[1, 1]
    determinant = a * c - b * b
    for i in range(6):
        gain_u = (c * shared[0, i] - b * shared[1, i]) / determinant
        gain_v = (a * shared[1, i] - b * shared[0, i]) / determinant
        for q in range(out.shape[1]):
            response[i, q] += gain_u * out[0, q] + gain_v * out[1, q]
    return out


@compiled
def add_residual(sums: Array, slope: Array, residual: tuple[float, float], covariance: Array, factor: float) -> None:
    """Add what a residual says to the information (6, 6) and the gradient (6,) of each camera, `sums` (c, 6, 7).

    `slope` (2, 6 c) is its derivative with respect to the poses; `factor` multiplies its covariance (2, 2). Of the
    information only the lower triangle is added to.
    """
    a, b, c = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    determinant = (a * c - b * b) * factor
    for k in range(len(sums)):
        for i in range(6):
            u, v = slope[0, 6 * k + i], slope[1, 6 * k + i]
            along_u, along_v = (c * u - b * v) / determinant, (a * v - b * u) / determinant
            for j in range(i + 1):
                sums[k, i, j] += along_u * slope[0, 6 * k + j] + along_v * slope[1, 6 * k + j]
            sums[k, i, 6] += along_u * residual[0] + along_v * residual[1]


def find_change(sums: Array, factor: float) -> PoseChange | None:
    """Find the change of a camera's pose in the last one, two, ... blocks, against all before, of largest evidence.

    The sums (b, 2, 6, 7) are information and gradient of each block, from each half of the tracks, as `add_residual`
    makes them, with this factor of their variances; the first block is all that was before. None where nothing is
    known.
    """
    diagonal = sums.sum(axis=(0, 1)).diagonal()
    if not (diagonal.all() and np.isfinite(sums).all()):
        return None
    far = math.sqrt(diagonal[:2].sum() / diagonal[3:5].sum())
    unit, one = USUAL * np.array([1.0, 1.0, 1.0, far, far, far]), np.eye(6)
    information = sums[..., :6] * (unit[:, None] * unit)
    information = information + np.swapaxes(information * np.tri(6, k=-1), -1, -2)
    gradient = sums[..., 6:] * unit[:, None]
    whole = information.sum(axis=(0, 1))
    factor = max(factor, ROUNDING * whole.max())
    # what the pose was off by before each of the times at which it may have changed, the latest first
    halves = information[:0:-1].cumsum(axis=0) / factor, gradient[:0:-1].cumsum(axis=0) / factor
    late, pull = halves[0].sum(axis=1), halves[1].sum(axis=1)
    known = np.linalg.inv(whole / factor - late + one)
    offset = known @ (gradient.sum(axis=(0, 1)) / factor - pull)
    known = known + TOLERATED**2 * one
    # the information about the change is less by this factor, because the pose before is not better known
    less, excess = one + late @ known, pull - late @ offset
    rest = np.linalg.solve(less, excess)
    precision = less * SUPPOSED[:, None, None] + late
    change = np.linalg.solve(precision, excess)
    lost = np.log(np.linalg.det(precision) / (np.linalg.det(less) * SUPPOSED.prod(axis=1)[:, None]))
    evidence = 0.5 * ((rest * change).sum(axis=(2, 3)) - lost)
    # neither half of the tracks speaks more than twice as loud as the other
    moved, before = change[:, :, None], offset[:, None]
    each = (moved * (halves[1] - halves[0] @ (before + 0.5 * moved))).sum(axis=(3, 4))
    evidence = np.minimum(evidence, 3.0 * each.min(axis=2)) - math.log(len(SUPPOSED))
    which, best = np.unravel_index(int(evidence.argmax()), evidence.shape)
    first = information[1].sum(axis=0)
    excess = gradient[1].sum(axis=0) - first @ offset[-1]
    # what a block says little about is left out: the pose may be off by `USUAL` there
    spread = first + first @ known[-1] @ first / factor
    inverse = np.linalg.inv(spread + max(1.0, ROUNDING * spread.max()) * one)
    expected = float((inverse * spread).sum())
    misfit = float(excess[:, 0] @ inverse @ excess[:, 0]) / expected if expected > LEAST_EXPECTED else None
    turns, moves = USUAL * change[which, best, :, 0].reshape(2, 3)
    return PoseChange(float(evidence[which, best]), int(best) + 1, turns, moves, misfit)
