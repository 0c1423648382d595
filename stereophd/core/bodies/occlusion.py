"""Bodies that hide one another in an image, and that exclude one another in space."""

import numpy as np
from scipy.special import ndtr

from stereophd.core.arrays import Array, Booleans, Integers
from stereophd.core.bodies.boxes import WHOLE_SHARE, share_in_image
from stereophd.core.bodies.outline import BOTTOM, LOG_AXES, POSITION, TOP, WIDTH, U
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.geometry.camera import Camera

# Two bodies do not come closer, across the vertical, than this share of the sum of their half widths.
CLOSEST = 0.5
# Nor does one that has not been reported appear this close to one that has: it would have been seen on its way.
CLOSEST_NEW = 1.0
# Of the boxes of bodies that are hidden whole, this share ends where the hiding body begins, and in proportion of
# those that are hidden in part: detectors that were not trained on crowds report what they see. (Faster R-CNN on CMC1:
# 0.45 of the boxes at hidden shares of 0.3 to 0.6; FairMOT: hardly any.)
CUT_SHARE = 0.5


def detection_probabilities(boxes: Array, hidden: Array, camera: Camera, shape: EllipsoidSettings) -> Array:
    """Return the probabilities of detection (n,) of bodies: less for what other bodies or the image's border hide.

    Boxes (n, 4) are as `stereophd.core.bodies.outline.outline_boxes` returns them, `hidden` (n,) their `hidden_shares`.
    """
    whole = np.minimum(share_in_image(boxes, camera) / WHOLE_SHARE, 1.0)
    return np.asarray(camera.detector.p_detect * whole * (1.0 - shape.hidden_loss * hidden**shape.hidden_power))


def hidden_shares(boxes: Array, states: Array, covariances: Array, existence: Array, camera: Camera) -> Array:
    """Return the share (n,) of the box of each body that nearer bodies are expected to hide.

    Each other body hides the part of the box that both share, with the probability that it exists and is nearer. Boxes
    (n, 4) are as `stereophd.core.bodies.outline.outline_boxes` returns them, of states (n, 8) with covariances (n, 8,
    8) and probabilities of existence (n,), in the camera at the time of the states.
    """
    half = boxes[:, WIDTH] / 2.0
    across = _overlaps(boxes[:, U] - half, boxes[:, U] + half)
    down = _overlaps(boxes[:, TOP], boxes[:, BOTTOM])
    area = np.maximum(boxes[:, WIDTH] * (boxes[:, BOTTOM] - boxes[:, TOP]), 1e-9)
    forward = camera.pose.rotation[2]
    depths = states[:, POSITION] @ forward
    variances = np.maximum(forward @ covariances[:, POSITION, POSITION] @ forward, 1e-18)
    nearer = ndtr((depths[:, None] - depths) / np.sqrt(variances[:, None] + variances))
    share = existence * nearer * across * down / area[:, None]
    np.fill_diagonal(share, 0.0)
    return np.asarray(1.0 - np.prod(1.0 - np.clip(np.nan_to_num(share), 0.0, 1.0), axis=1))


def _overlaps(low: Array, high: Array) -> Array:
    """Lengths (n, n) that intervals share."""
    return np.asarray(np.maximum(np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0.0))


def exclusive_existence(existence: Array, states: Array, covariances: Array, reported: Booleans, up: Array) -> Array:
    """Return the probabilities of existence (n,) of bodies of which no two can be in one place.

    Of a pair whose axes are closer than `CLOSEST` allows with probability 1 - q, both exist with a probability reduced
    by the factor q. Each body in turn, the least probable first, takes what that leaves of it and of the other one.
    States are (n, 8), their covariances (n, 8, 8); `reported` (n,) is True for those that have been reported; `up` is
    (3,).
    """
    if len(existence) < 2:
        return existence
    first, second, probabilities = _pairs_in_touch(states, covariances, reported, up)
    # of two certain ones in one place each is as probable as the other
    out = np.minimum(existence, 1.0 - 1e-9)
    order = np.argsort(np.minimum(out[first], out[second]), kind="stable")
    for i, j, q in zip(first[order].tolist(), second[order].tolist(), probabilities[order].tolist(), strict=True):
        both = out[i] * out[j] * (1.0 - q)
        out[i], out[j] = (out[i] - both) / (1.0 - both), (out[j] - both) / (1.0 - both)
    return out


def _pairs_in_touch(
    states: Array, covariances: Array, reported: Booleans, up: Array
) -> tuple[Integers, Integers, Array]:
    """Pairs of bodies (k,) that may be in one place, and the probability (k,) that they are apart."""
    second, first = np.tril_indices(len(states), -1)
    apart, axes = states[second, :3] - states[first, :3], np.exp(states[:, LOG_AXES])
    along, across = (axes[first] + axes[second]).T
    heights = apart @ up
    distances = np.sqrt(np.maximum((apart**2).sum(axis=1) - heights**2, 0.0))
    limits = np.where(reported[first] == reported[second], CLOSEST, CLOSEST_NEW) * across
    # the vertical extents must meet too: bodies may pass above each other
    near = np.flatnonzero((np.abs(heights) < along) & (distances < 2.0 * limits))
    first, second = first[near], second[near]
    spreads = (covariances[first] + covariances[second])[:, POSITION, POSITION]
    level = np.einsum("nij,ij->n", spreads, np.eye(3) - np.outer(up, up))
    stds = np.sqrt(np.maximum(level / 2.0, 1e-18))
    return first, second, ndtr((distances[near] - limits[near]) / stds)
