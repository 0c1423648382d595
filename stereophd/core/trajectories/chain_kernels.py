"""A Kalman filter and a smoother over the detections of one track, as compiled passes.

The smoother is the form of Bryson and Frazier (1963), which inverts no covariance of a state and so needs no full rank.
Reference: G. J. Bierman, "Fixed interval smoothing with discrete measurements", Int. J. Control 18 (1), 1973.
"""

import math
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.numerics.compilation.compiled import compiled


class Steps(NamedTuple):
    """Motion between successive places of a track, the first step of no length: see `stereophd.core.motion.base`."""

    reach: Array  # (n,), s
    keep: Array  # (n,)
    drift: Array  # (n, 6)
    position: Array  # (n,), noise of positions, with `cross` and `velocity` for unit acceleration
    cross: Array  # (n,)
    velocity: Array  # (n,)
    variances: Array  # (3,), of the acceleration on each axis


class Measured(NamedTuple):
    """Linearised detections ``pixel = jacobian state + noise`` of a track at n places."""

    known: Booleans  # (n,), whether there is one
    pixels: Array  # (n, 2)
    jacobians: Array  # (n, 2, 6)
    noises: Array  # (n, 2, 2)


class Pass(NamedTuple):
    """Gaussians of a pass at n places: predicted, and with the detection of the place."""

    predicted: Array  # (n, 6)
    predicted_covariances: Array  # (n, 6, 6)
    states: Array  # (n, 6)
    covariances: Array  # (n, 6, 6)


@compiled
def filter_chain(steps: Steps, measured: Measured, mean: Array, covariance: Array, out: Pass) -> float:
    """Filter a track from a prior (6,), (6, 6) at its first place on; return the log-likelihood of its detections."""
    total = 0.0
    x, spread = mean.copy(), covariance.copy()
    gain, across, inverse = np.empty((6, 2)), np.empty((6, 2)), np.empty((2, 2))
    error, keep = np.empty(2), np.empty((6, 6))
    for k in range(len(steps.reach)):
        if k > 0:
            _predict(steps, k, x, spread)
        out.predicted[k] = x
        out.predicted_covariances[k] = spread
        if measured.known[k]:
            jacobian, noise = measured.jacobians[k], measured.noises[k]
            total += _innovation(measured, k, x, spread, error, across, inverse)
            _times(across, inverse, gain)
            for a in range(6):
                x[a] += gain[a, 0] * error[0] + gain[a, 1] * error[1]
                for b in range(6):
                    keep[a, b] = -gain[a, 0] * jacobian[0, b] - gain[a, 1] * jacobian[1, b]
                keep[a, a] += 1.0
            _congruence(keep, spread)
            # Joseph's form: symmetric and positive whatever the prior
            for a in range(6):
                for b in range(6):
                    for i in range(2):
                        for j in range(2):
                            spread[a, b] += gain[a, i] * noise[i, j] * gain[b, j]
        out.states[k] = x
        out.covariances[k] = spread
    return total


@compiled
def smooth_chain(steps: Steps, measured: Measured, forward: Pass, states: Array, covariances: Array) -> None:
    """Fill in the smoothed states (n, 6) and covariances (n, 6, 6) of a track that was filtered forwards."""
    count = len(steps.reach)
    slope, bend, turned = np.zeros(6), np.zeros((6, 6)), np.empty(6)
    across, gain, inverse = np.empty((6, 2)), np.empty((6, 2)), np.empty((2, 2))
    error, keep, weighted = np.empty(2), np.empty((6, 6)), np.empty((6, 6))
    for k in range(count - 1, -1, -1):
        x, spread = forward.predicted[k], forward.predicted_covariances[k]
        if measured.known[k]:
            jacobian = measured.jacobians[k]
            _innovation(measured, k, x, spread, error, across, inverse)
            _times(across, inverse, gain)
            for a in range(6):
                for b in range(6):
                    # transposed, as `_congruence` takes it
                    keep[b, a] = -gain[a, 0] * jacobian[0, b] - gain[a, 1] * jacobian[1, b]
                keep[a, a] += 1.0
            for a in range(6):
                turned[a] = 0.0
                for b in range(6):
                    turned[a] += keep[a, b] * slope[b]
            slope[:] = turned
            _congruence(keep, bend)
            for a in range(6):
                for i in range(2):
                    for j in range(2):
                        slope[a] -= jacobian[i, a] * inverse[i, j] * error[j]
                        for b in range(6):
                            bend[a, b] += jacobian[i, a] * inverse[i, j] * jacobian[j, b]
        for a in range(6):
            states[k, a] = x[a]
            for b in range(6):
                states[k, a] -= spread[a, b] * slope[b]
                weighted[a, b] = 0.0
                for c in range(6):
                    weighted[a, b] += bend[a, c] * spread[c, b]
        for a in range(6):
            for b in range(6):
                covariances[k, a, b] = spread[a, b]
                for c in range(6):
                    covariances[k, a, b] -= spread[a, c] * weighted[c, b]
        for a in range(6):
            for b in range(a):
                mean = 0.5 * (covariances[k, a, b] + covariances[k, b, a])
                covariances[k, a, b] = covariances[k, b, a] = mean
        _transpose_step(steps.reach[k], steps.keep[k], slope, bend)


