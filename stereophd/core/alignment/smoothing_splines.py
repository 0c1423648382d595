"""Smoothing splines of noisy values, as smooth as generalised cross-validation finds them.

The natural cubic spline f that minimises sum_k (y_k - f(t_k))^2 + 1 / r integral f''^2 leaves y - f = Q u, with the
second differences Q^T y of the values, (Q^T Q + r R) u = Q^T y, and banded matrices (C. H. Reinsch, "Smoothing by
spline functions", 1967). Cross-validation minimises |Q u|^2 / tr(M^-1 Q^T Q)^2 with M = Q^T Q + r R (P. Craven and
G. Wahba, 1979). The trace is n - 2 - d log det M / d log r: a difference of two factorisations, in place of the bands
of an inverse.
"""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize_scalar

from stereophd.core.arrays import Array

# Logarithms of r, in units of the median step, between which the smoothness lies: from windows of a thousand steps to
# next to none; step of its derivative; tolerance.
ROUGHNESS, STEP, TOLERANCE = (-27.0, 7.0), 0.01, 0.1


def smoothing_spline(times: Array, values: Array) -> CubicSpline:
    """Return the spline of values (n,) at increasing times (n,), n >= 5, along which their noise is removed."""
    steps, count = np.diff(times), len(times) - 2
    inverse, bends = 1.0 / steps, np.diff(np.diff(values) / steps)
    noise, rough = np.zeros((3, count)), np.zeros((3, count))  # upper bands of Q^T Q, and of R
    noise[2] = inverse[:-1] ** 2 + (inverse[:-1] + inverse[1:]) ** 2 + inverse[1:] ** 2
    noise[1, 1:] = -inverse[1:-1] * (inverse[:-2] + 2.0 * inverse[1:-1] + inverse[2:])
    noise[0, 2:] = inverse[1:-2] * inverse[2:-1]
    rough[2], rough[1, 1:] = (steps[:-1] + steps[1:]) / 3.0, steps[1:-1] / 6.0
    rough /= np.median(steps) ** 3

    def factor(roughness: float) -> Array:
        return np.asarray(cholesky_banded(noise + np.exp(roughness) * rough))

    def left(roughness: float) -> Array:
        pulls = np.pad(cho_solve_banded((factor(roughness), False), bends), 1)
        return np.diff(np.pad(np.diff(pulls) / steps, 1))

    def score(roughness: float) -> float:
        more, less = (2.0 * np.log(factor(roughness + sign * STEP)[2]).sum() for sign in (1.0, -1.0))
        free = count - (more - less) / (2.0 * STEP)
        squares = max(float((left(roughness) ** 2).sum()), np.finfo(np.float64).tiny)
        return float(np.log(squares) - 2.0 * np.log(free))

    best = minimize_scalar(score, bounds=ROUGHNESS, method="bounded", options={"xatol": TOLERANCE})
    return CubicSpline(times, values - left(best.x), bc_type="natural")
