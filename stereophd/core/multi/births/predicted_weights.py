"""Which of the predicted components are kept (compiled)."""

from __future__ import annotations

from stereophd.core.arrays import Array, Integers
from stereophd.core.disparity.moved import OUT_OF_VIEW
from stereophd.core.multi.births.visibility import fade_out_of_view
from stereophd.core.numerics.compilation.compiled import compiled

# Components from this weight or existence on get more samples where only a corner of them is in view.
IMPORTANT_WEIGHT = 0.1


@compiled
def keep_surviving_weights(
    weights: Array,
    status: Integers,
    inside: Array,
    means: Array,
    tracks: Integers,
    cameras: Integers,
    homes: Array,
    reach: Array,
    drift: Array,
    views: Array,
    camera: int,
    elapsed: float,
    time_constant: float,
) -> float:
    """Lessen the weights of moved components by what is lost, in place.

    Existence outside every view fades (`fade_out_of_view`). What lies outside the region is gone; what was never
    established (no identity, and light) and has left the view of the only camera that may have seen it is forgotten,
    or clutter would fill the world around the view.

    Parameters
    ----------
    weights : array (n,)
        Changed in place.
    status, inside, means, tracks, cameras : arrays
        Fields of `Moved`, and of the components before the move.
    homes, reach, drift, views, elapsed, time_constant
        The same as in `fade_out_of_view`.
    camera : int
        Index of the camera of the event.

    Returns
    -------
    float
        Sum of the weights.
    """
    fade_out_of_view(weights, status, means, homes, reach, drift, views, elapsed, time_constant)
    total = 0.0
    for k in range(len(weights)):
        unknown = tracks[k] < 0 and weights[k] < IMPORTANT_WEIGHT
        forgotten = unknown and status[k] == OUT_OF_VIEW and cameras[k] == camera
        weights[k] = 0.0 if forgotten else weights[k] * inside[k]
        total += weights[k]
    return total
