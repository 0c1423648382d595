"""Boxes of simulated bodies: noise, what other bodies hide, and false boxes."""

from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.bodies.boxes import box_variances, corners, share_in_image
from stereophd.core.bodies.outline import BOTTOM, LOG_AXES, STATE_SIZE, TOP, VELOCITY, WIDTH, U, outline_boxes
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.geometry.camera import Camera

# Share of the false boxes that are parts or doubles of the box of a body, and how far a double is moved and how small a
# part is, in extents of the box.
OF_BODIES, SHIFT, SMALLEST_PART = 0.5, 0.25, 0.3
# Height of the other false boxes over that of the image, and their width over their height.
HEIGHTS, ASPECTS = (0.03, 0.8), (0.2, 1.0)
# Smallest extent of a box that a detector reports, px.
SMALLEST_PX = 2.0


@dataclass(frozen=True)
class SizedObjects:
    """The shape of the objects of a scene, and their sizes."""

    shape: EllipsoidSettings
    log_axes: Array  # (k, 2): Logarithms of the half axes along and across the vertical, by the label of the object


def draw_boxes(
    camera: Camera, states: Array, labels: Integers, objects: SizedObjects, generator: np.random.Generator
) -> tuple[Array, Array, Integers]:
    """Draw the detections of one frame: the true ones of the objects that exist (states (n, 6)), and the false ones.

    Returns middles and sizes (m, 2), width and height, in distorted px, cut at the borders of the image, and labels
    (m,), -1 for a false box. The camera is that at the time of the frame.
    """
    from stereophd.core.bodies.occlusion import CUT_SHARE, detection_probabilities, hidden_shares  # costly to import

    bodies = np.empty((len(states), STATE_SIZE))
    bodies[:, : VELOCITY.stop], bodies[:, LOG_AXES] = states, objects.log_axes[labels]
    boxes, _ = outline_boxes(bodies, camera, objects.shape.direction)
    seen = share_in_image(boxes, camera)
    none = np.zeros((len(bodies), STATE_SIZE, STATE_SIZE))
    hidden = hidden_shares(boxes, bodies, none, np.ones(len(bodies)), camera)
    detected = generator.random(len(bodies)) < detection_probabilities(boxes, hidden, camera, objects.shape)
    heights = np.nan_to_num(boxes[:, BOTTOM] - boxes[:, TOP])
    std = np.sqrt(box_variances(heights, np.ones((len(boxes), 4)), np.asarray(camera.detector.box_noise)))
    noisy = boxes + std * generator.standard_normal(boxes.shape)
    cut = generator.random(len(bodies)) < CUT_SHARE * hidden
    noisy[:, BOTTOM] -= cut * hidden * heights * generator.random(len(bodies))
    false = _false_boxes(camera, boxes[seen > 0.0], generator)
    values = np.concatenate([noisy[detected], false])
    labels = np.concatenate([labels[detected], np.full(len(false), -1)])
    low, high = corners(values, camera)
    edge = np.array([camera.width, camera.height]) - 0.5
    low, high = np.clip(low, -0.5, edge), np.clip(high, -0.5, edge)
    kept = ((high - low) >= SMALLEST_PX).all(axis=1)
    return ((low + high) / 2.0)[kept], (high - low)[kept], labels[kept]


def _false_boxes(camera: Camera, boxes: Array, generator: np.random.Generator) -> Array:
    """Return false boxes (f, 4): parts and doubles of those of bodies, and others anywhere in the image."""
    count = int(generator.poisson(camera.detector.clutter_per_frame))
    out = np.empty((count, 4))
    for row in range(count):
        if len(boxes) and generator.random() < OF_BODIES:
            u, top, bottom, width = boxes[generator.integers(len(boxes))]
            height = bottom - top
            if generator.random() < 0.5:
                part = generator.uniform(SMALLEST_PART, 1.0)
                upper = generator.random() < 0.5
                top, bottom = (top, top + part * height) if upper else (bottom - part * height, bottom)
            else:
                u, shift = u + SHIFT * width * generator.standard_normal(), SHIFT * height * generator.standard_normal()
                top, bottom = top + shift, bottom + shift
        else:
            height = camera.height * float(np.exp(generator.uniform(*np.log(HEIGHTS))))
            width = height * generator.uniform(*ASPECTS)
            u, top = generator.uniform(0.0, camera.width), generator.uniform(0.0, camera.height) - height / 2.0
            bottom = top + height
        out[row, [U, TOP, BOTTOM, WIDTH]] = u, top, bottom, width
    return out
