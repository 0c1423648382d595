"""Lens distortion of normalised image coordinates."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.geometry.lenses import lens_models

CODES: Final[dict[str, int]] = {name: model.code for name, model in lens_models().items()}
PARAMETERS: Final[dict[str, tuple[str, ...]]] = {name: model.coefficients for name, model in lens_models().items()}
# Coefficients of a packed camera.
SLOTS = 8


@dataclass(frozen=True)
class Lens:
    """A lens model: how undistorted normalised points (x / z, y / z) move in the image.

    Raises ValueError if the model is unknown, a coefficient is not finite, or one is given that the model lacks.
    The models: none; radial, x_d = x (1 + k1 r^2), the one-parameter distortion of paper section VIII-F; brown_conrady,
    OpenCV's rational model with k1..k6, p1, p2; fisheye, OpenCV's, theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3
    theta^6 + k4 theta^8).

    Attributes
    ----------
    model : name of the model
    k1, k2, p1, p2, k3, k4, k5, k6 : coefficients, without unit
    """

    model: str = "none"
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
    def coefficients(self) -> Array:
        """Coefficients (8,): k1, k2, p1, p2, k3, k4, k5, k6; fisheye: k1, k2, k3, k4, 0, 0, 0, 0."""
        names = PARAMETERS[self.model]
        result = np.zeros(SLOTS)
        result[: len(names)] = [getattr(self, name) for name in names]
        return result

    @cached_property
    def max_radius(self) -> float:
        """Largest undistorted radius up to which the radial map r -> r_d increases (inf if always).

        Beyond it the model folds back, and maps points far outside the field of view into the image:
        such points are never in view.
        """
        return _max_radius(self.model, tuple(self.coefficients.tolist()))

    def distort(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Distort normalised points (n, 2); return them with d xy_d / d xy (n, 2, 2).

        Whether they are within `max_radius` is not checked.
        """
        points = _points(xy)
        if self.model == "none":
            return points.copy(), _identities(len(points))
        # Imported here: numba takes longer to import than most commands that never distort a point.
        from stereophd.core.geometry.compiled_lenses import distort_points

        return distort_points(self.code, self.coefficients, points)

    def undistort(self, xy_d: ArrayLike) -> tuple[Array, Array]:
        """Undistort normalised points (n, 2), by Newton's iteration to rounding; return them, d xy / d xy_d too.

        A row is NaN where there is no point within `max_radius`.
        """
        points = _points(xy_d)
        if self.model == "none":
            return points.copy(), _identities(len(points))
        from stereophd.core.geometry.compiled_lenses import undistort_points

        return undistort_points(self.code, self.coefficients, self.max_radius, points)


@lru_cache(maxsize=1000)
def _max_radius(model: str, coefficients: tuple[float, ...]) -> float:
    """Return the limit of a model; checks of a log try the same few lenses in turn for every camera."""
    return lens_models()[model].max_radius(np.array(coefficients))


def _points(values: ArrayLike) -> Array:
    """Return contiguous, writable float64 points (n, 2): one compiled specialisation for all callers."""
    points = np.require(values, dtype=np.float64, requirements=["C", "W"])
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"expected points of shape (n, 2), found {points.shape}")
    return points


def _identities(n: int) -> Array:
    return np.broadcast_to(np.eye(2), (n, 2, 2)).copy()
