"""Where the rays of two cameras come nearest to each other."""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array

# Rays are parallel at a sine of their angle below the root of this: their depths are cut off.
LEAST_SQUARED_SINE = 1e-12


def nearest_depths(rays_a: Array, rays_b: Array, between: Array) -> tuple[Array, Array, Array]:
    """Depths (...,) along both rays where they come nearest to each other, and the sine (...,) of their angle.

    Rays (..., 3) are in the axes of the world, and a depth is in units of their lengths, so that it is the depth before
    the camera where the third component in the camera's axes is 1. `between` (..., 3) is the centre of the second
    camera less that of the first.
    """
    aa, bb, ab, da, db = (
        np.einsum("...i,...i->...", one, other)
        for one, other in (
            (rays_a, rays_a), (rays_b, rays_b), (rays_a, rays_b), (rays_a, between), (rays_b, between),
        )
    )  # fmt: skip
    determinant = np.maximum(aa * bb - ab**2, LEAST_SQUARED_SINE * aa * bb)
    with np.errstate(invalid="ignore"):
        return (
            (da * bb - db * ab) / determinant,
            (da * ab - db * aa) / determinant,
            np.sqrt(determinant / (aa * bb)),
        )
