"""Lens distortion of normalised image coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereophd.core.geometry.layout import LENS_BROWN_CONRADY, LENS_FISHEYE, LENS_NONE, LENS_RADIAL

FloatArray = NDArray[np.float64]
LensModel = Literal["none", "radial", "brown_conrady", "fisheye"]

CODES: Final[dict[str, int]] = {
    "none": LENS_NONE,
    "radial": LENS_RADIAL,
    "brown_conrady": LENS_BROWN_CONRADY,
    "fisheye": LENS_FISHEYE,
}
PARAMETERS: Final[dict[str, tuple[str, ...]]] = {
    "none": (),
    "radial": ("k1",),
    "brown_conrady": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
# max_radius stays this fraction inside the fold, where the inverse has a finite Jacobian and the
# rounding of a polynomial root does not matter.
FOLD_MARGIN = 1e-9
# A fold at a squared radius beyond this is 89.9999 degrees off the axis: no fold at all.
ROOT_LIMIT = 1e12


@dataclass(frozen=True)
class Lens:
    """A lens model: how undistorted normalised points (x / z, y / z) move in the image.

    Parameters
    ----------
    model : {"none", "radial", "brown_conrady", "fisheye"}
        radial: x_d = x (1 + k1 r^2), the one-parameter distortion of paper section VIII-F;
        brown_conrady: OpenCV's rational model with k1..k6, p1, p2; fisheye: OpenCV's fisheye model,
        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8).
    k1, k2, p1, p2, k3, k4, k5, k6 : float
        Coefficients, without unit.

    Raises
    ------
    ValueError
        If the model is unknown, a coefficient is not finite, or one is given that the model lacks.
    """

    model: LensModel = "none"
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __post_init__(self) -> None:
        if self.model not in CODES:
            raise ValueError(f"lens: expected a model of {', '.join(CODES)}, found {self.model!r}")
        for name in PARAMETERS["brown_conrady"]:
            value = getattr(self, name)
            if not math.isfinite(value):
                raise ValueError(f"lens: expected a finite {name}, found {value}")
            if value != 0.0 and name not in PARAMETERS[self.model]:
                raise ValueError(f"lens: the model {self.model} has no coefficient {name}, found {name} = {value}")

    @property
    def code(self) -> int:
        """Number of the model in compiled kernels: 0 none, 1 radial, 2 brown_conrady, 3 fisheye."""
        return CODES[self.model]

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients (8,): k1, k2, p1, p2, k3, k4, k5, k6; fisheye: k1, k2, k3, k4, 0, 0, 0, 0."""
        names = PARAMETERS["fisheye" if self.model == "fisheye" else "brown_conrady"]
        result = np.zeros(8)
        result[: len(names)] = [getattr(self, name) for name in names]
        return result

    @cached_property
    def max_radius(self) -> float:
        """Largest undistorted radius up to which the radial map r -> r_d increases (inf if always).

        Beyond it the model folds back, and maps points far outside the field of view into the image:
        such points are never in view. A radius at which the map only stands still counts as a limit, and
        so does a pole of the rational model that its numerator cancels.
        """
        if self.model == "fisheye":
            # d theta_d / d theta as a polynomial in theta^2, highest power first.
            slope = [9 * self.k4, 7 * self.k3, 5 * self.k2, 3 * self.k1, 1.0]
            angle = math.sqrt(_smallest_positive_root(slope))
            return math.tan(angle) * (1 - FOLD_MARGIN) if angle < math.pi / 2 else math.inf
        # r_d = r N(s) / D(s), s = r^2: the slope is (N D + 2 s (N' D - N D')) / D^2.
        numerator = np.array([self.k3, self.k2, self.k1, 1.0])
        denominator = np.array([self.k6, self.k5, self.k4, 1.0])
        wronskian: FloatArray = np.polysub(
            np.polymul(np.polyder(numerator), denominator), np.polymul(numerator, np.polyder(denominator))
        )
        slope = np.polyadd(np.polymul(numerator, denominator), np.polymul([2.0, 0.0], wronskian))
        squared = min(_smallest_positive_root(slope), _smallest_positive_root(denominator))
        return math.sqrt(squared) * (1 - FOLD_MARGIN)

    def distort(self, xy: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Distort normalised points.

        Parameters
        ----------
        xy : (n, 2) array_like
            Undistorted normalised coordinates. Whether they are within `max_radius` is not checked.

        Returns
        -------
        xy_d : (n, 2) array
            Distorted normalised coordinates.
        jacobian : (n, 2, 2) array
            d xy_d / d xy.
        """
        points = _points(xy)
        if self.model == "none":
            return points.copy(), _identities(len(points))
        # Imported here: numba takes longer to import than most commands that never distort a point.
        from stereophd.core.geometry.kernels import distort_points

        return distort_points(self.code, self.coefficients, points)

    def undistort(self, xy_d: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Undistort normalised points, by Newton's iteration to rounding.

        Parameters
        ----------
        xy_d : (n, 2) array_like
            Distorted normalised coordinates.

        Returns
        -------
        xy : (n, 2) array
            Undistorted normalised coordinates within `max_radius`; a row of NaN where there are none.
        jacobian : (n, 2, 2) array
            d xy / d xy_d, NaN in the same rows.
        """
        points = _points(xy_d)
        if self.model == "none":
            return points.copy(), _identities(len(points))
        from stereophd.core.geometry.kernels import undistort_points

        return undistort_points(self.code, self.coefficients, self.max_radius, points)


def _points(values: ArrayLike) -> FloatArray:
    """Return contiguous, writable float64 points (n, 2): one compiled specialisation for all callers."""
    points = np.require(values, dtype=np.float64, requirements=["C", "W"])
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"expected points of shape (n, 2), found {points.shape}")
    return points


def _identities(n: int) -> FloatArray:
    return np.broadcast_to(np.eye(2), (n, 2, 2)).copy()


def _smallest_positive_root(polynomial: ArrayLike) -> float:
    """Return the smallest positive root of a polynomial (highest power first, last coefficient 1).

    Roots beyond ROOT_LIMIT count as none, and none is inf.
    """
    # The reciprocals of the roots are those of the reversed polynomial, which is monic: tiny leading
    # coefficients, which would drown the root wanted here, are tiny last ones there and do no harm.
    roots = np.roots(np.asarray(polynomial, dtype=np.float64)[::-1])
    # A double root comes out as a pair with a small imaginary part: there the slope is zero, so it counts.
    is_real = np.abs(roots.imag) <= 1e-7 * np.abs(roots)
    reciprocals = roots.real[is_real & (roots.real > 1.0 / ROOT_LIMIT)]
    return 1.0 / float(reciprocals.max()) if len(reciprocals) else math.inf
