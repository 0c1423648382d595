"""Which of the predicted components are kept (compiled)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereophd.core.disparity.moved import OUT_OF_VIEW
from stereophd.core.numerics.compilation import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

# Components from this weight or existence on get more samples where only a corner of them is in view.
IMPORTANT_WEIGHT = 0.1


@compiled
def surviving_weights(
    weights: Array, tracks: Integers, cameras: Integers, status: Integers, inside: Array, camera: int
) -> Array:
    """Weights (n,) of moved components without what is lost.

    What lies outside the region is gone; what was never established (no identity, and light) and has left the view of
    the only camera that may have seen it is forgotten, or clutter would fill the world around the view.
    """
    out = weights * inside
    for k in range(len(weights)):
        unknown = tracks[k] < 0 and weights[k] < IMPORTANT_WEIGHT
        if unknown and status[k] == OUT_OF_VIEW and cameras[k] == camera:
            out[k] = 0.0
    return out
