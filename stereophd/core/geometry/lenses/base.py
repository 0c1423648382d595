"""Lens models: their common interface and shared functions. `stereophd.core.geometry.compiled_lenses` inverts them."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from numpy.typing import ArrayLike

from stereophd.core.arrays import Array
from stereophd.core.settings import FINITE

#: A coefficient of a lens, without unit.
Coefficient = Annotated[float, Interval(ge=-1e6, le=1e6), FINITE]

# max_radius stays this fraction inside the fold, where the inverse has a finite Jacobian and the
# rounding of a polynomial root does not matter.
FOLD_MARGIN = 1e-9
# A fold at a squared radius beyond this is 89.9999 degrees off the axis: it does not count as one.
ROOT_LIMIT = 1e12


@dataclass(frozen=True)
class LensModel:
    """A lens model."""

    # Its `stereophd.core.settings.settings`: ``model``, and its coefficients in the order in which compiled kernels
    # read them. Their names are among those of `stereophd.core.geometry.lens.Lens`.
    settings: type[Any]
    code: int  # Its number in compiled kernels (`stereophd.core.geometry.layout`)
    # From the coefficients (8,) to the largest undistorted radius up to which the radial map r -> r_d increases; inf
    # if it always does.
    max_radius: Callable[[Array], float]

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the coefficients, in order."""
        return tuple(field.name for field in fields(self.settings) if field.name != "model")


def smallest_positive_root(polynomial: ArrayLike) -> float:
    """Return the smallest positive root of a polynomial (highest power first, last coefficient 1).

    Roots beyond ROOT_LIMIT count as none, and none is inf.
    """
    # The reciprocals of the roots are those of the reversed polynomial, which is monic: tiny leading
    # coefficients, whose rounding would hide the wanted root here, are tiny last ones there and have no effect.
    roots = np.roots(np.asarray(polynomial, dtype=np.float64)[::-1])
    # A double root comes out as a pair with a small imaginary part: there the slope is zero, so it counts.
    is_real = np.abs(roots.imag) <= 1e-7 * np.abs(roots)
    reciprocals = roots.real[is_real & (roots.real > 1.0 / ROOT_LIMIT)]
    return 1.0 / float(reciprocals.max()) if len(reciprocals) else math.inf
