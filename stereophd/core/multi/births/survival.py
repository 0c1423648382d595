"""Which of the predicted components are kept, and existence outside every view (compiled; ours).

A camera that looks at an object and misses it makes its existence less probable. Nothing does so while no camera looks:
a false track that drifted out of all views would live on with the survival of an object for which there is evidence,
and be reported. Its existence therefore fades there with a time constant; an object that comes back
within that time is detected again under its identity.
"""

import math

from stereophd.core.arrays import Array
from stereophd.core.disparity.moved import OUT_OF_VIEW, Moved
from stereophd.core.disparity.trips import disparity_scale
from stereophd.core.geometry.compiled_lenses import pixel_in_view
from stereophd.core.geometry.layout import CENTER, CX, CY, FX, FY, ROTATION
from stereophd.core.motion.arrays import MotionArrays
from stereophd.core.multi.state.inputs import EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.numerics.compilation.compiled import compiled


@compiled
def _mean_in_view(mean: Array, home: Array, reach: float, drift: Array, views: Array) -> bool:
    """Whether any camera has the mean (d,) in view after the motion (`reach` and `drift` of `MotionArrays`)."""
    # position and its displacement, both times rho: points at infinity have a direction
    rho = mean[2] / disparity_scale(home)
    ray_x, ray_y, ray_z = (mean[0] - home[CX]) / home[FX], (mean[1] - home[CY]) / home[FY], 1.0
    if len(mean) == 6 and rho > 0.0:
        growth = mean[5] / mean[2]
        ray_x += reach * (mean[3] / home[FX] - ray_x * growth)
        ray_y += reach * (mean[4] / home[FY] - ray_y * growth)
        ray_z -= reach * growth
    for c in range(len(views)):
        view = views[c]
        x, y, z = 0.0, 0.0, 0.0
        for a in range(3):
            # the world's axis a: from the home camera's axes, and from the one camera to the other
            world = home[ROTATION + a] * ray_x + home[ROTATION + 3 + a] * ray_y + home[ROTATION + 6 + a] * ray_z
            world += rho * (home[CENTER + a] + drift[a] - view[CENTER + a])
            x += view[ROTATION + a] * world
            y += view[ROTATION + 3 + a] * world
            z += view[ROTATION + 6 + a] * world
        if z > 0.0 and pixel_in_view(view, view[FX] * x / z + view[CX], view[FY] * y / z + view[CY]):
            return True
    return False


# Components from this weight or existence on get more samples where only a corner of them is in view.
IMPORTANT_WEIGHT = 0.1


@compiled
def keep_surviving_weights(
    weights: Array,
    mixture: GaussianMixture,
    moved: Moved,
    homes: Array,
    motion: MotionArrays,
    views: Array,
    numbers: EventNumbers,
) -> float:
    """Lessen the weights (n,) of moved components by what is lost, in place; return their sum.

    Existence outside every view is multiplied by ``exp(-elapsed / out_of_view_s)`` of the event: where its camera has
    too little of a component in view and no camera has its mean in view, moved on to the time of the event. What
    lies outside the region is gone; what was never established (no identity, and light) and has left the view of the
    only camera that may have seen it is forgotten, or clutter would fill the world around the view. The mixture is that
    before the move, in packed `homes` (n, 30), and `views` (c, 30) are the packed spaces of all cameras at the event.
    With an infinite time constant nothing fades.
    """
    _, means, _, cameras, _, _, tracks, _ = mixture
    status, inside, reach, drift = moved.status, moved.inside, motion.reach, motion.drift
    camera, elapsed, time_constant = numbers.camera, numbers.elapsed, numbers.out_of_view_s
    total = 0.0
    fading = 1.0 if elapsed <= 0.0 or math.isinf(time_constant) else math.exp(-elapsed / time_constant)
    for k in range(len(weights)):
        out_of_view = status[k] == OUT_OF_VIEW
        if out_of_view and fading < 1.0 and not _mean_in_view(means[k], homes[k], reach[k], drift[k], views):
            weights[k] *= fading
        unknown = tracks[k] < 0 and weights[k] < IMPORTANT_WEIGHT
        forgotten = unknown and out_of_view and cameras[k] == camera
        weights[k] = 0.0 if forgotten else weights[k] * inside[k]
        total += weights[k]
    return total
