"""Boxes that are worse than the filter of bodies assumes, for `benchmarks/crowds.py`.

Errors of a box last, of hidden bodies boxes are missed for a while, end where the hiding body begins, are merged with
its box or suppressed by it, bodies have a second box, and in some places of the image a box comes up again and again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr

from stereophd.core.arrays import Array, Integers
from stereophd.core.bodies.boxes import share_in_image
from stereophd.core.bodies.occlusion import hidden_shares
from stereophd.core.bodies.outline import BOTTOM, LOG_AXES, STATE_SIZE, TOP, VELOCITY, WIDTH, U, outline_boxes
from stereophd.core.geometry.camera import Camera
from stereophd.core.simulation.boxes import SizedObjects
from stereophd.core.simulation.detections import Scene, SimulatedFrame

# Time for which errors, misses and cuts of the box of a body last, s.
LASTING_S = 0.7
# Standard deviation of (u, top, bottom, width), in heights of the box: what lasts, and what is new in each frame.
LASTING, FRESH = np.array([0.03, 0.03, 0.04, 0.06]), np.array([0.03, 0.025, 0.03, 0.05])
# How often a staying false box is seen, and what part of its height is its noise.
STAYING_DETECTED, STAYING_NOISE = 0.8, 0.03


@dataclass(frozen=True)
class Detector:
    """How poor a detector is."""

    noise: float  # Times `LASTING` and `FRESH`
    detected: float  # Probability of detection of a body that is seen whole
    hidden_loss: float  # As in `stereophd.core.bodies.shapes.ellipsoid.EllipsoidSettings`
    hidden_power: float
    cut: float  # Share of the boxes of bodies hidden whole that end where the hiding body begins
    merged: float  # Probability that the boxes of two bodies are one, where they overlap by `suppressed`
    suppressed: float  # Intersection over union above which the box of the farther body is suppressed
    doubled: float  # Probability of a second box
    clutter: float  # False boxes a frame anywhere
    staying: int  # False boxes that stay in their places


DETECTORS = {
    "good": Detector(0.8, 0.985, 0.5, 3.0, 0.3, 0.0, 0.8, 0.01, 0.1, 1),
    "weak": Detector(1.0, 0.97, 0.7, 2.5, 0.5, 0.1, 0.65, 0.03, 0.2, 2),
    "very_weak": Detector(1.4, 0.93, 0.85, 2.0, 0.7, 0.2, 0.5, 0.06, 0.3, 3),
}


@dataclass
class _View:
    """What lasts in the boxes of one camera."""

    errors: Array  # (k, 4): By the label of the body, standard normal
    luck: Array  # (k, 2): Of detection and of the cut, standard normal
    staying: Array  # (s, 4): Boxes
    time_s: float = field(default=-np.inf)

    def age(self, time_s: float, generator: np.random.Generator) -> None:
        """Let errors and luck change until a time."""
        kept = float(np.exp(-(time_s - self.time_s) / LASTING_S))
        for values in (self.errors, self.luck):
            values *= kept
            values += np.sqrt(1.0 - kept**2) * generator.standard_normal(values.shape)
        self.time_s = time_s


def poor_frames(scene: Scene, seed: np.random.SeedSequence, detector: Detector) -> Iterator[SimulatedFrame]:
    """Yield the frames of cameras of one time, in order of time, ties in camera order."""
    assert scene.sized is not None
    generators = [np.random.default_rng(child) for child in seed.spawn(len(scene.cameras))]
    sizes = scene.sized.log_axes.shape[0]
    views = [
        _View(np.zeros((sizes, 4)), np.zeros((sizes, 2)), _staying(camera, detector.staying, generator))
        for camera, generator in zip(scene.cameras, generators, strict=True)
    ]
    for window in scene.windows():
        numbers, times_s = scene.grid.frames[0].window(window.lower_s, window.upper_s)
        columns = np.searchsorted(window.times_s, times_s)
        for number, time_s, column in zip(numbers, times_s.tolist(), columns, strict=True):
            states = window.states[:, column]
            there = ~np.isnan(states[:, 0])
            for index, (camera, view, generator) in enumerate(zip(scene.cameras, views, generators, strict=True)):
                view.age(time_s, generator)
                values, labels = _draw(
                    camera, states[there], window.object_id[there], scene.sized, view, detector, generator
                )
                low = np.column_stack([values[:, U] - values[:, WIDTH] / 2.0, values[:, TOP]])
                high = np.column_stack([values[:, U] + values[:, WIDTH] / 2.0, values[:, BOTTOM]])
                edge = np.array([camera.width, camera.height]) - 0.5
                low, high = np.clip(low, -0.5, edge), np.clip(high, -0.5, edge)
                order = generator.permutation(np.flatnonzero(((high - low) >= 20.0).all(axis=1)))
                yield SimulatedFrame(
                    time_s, index, int(number), ((low + high) / 2.0)[order], labels[order], (high - low)[order]
                )


def _staying(camera: Camera, count: int, generator: np.random.Generator) -> Array:
    """Return false boxes (s, 4) that stay: of the size of a body, anywhere in the image."""
    height = camera.height * generator.uniform(0.15, 0.5, count)
    top = generator.uniform(0.1, 0.9, count) * (camera.height - height)
    u, width = generator.uniform(0.1, 0.9, count) * camera.width, height * generator.uniform(0.3, 0.6, count)
    return np.column_stack([u, top, top + height, width])


def _draw(
    camera: Camera, states: Array, labels: Integers, objects: SizedObjects, view: _View, detector: Detector,
    generator: np.random.Generator,
) -> tuple[Array, Integers]:  # fmt: skip
    """Return the boxes (m, 4) of one frame, and the labels (m,) of their bodies, -1 for false ones."""
    bodies = np.empty((len(states), STATE_SIZE))
    bodies[:, : VELOCITY.stop], bodies[:, LOG_AXES] = states, objects.log_axes[labels]
    boxes, _ = outline_boxes(bodies, camera, objects.shape.direction)
    none, all_there = np.zeros((len(bodies), STATE_SIZE, STATE_SIZE)), np.ones(len(bodies))
    hidden = hidden_shares(boxes, bodies, none, all_there, camera)
    heights = boxes[:, BOTTOM] - boxes[:, TOP]
    whole = np.minimum(share_in_image(boxes, camera) / 0.5, 1.0)
    probability = detector.detected * whole * (1.0 - detector.hidden_loss * hidden**detector.hidden_power)
    luck = ndtr(view.luck[labels])
    seen = np.flatnonzero(luck[:, 0] < probability)
    noise = LASTING * view.errors[labels] + FRESH * generator.standard_normal(boxes.shape)
    values = boxes + np.nan_to_num(heights)[:, None] * detector.noise * noise
    is_cut = luck[:, 1] < detector.cut * hidden
    values[:, BOTTOM] -= is_cut * hidden * heights * generator.uniform(0.7, 1.0, len(boxes))
    depths = camera.pose.to_camera(states[:, :3])[:, 2]
    seen = seen[np.argsort(depths[seen])]
    kept: list[int] = []
    for row in seen.tolist():
        over = [other for other in kept if _overlap(values[other], values[row]) > detector.suppressed]
        if not over:
            kept.append(row)
        elif generator.random() < detector.merged:
            values[over[0]] = _union(values[over[0]], values[row])
    out, names = [values[kept]], [labels[kept]]
    doubles = values[[row for row in kept if generator.random() < detector.doubled]]
    size = (doubles[:, BOTTOM] - doubles[:, TOP])[:, None]
    out.append(doubles + 0.15 * size * generator.standard_normal(doubles.shape))
    anywhere = _staying(camera, int(generator.poisson(detector.clutter)), generator)
    staying = view.staying[generator.random(len(view.staying)) < STAYING_DETECTED]
    size = (staying[:, BOTTOM] - staying[:, TOP])[:, None]
    out += [anywhere, staying + STAYING_NOISE * size * generator.standard_normal(staying.shape)]
    names.append(np.full(sum(len(part) for part in out[1:]), -1))
    return np.concatenate(out), np.concatenate(names)


def _corners(box: Array) -> tuple[float, float, float, float]:
    u, top, bottom, width = box.tolist()
    return u - width / 2.0, top, u + width / 2.0, bottom


def _overlap(one: Array, other: Array) -> float:
    """Return the intersection over the union of two boxes."""
    a, b = _corners(one), _corners(other)
    across, down = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    both = max(across, 0.0) * max(down, 0.0)
    return both / max((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both, 1e-9)


def _union(one: Array, other: Array) -> Array:
    """Return the box around two boxes."""
    a, b = _corners(one), _corners(other)
    left, top, right, bottom = min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])
    return np.array([(left + right) / 2.0, top, bottom, right - left])