@compiled
def _predict(steps: Steps, k: int, x: Array, spread: Array) -> None:
    """Carry a Gaussian over the step to place k, in place."""
    reach, keep = steps.reach[k], steps.keep[k]
    for a in range(3):
        x[a] += reach * x[3 + a] + steps.drift[k, a]
        x[3 + a] = keep * x[3 + a] + steps.drift[k, 3 + a]
    for a in range(3):
        for b in range(3):
            cross, velocity = spread[a, 3 + b], spread[3 + a, 3 + b]
            spread[a, b] += reach * (cross + spread[3 + a, b]) + reach * reach * velocity
    for a in range(3):
        for b in range(3):
            spread[a, 3 + b] = keep * (spread[a, 3 + b] + reach * spread[3 + a, 3 + b])
    for a in range(3):
        for b in range(3):
            spread[3 + b, a] = spread[a, 3 + b]
            spread[3 + a, 3 + b] *= keep * keep
        variance = steps.variances[a]
        spread[a, a] += steps.position[k] * variance
        spread[a, 3 + a] += steps.cross[k] * variance
        spread[3 + a, a] += steps.cross[k] * variance
        spread[3 + a, 3 + a] += steps.velocity[k] * variance


@compiled
def _transpose_step(reach: float, keep: float, slope: Array, bend: Array) -> None:
    """Carry the derivatives of the later log-likelihood back over a step, in place."""
    for a in range(3):
        slope[3 + a] = reach * slope[a] + keep * slope[3 + a]
    for a in range(6):
        for b in range(3):
            bend[a, 3 + b] = reach * bend[a, b] + keep * bend[a, 3 + b]
    for a in range(3):
        for b in range(6):
            bend[3 + a, b] = reach * bend[a, b] + keep * bend[3 + a, b]


@compiled
def _innovation(
    measured: Measured, k: int, x: Array, spread: Array, error: Array, across: Array, inverse: Array
) -> float:
    """Fill in the error (2,), P H' (6, 2) and the inverse covariance (2, 2) of a detection; return its log-density."""
    jacobian, noise = measured.jacobians[k], measured.noises[k]
    s00, s01, s11 = noise[0, 0], noise[0, 1], noise[1, 1]
    error[0], error[1] = measured.pixels[k, 0], measured.pixels[k, 1]
    for a in range(6):
        error[0] -= jacobian[0, a] * x[a]
        error[1] -= jacobian[1, a] * x[a]
        across[a, 0], across[a, 1] = 0.0, 0.0
        for b in range(6):
            across[a, 0] += spread[a, b] * jacobian[0, b]
            across[a, 1] += spread[a, b] * jacobian[1, b]
    for a in range(6):
        s00 += jacobian[0, a] * across[a, 0]
        s01 += jacobian[0, a] * across[a, 1]
        s11 += jacobian[1, a] * across[a, 1]
    determinant = s00 * s11 - s01 * s01
    inverse[0, 0], inverse[1, 1] = s11 / determinant, s00 / determinant
    inverse[0, 1] = inverse[1, 0] = -s01 / determinant
    distance = inverse[0, 0] * error[0] ** 2 + 2.0 * inverse[0, 1] * error[0] * error[1] + inverse[1, 1] * error[1] ** 2
    return float(-0.5 * distance - 0.5 * math.log(determinant) - math.log(2.0 * math.pi))


@compiled
def _times(across: Array, inverse: Array, gain: Array) -> None:
    """Fill in the gain (6, 2)."""
    for a in range(6):
        gain[a, 0] = across[a, 0] * inverse[0, 0] + across[a, 1] * inverse[1, 0]
        gain[a, 1] = across[a, 0] * inverse[0, 1] + across[a, 1] * inverse[1, 1]


@compiled
def _congruence(keep: Array, spread: Array) -> None:
    """Replace a symmetric P (6, 6) by ``keep P keep'``."""
    half = np.empty((6, 6))
    for a in range(6):
        for b in range(6):
            half[a, b] = 0.0
            for c in range(6):
                half[a, b] += keep[a, c] * spread[c, b]
    for a in range(6):
        for b in range(a + 1):
            total = 0.0
            for c in range(6):
                total += half[a, c] * keep[b, c]
            spread[a, b] = spread[b, a] = total
