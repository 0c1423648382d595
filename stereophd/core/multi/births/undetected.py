"""Expected number of objects that no camera has detected yet: births per second, and those present at the start (ours).

Objects appear at a rate b in the view of every camera, and a camera that looks detects each of those in its view with
probability p_D. Among the n_k undetected objects in the view of camera k, a frame of camera c leaves

    n_k (1 - p_D o_kc),

where o_kc is the share of the objects in view of k that are in view of c as well. Between events n_k grows by b times
the elapsed time. So each object is born once, for any frame rates and any number of cameras: a single camera with p_D
near 1 expects b times the time since its last frame, and cameras that look at one place share this number.

After a pause, and where a camera starts late, b times the elapsed time may be many more objects than the frame shows.
An expectation above one is therefore limited to the detections beyond clutter and known objects, and one standard
deviation more (`room_for`): with thousands of expected births every false detection would be an object.

A frame with far more detections than objects can make (`burst_of`) is no evidence of new objects: its surplus is
clutter.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event, Rig
from stereophd.core.disparity.initial import FirstSight
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.multi.filter_settings.common import BirthPrior

Reduction = TypeVar("Reduction", bound=NamedTuple)

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
# In a crowd of more than this number of components for each expected object it is `CROWD_SHARE` of that weight.
CROWDED = 1.25
CROWD_SHARE = 0.5


@dataclass(frozen=True)
class Undetected:
    """Objects never detected so far."""

    counts: Array  # (c,): Expected number in the view of each camera, of those that appeared since the start
    # (c,): Share of the objects in view of a camera at the start that the others left; 0 once the camera has had a
    # frame.
    initial_share: Array
    # (c,): Largest expected number in the view of each camera at an event since its own last frame; 0 if there was
    # none.
    peaks: Array


def burst_of(event: Event, known: float, prior: BirthPrior) -> int:
    """Return the detections of a frame beyond those of known objects where they are a burst of clutter, else 0.

    `known` is the expected number of detections of known objects; up to the prior's `max_per_frame` is no burst.
    """
    surplus = len(event.points) - known
    return math.ceil(surplus) if surplus > prior.max_per_frame else 0


def room_for(event: Event, known: float, detector: Detector) -> float:
    """Return how many undetected objects the detections of a frame allow, at least `UNCHECKED_BIRTHS`.

    `known` is the expected number of detections of known objects; the detector is that of the event's camera.
    """
    count = len(event.points)
    surplus = count - detector.clutter_per_frame - known + math.sqrt(count)
    return max(surplus / max(detector.p_detect, 1e-9), UNCHECKED_BIRTHS)


def expected_births(
    before: Undetected | None,
    prior: BirthPrior,
    remaining: Array,
    elapsed: float,
    event: Event,
    detector: Detector,
    burst: int = 0,
    known: float = 0.0,
) -> tuple[float, Undetected]:
    """Expected number of undetected objects in view of an event, and what the event leaves of them.

    `before` is what the last event left (None before the first), `elapsed` the time since then, s. `remaining` (c,), a
    column of `undetected_shares`, has for each camera the share of the objects in its view that the frame leaves. The
    detector is that of the event's camera; `known` is the expected number of detections of known objects. Nothing is
    born from a burst of clutter (`burst_of` the event), and the objects remain undetected.
    """
    before = before or Undetected(np.zeros(len(remaining)), np.ones(len(remaining)), np.zeros(len(remaining)))
    counts, share = before.counts + prior.per_s * elapsed, before.initial_share
    if burst:
        return 0.0, Undetected(counts, share, before.peaks)
    initial = 0.0
    if share[event.camera] > 0.0:
        initial = _initial(event, prior, detector) * float(share[event.camera])
        share = share.copy()
        share[event.camera] = 0.0
    if counts[event.camera] > UNCHECKED_BIRTHS:
        room = max(room_for(event, known, detector) - initial, UNCHECKED_BIRTHS)
        counts[event.camera] = min(float(counts[event.camera]), room)
    counts[event.camera] += initial
    peaks = np.maximum(before.peaks, counts)
    peaks[event.camera] = 0.0
    return float(counts[event.camera]), Undetected(counts * remaining, share * remaining, peaks)


def _initial(event: Event, prior: BirthPrior, detector: Detector) -> float:
    """Return the number of objects in view at the first frame: as stated, or from the detections of that frame."""
    if prior.initial is not None:
        return float(prior.initial)
    surplus = len(event.points) - detector.clutter_per_frame
    return max(surplus / max(detector.p_detect, 1e-9), LEAST_INITIAL)


def reduction_for_births(reduction: Reduction, births: float, detector: Detector) -> Reduction:
    """Return settings of a reduction whose `prune_weight` is the stated one, or less where newborns are light."""
    values: Any = reduction
    born = detector.p_detect * births
    if born <= 0.0:
        return reduction
    newborn = born / (born + detector.clutter_per_frame)
    weight = max(NEWBORN_SHARE * newborn, LEAST_PRUNING * values.prune_weight)
    if weight >= values.prune_weight:
        return reduction
    return cast("Reduction", values._replace(prune_weight=weight))


def peak_births(before: Undetected | None, births: float, camera: int) -> float:
    """Return the largest number of undetected objects expected in view of a camera since its last frame.

    Of cameras that take their frames at one time the first expects all new objects, and the last next to none. `before`
    is what the last event left; `births` is the expected number at the event, a frame of this camera.
    """
    return births if before is None else max(births, float(before.peaks[camera]))


def reduction_in_crowd(reduction: Reduction, births: float, detector: Detector, weights: Array) -> Reduction:
    """Return settings of a reduction of thousands of components, with a `prune_weight` that ends what will not grow.

    It is at least `NEWBORN_SHARE` of the weight of a newborn, and `CROWD_SHARE` where components are more than
    `CROWDED` for each expected object, but no more than `recycle_below`. What is lighter tells less than the next
    detection of a new object will. Among thousands of detections it would never end: each event shares it out among
    those that are near by chance, and every share is another component.

    `births` is `peak_births` of the camera; weights (n,) are those of the components before the event.
    """
    values: Any = reduction
    born = detector.p_detect * births
    if born <= 0.0:
        return reduction
    share = CROWD_SHARE if len(weights) > CROWDED * float(weights.sum()) else NEWBORN_SHARE
    weight = min(share * born / (born + detector.clutter_per_frame), values.recycle_below)
    return cast("Reduction", values._replace(prune_weight=max(values.prune_weight, weight)))


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
