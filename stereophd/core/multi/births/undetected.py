"""Expected number of objects that no camera has detected yet: births per second, and those present at the start (ours).

Objects appear at a rate b in the view of every camera, and a camera that looks detects each of those in its view with
probability p_D. Among the n_k undetected objects in the view of camera k, a frame of camera c leaves

    n_k (1 - p_D o_kc),

where o_kc is the share of the objects in view of k that are in view of c as well. Between events n_k grows by b times
the elapsed time. So each object is born once, for any frame rates and any number of cameras: a single camera with p_D
near 1 expects b times the time since its last frame, and cameras that look at one place share this number.

After a pause, and where a camera starts late, b times the elapsed time may be many more objects than the frame shows.
An expectation above one is therefore limited to the detections beyond clutter and known objects, and one standard
deviation more: with thousands of expected births every false detection would be an object.

A frame with far more detections than objects can make is no evidence of new objects: its surplus is clutter.
"""

import math
from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Rig
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.state.inputs import EventNumbers
from stereophd.core.numerics.compilation.compiled import compiled

# Places in the image (across, down) and quantiles of the disparity that measure how far views overlap.
OVERLAP_GRID = (12, 9)
OVERLAP_DISPARITIES = 8
# An expected number up to this one is not compared with the detections of the frame.
UNCHECKED_BIRTHS = 1.0
# Fewest objects at the start where their number is estimated: the first frame may have missed some.
LEAST_INITIAL = 0.1
# The pruning weight is at most NEWBORN_SHARE of the weight of a newborn, which is small at high frame rates, and at
# least LEAST_PRUNING times the pruning weight of the settings.
NEWBORN_SHARE = 0.1
LEAST_PRUNING = 1e-3


class Undetected(NamedTuple):
    """Objects never detected so far."""

    counts: Array  # (c,): Expected number in the view of each camera, of those that appeared since the start
    # (c,): Share of the objects in view of a camera at the start that the others left; 0 once the camera has had a
    # frame.
    initial_share: Array


def all_undetected(cameras: int) -> Undetected:
    """Return what so many cameras have not detected before the first event."""
    return Undetected(np.zeros(cameras), np.ones(cameras))


def birth_rates(prior: BirthPrior) -> tuple[float, float, float]:
    """Return per_s, initial (NaN: the detections of the first frame say) and max_per_frame of a prior."""
    initial = math.nan if prior.initial is None else float(prior.initial)
    return float(prior.per_s), initial, float(prior.max_per_frame)


@compiled
def expected_births(
    before: Undetected, rates: tuple[float, float, float], remaining: Array, numbers: EventNumbers, known: float
) -> tuple[float, Undetected, int]:
    """Expected number of undetected objects in view of an event, what the event leaves of them, and its burst.

    `before` is what the last event left, and the rates are `birth_rates`. `remaining` (c,), a column of
    `undetected_shares`, has for each camera the share of the objects in its view that the frame leaves. `known` is the
    expected number of detections of known objects. What is beyond them by more than `max_per_frame` is a burst of
    clutter, the number of these detections, else 0; nothing is born from it, and the objects remain undetected.
    """
    per_s, initial, max_per_frame = rates
    camera, n_detections, p_detect, clutter = numbers.camera, numbers.n_detections, numbers.p_detect, numbers.clutter
    after = Undetected(before.counts + per_s * numbers.elapsed, before.initial_share.copy())
    counts, share = after
    if n_detections - known > max_per_frame:
        return 0.0, after, math.ceil(n_detections - known)
    if math.isnan(initial):
        initial = max((n_detections - clutter) / max(p_detect, 1e-9), LEAST_INITIAL)
    initial *= share[camera]
    share[camera] = 0.0
    if counts[camera] > UNCHECKED_BIRTHS:
        surplus = n_detections - clutter - known + math.sqrt(n_detections)
        room = max(surplus / max(p_detect, 1e-9), UNCHECKED_BIRTHS)
        counts[camera] = min(counts[camera], max(room - initial, UNCHECKED_BIRTHS))
    counts[camera] += initial
    births = counts[camera]
    for c in range(len(counts)):
        counts[c] *= remaining[c]
        share[c] *= remaining[c]
    return births, after, 0


@compiled
def prune_weight_for_births(stated: float, births: float, p_detect: float, clutter: float) -> float:
    """Return the pruning weight of a reduction: the stated one, or less where newborns are light.

    What is lighter tells less than the next detection of a new object will.
    """
    born = p_detect * births
    if born <= 0.0:
        return stated
    return min(max(NEWBORN_SHARE * (born / (born + clutter)), LEAST_PRUNING * stated), stated)


def undetected_shares(rig: Rig, prior: BirthPrior) -> Array:
    """Return the share (c, c) of the objects in view of each camera (row) that a frame of each one (column) leaves.

    Objects are uniform over the image, with the prior's disparity.
    """
    quantiles = (np.arange(OVERLAP_DISPARITIES) + 0.5) / OVERLAP_DISPARITIES
    normal = np.array([NormalDist().inv_cdf(float(q)) for q in quantiles])

    def places(camera: Camera) -> Array:
        space = DisparitySpace(camera, rig.baseline, rig.rectification)
        mean, std = prior.disparity_moments(space.packed())
        disparities = (mean + std * normal)[mean + std * normal > 0.0]
        pixels = np.repeat(pixel_grid(camera), len(disparities), axis=0)
        depths = space.disparity_focal * rig.baseline / disparities
        return camera.unproject(pixels, np.tile(depths, len(pixels) // max(len(depths), 1)))

    return shares_left(rig.cameras, places)


def shares_left(cameras: Sequence[Camera], places: Callable[[Camera], Array]) -> Array:
    """Return the share (c, c) of the objects in view of each camera (row) that a frame of each one (column) leaves.

    `places` returns where objects in view of a camera may be, (n, 3), at time 0; rows that are not finite do not count.
    """
    frozen = [camera.at(0.0) for camera in cameras]
    overlap = np.eye(len(frozen))
    for k, camera in enumerate(frozen):
        seen = places(camera)
        seen = seen[np.isfinite(seen).all(axis=1)]
        for c, other in enumerate(frozen):
            if c != k and len(seen):
                overlap[k, c] = float(np.mean(other.in_view(seen)))
    return np.asarray(1.0 - overlap * np.array([camera.detector.p_detect for camera in cameras]))


def pixel_grid(camera: Camera) -> Array:
    """Return places (n, 2) spread evenly over the image of a camera, px."""
    across, down = OVERLAP_GRID
    u = (np.arange(across) + 0.5) / across * camera.width - 0.5
    v = (np.arange(down) + 0.5) / down * camera.height - 0.5
    return np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)


def newborn_prior(space: Array, prior: BirthPrior, region: Array | None) -> FirstSight:
    """Return the prior of the objects that the camera of a packed space (30,) sees for the first time."""
    mean, std = prior.disparity_moments(space)
    limits = np.empty(0) if region is None else region
    return FirstSight(space, float(mean), float(std), float(prior.velocity_std), limits)
