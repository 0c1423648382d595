"""Size and ground of the objects of a log of boxes.

Boxes of two cameras at one time are those of one object where their rays meet and both give it one height: the height
over the depth is that of the box over the focal length. By chance they do so at any height. The height at which far
more pairs agree than with frames of other times is that of the objects. Where the middles of such pairs lie in a plane,
the objects stand on the ground, and their height is along its normal. A run of the filter with a wide prior then gives
the sizes of its tracks.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array, Booleans
from stereophd.core.bodies.boxes import Boxes, box_middles, boxes_of
from stereophd.core.bodies.outline import BOTTOM, TOP, WIDTH
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.random_streams import GROUND_SEED
from stereophd.core.two_views.epipolar import nearest_depths
from stereophd.pipeline.build import build_bodies
from stereophd.pipeline.initial.template import Choice, rounded
from stereophd.pipeline.tracking.loop import run_estimator

# Frames of each camera that are paired, and pairs from which a size is estimated.
MOST_FRAMES, LEAST_PAIRS = 60, 30
# Smaller boxes, px, tell no depth: objects that make them are points.
SMALLEST_PX = 20.0
# How far the rays of a pair may miss each other, in heights, and how far its two heights may differ (logarithm).
MISSING, DIFFERING = 0.25, 0.25
# Half of the window of heights (logarithm) that is one size.
WINDOW = 0.2
# Half thickness of the plane of the middles, in heights, the share of the pairs that must lie in it, how far they must
# spread along it, in heights, and the planes that are tried.
THICKNESS, LEAST_IN_PLANE, LEAST_SPREAD, PLANES = 0.12, 0.6, 0.5, 300
# Most worlds have an axis that is upright: it is the normal of a plane within this angle of it.
AXIS_DEG = 5.0
# Prior spreads of the first run, and of sizes that few tracks show, as parts of the size; and the ground's, as parts of
# the height.
WIDE, USUAL, LEAST, GROUND, WIDE_GROUND = 0.12, 0.08, 0.04, 0.035, 0.06
# Speeds and accelerations to begin with, in heights per second (squared).
SPEED, ACCELERATION = 0.5, 0.5
# Estimates of the shortest track whose size counts.
LEAST_ESTIMATES = 10


@dataclass(frozen=True)
class Bodies:
    """What the boxes of a log show of the objects; lengths."""

    height: tuple[float, float]  # Mean and standard deviation over the objects
    width: tuple[float, float]
    up: Array | None  # (3,): None: the cameras do not agree on one, objects are spheres
    ground: Array | None  # (3,): A point of the plane on which they stand; None: nothing stands
    ground_std: float
    source: str

    def choices(self, unit: str) -> dict[str, Choice]:
        """Return the section ``object``, and settings from the size of the objects, wide enough to track with."""

        def extent(values: tuple[float, float]) -> dict[str, float]:
            return {"mean": rounded(values[0], 3), "std": rounded(values[1])}

        height, why = self.height[0], "from the height of the objects, not from their motion"
        out = {
            "filter.birth.velocity_std": Choice(rounded(SPEED * height), f"{why}; {unit}/s"),
            "motion.acceleration_std": Choice(rounded(ACCELERATION * height), f"{why}; {unit}/s^2"),
            "evaluation.cutoff": Choice(rounded(0.5 * height, 1), "half the height of the objects"),
            "object.shape": Choice("ellipsoid", "the detections are boxes; point takes their middles alone"),
            "object.height": Choice(extent(self.height), f"{self.source}; {unit}"),
        }
        if self.up is not None:
            out["object.width"] = Choice(extent(self.width), f"{self.source}; {unit}")
            what = "normal to the ground" if self.ground is not None else "the mean of the cameras' upright directions"
            out["object.up"] = Choice([round(float(value), 4) + 0.0 for value in self.up], what)
        if self.ground is not None:
            point = {"point": [rounded(float(value), 4) for value in self.ground], "std": rounded(self.ground_std)}
            out["object.ground"] = Choice(point, "the plane on which they stand: from their middles and heights")
        else:
            out["object.ground"] = Choice(None, "the middles of the objects lie in no plane: nothing stands")
        return out


def measure_bodies(cameras: Sequence[Camera], parts: Sequence[Sequence[Event]]) -> Bodies | None:
    """Return size and ground from pairs of boxes; None where not every detection has a box, or too few pairs agree."""
    frames: list[list[tuple[float, Boxes, Camera]]] = [[] for _ in cameras]
    for event in (event for part in parts for event in part):
        if event.sizes is None or np.isnan(event.sizes).any():
            return None
        camera = cameras[event.camera].at(event.time_s)
        boxes = boxes_of(event, camera)
        whole = np.flatnonzero(~boxes.hidden.any(axis=1))
        frames[event.camera].append((event.time_s, boxes.take(whole), camera))
    heights = np.concatenate(
        [boxes.values[:, BOTTOM] - boxes.values[:, TOP] for rows in frames for _, boxes, _ in rows]
    )
    if len(cameras) < 2 or not len(heights) or np.median(heights) < SMALLEST_PX:
        return None
    together, chance = (
        np.concatenate([_pairs(frames[a], frames[b], shift) for a, b in combinations(range(len(cameras)), 2)])
        for shift in (0.0, 0.5)
    )
    if len(together) < LEAST_PAIRS:
        return None
    steps = np.arange(together[:, 3].min(), together[:, 3].max() + 0.05, 0.05)
    gains = [_near(together, middle).sum() - _near(chance, middle).sum() for middle in steps]
    middle = float(steps[int(np.argmax(gains))])
    if max(gains) < LEAST_PAIRS:
        return None
    size = together[_near(together, middle)]
    height, width = float(np.exp(np.median(size[:, 3]))), float(np.exp(np.median(size[:, 4])))
    source = f"from {len(size)} pairs of boxes of two cameras"
    upright = np.mean([-camera.at(0.0).pose.rotation[1] for camera in cameras], axis=0)
    up = upright / np.linalg.norm(upright) if np.linalg.norm(upright) > 0.5 else None
    plane = _plane(size[:, :3], height, up, max(gains) / len(size))
    if plane is not None:
        middle_point, up = plane
        ground = middle_point - height / 2.0 * up
        return Bodies((height, WIDE * height), (width, WIDE * width), up, ground, WIDE_GROUND * height, source)
    if up is None:
        height = float(np.sqrt(height * width))
    return Bodies((height, WIDE * height), (width, WIDE * width), up, None, 0.0, source)


def _near(pairs: Array, middle: float) -> Booleans:
    return np.asarray(np.abs(pairs[:, 3] - middle) < WINDOW)


def _pairs(
    first: Sequence[tuple[float, Boxes, Camera]], second: Sequence[tuple[float, Boxes, Camera]], shift: float
) -> Array:
    """Return middles and logarithms of height and width (k, 5) of pairs of boxes that agree.

    Frames of the second camera are those nearest in time, or with a `shift` those so many shares of the log later.
    """
    out = [np.empty((0, 5))]
    if not first or not second:
        return out[0]
    times = np.array([row[0] for row in second])
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    chosen = np.unique(np.linspace(0, len(first) - 1, min(len(first), MOST_FRAMES)).astype(int))
    for time_s, boxes, camera in (first[k] for k in chosen.tolist()):
        number = int(np.argmin(np.abs(times - time_s)))
        if abs(times[number] - time_s) > 0.6 * interval:
            continue
        _, others, other = second[(number + int(shift * len(second))) % len(second)]
        out.append(_meeting(boxes, camera, others, other))
    return np.concatenate(out)


def _meeting(boxes: Boxes, camera: Camera, others: Boxes, other: Camera) -> Array:
    """Return the pairs (k, 5) of two frames whose rays meet and whose heights agree, as `_pairs`."""
    a = (camera.pinhole_rays(box_middles(boxes.values)) @ camera.pose.rotation)[:, None]
    b = (other.pinhole_rays(box_middles(others.values)) @ other.pose.rotation)[None]
    near, far, _ = nearest_depths(a, b, other.pose.center - camera.pose.center)
    with np.errstate(all="ignore"):
        sizes = [
            np.log(np.stack([(v[:, BOTTOM] - v[:, TOP]) / frozen.fy, v[:, WIDTH] / frozen.fx]))
            for v, frozen in ((boxes.values, camera), (others.values, other))
        ]
        one, two = sizes[0][:, :, None] + np.log(near), sizes[1][:, None, :] + np.log(far)
        logs = (one + two) / 2.0
        places = camera.pose.center + near[..., None] * a, other.pose.center + far[..., None] * b
        gap = np.linalg.norm(places[0] - places[1], axis=-1)
        agree = (np.abs(one[0] - two[0]) < DIFFERING) & (gap < MISSING * np.exp(logs[0])) & (near > 0.0) & (far > 0.0)
    middles = (places[0] + places[1])[agree] / 2.0
    return np.column_stack([middles, logs[0][agree], logs[1][agree]])


def _plane(places: Array, height: float, up: Array | None, true_share: float) -> tuple[Array, Array] | None:
    """Return a point of the plane of the middles and its upward normal; None where they lie in none."""
    generator = np.random.default_rng(GROUND_SEED)
    best: Booleans = np.zeros(len(places), dtype=np.bool_)
    normals = [] if up is None else [up]
    for _ in range(PLANES):
        one, two, three = places[generator.choice(len(places), 3, replace=False)]
        normal = np.cross(two - one, three - one)
        if np.linalg.norm(normal) > (LEAST_SPREAD * height) ** 2:
            normals.append(normal / np.linalg.norm(normal))
    for normal in normals:
        heights = places @ normal
        inside = np.abs(heights - np.median(heights)) < THICKNESS * height
        best = inside if inside.sum() > best.sum() else best
    if best.sum() < LEAST_IN_PLANE * true_share * len(places):
        return None
    middle = places[best].mean(axis=0)
    _, spread, axes = np.linalg.svd(places[best] - middle, full_matrices=False)
    normal = axes[2]
    if spread[1] / np.sqrt(best.sum()) < LEAST_SPREAD * height:
        # along a line, or in one place: the cameras are upright
        if up is None:
            return None
        normal = up
    if up is not None and normal @ up < 0.0:
        normal = -normal
    axis = np.round(normal)
    return middle, axis if normal @ axis > math.cos(math.radians(AXIS_DEG)) else normal


def refine_bodies(
    bodies: Bodies, loaded: LoadedConfig, cameras: tuple[Camera, ...], parts: Sequence[Sequence[Event]]
) -> Bodies:
    """Return sizes and ground from the tracks of a run with those of `bodies`; the same where there are few tracks."""
    sizes: dict[tuple[int, int], list[Array]] = {}
    for number, part in enumerate(parts):
        for record in run_estimator(build_bodies(loaded.config, cameras, loaded.path), part):
            found = record.estimates
            assert found.extents is not None
            for track, state, extents in zip(found.track_ids.tolist(), found.states, found.extents, strict=True):
                sizes.setdefault((number, track), []).append(np.append(extents, state[:3]))
    tracks = [np.array(rows) for rows in sizes.values() if len(rows) >= LEAST_ESTIMATES * len(cameras)]
    if not tracks:
        return bodies
    last, counts = np.array([rows[-1] for rows in tracks]), np.array([len(rows) for rows in tracks])
    height, width = _moments(last[:, 0], last[:, 2], counts), _moments(last[:, 1], last[:, 3], counts)
    ground = bodies.ground
    if ground is not None and bodies.up is not None:
        every = np.concatenate(tracks)
        lowest = every[:, 4:] @ bodies.up - every[:, 0] / 2.0
        ground = ground + bodies.up * (float(np.median(lowest)) - ground @ bodies.up)
    return Bodies(height, width, bodies.up, ground, GROUND * height[0], f"from the sizes of {len(tracks)} tracks")


def _moments(values: Array, errors: Array, counts: Array) -> tuple[float, float]:
    """Mean and standard deviation of a size over objects, of values (n,) with errors (n,), of so many estimates."""
    weights = counts / (errors**2 + (USUAL * values) ** 2)
    mean = float(weights @ values / weights.sum())
    if len(values) < 5:
        return mean, USUAL * mean
    variance = float(weights @ ((values - mean) ** 2 - errors**2) / weights.sum())
    return mean, float(np.sqrt(max(variance, (LEAST * mean) ** 2)))
