"""Boxes of an event as measurements of bodies: what the border of the image hides, noise, and the density of clutter.

A box is (u, top, bottom, width) in undistorted pixels. Its noise is in proportion to the height of the body's image:
detectors place the sides of a large box with larger errors. A side at the border of the image is where the image ends,
not where the body does, and is left out: the measurement keeps the other sides. False boxes are uniform over the image
in their middle, and in the logarithm of their height and width.
"""

import math
from dataclasses import dataclass

import numpy as np

from stereophd.core.arrays import Array, Booleans
from stereophd.core.bodies.outline import BOTTOM, TOP, WIDTH, U
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.core.numerics.rows import ArrayRows
from stereophd.errors import InputError
from stereophd.wording import instant

# A side within this of the border of the image, px, may lie beyond it.
BORDER_PX = 5.0
# Noise of each value of a box besides the part in proportion to its height, px.
FLOOR_PX = 3.0
# A body of whose box less than this share is in the image is detected the more rarely the less there is.
WHOLE_SHARE = 0.5
# Ratio of the largest and the smallest extent of false boxes.
EXTENT_RANGE = 100.0


@dataclass(frozen=True)
class Boxes(ArrayRows):
    """The boxes of an event."""

    values: Array  # (m, 4): u, top, bottom, width, undistorted px
    # (m, 4, 4): The measurement that is left of a box: with its left side hidden, u becomes the right side
    selections: Array
    hidden: Booleans  # (m, 4): Rows of the measurement that the border hides
    scales: Array  # (m, 4): Undistorted px in a distorted px, of each value
    log_clutter: Array  # (m,): Logarithm of the density of a false box, over the values that are not hidden

    def __len__(self) -> int:
        return len(self.values)


def boxes_of(event: Event, camera: Camera) -> Boxes:
    """Return the boxes of an event of this camera, whose `sizes` are known; InputError when a detection has no box."""
    pixels = event.points if event.pixels is None else event.pixels
    sizes = np.full_like(pixels, np.nan) if event.sizes is None else event.sizes
    if np.isnan(sizes).any():
        raise InputError(
            f"camera {camera.name}, frame {event.frame} at {instant(event.time_s)} s: expected a box (width_px, "
            "height_px) for each detection (object.shape is ellipsoid), found none"
        )
    half = sizes / 2.0
    left, right = pixels[:, 0] - half[:, 0], pixels[:, 0] + half[:, 0]
    top, bottom = pixels[:, 1] - half[:, 1], pixels[:, 1] + half[:, 1]
    hides_left, hides_right = left <= BORDER_PX - 0.5, right >= camera.width - 0.5 - BORDER_PX
    hidden = np.zeros((len(pixels), 4), dtype=np.bool_)
    hidden[:, U] = hides_left & hides_right
    hidden[:, WIDTH] = hides_left | hides_right
    hidden[:, TOP], hidden[:, BOTTOM] = top <= BORDER_PX - 0.5, bottom >= camera.height - 0.5 - BORDER_PX
    selections = np.where(hidden[:, :, None], 0.0, np.eye(4))
    selections[hides_left & ~hides_right, U, WIDTH] = 0.5
    selections[hides_right & ~hides_left, U, WIDTH] = -0.5
    u, v = pixels[:, 0], pixels[:, 1]
    sides = np.stack([left, right, u, u], axis=1), np.stack([v, v, top, bottom], axis=1)
    values, scales = _undistorted(camera, sides, sizes)
    room = np.array([camera.width, camera.height], dtype=float) * scales[:, [U, TOP]]
    extents = np.stack([values[:, WIDTH], values[:, BOTTOM] - values[:, TOP]], axis=1) * math.log(EXTENT_RANGE)
    log_room, log_extents = np.log(room), np.log(np.maximum(extents, 1e-9))
    upright = hidden[:, TOP] | hidden[:, BOTTOM], hidden[:, TOP] & hidden[:, BOTTOM]
    log_clutter = -(
        np.where(hidden[:, U], 0.0, log_room[:, 0])
        + np.where(hidden[:, WIDTH], 0.0, log_extents[:, 0])
        + np.where(upright[1], 0.0, log_room[:, 1])
        + np.where(upright[0], 0.0, log_extents[:, 1])
    )
    return Boxes(values, selections, hidden, scales, log_clutter)


def _undistorted(camera: Camera, sides: tuple[Array, Array], sizes: Array) -> tuple[Array, Array]:
    """Values (m, 4) of boxes and their scales (m, 4), from u and v (m, 4) of the middles of their four sides."""
    u, v = sides
    if camera.lens.code != 0:
        flat = np.stack([u.ravel(), v.ravel()], axis=1)
        points = camera.undistort_pixels(flat)[0]
        # a side that the lens model does not reach stays where the middle of its box is
        points = np.where(np.isfinite(points), points, flat).reshape(*u.shape, 2)
        u, v = points[..., 0], points[..., 1]
    values = np.stack([(u[:, 0] + u[:, 1]) / 2.0, v[:, 2], v[:, 3], u[:, 1] - u[:, 0]], axis=1)
    across, down = values[:, WIDTH] / sizes[:, 0], (values[:, BOTTOM] - values[:, TOP]) / sizes[:, 1]
    return values, np.stack([across, down, down, across], axis=1)


def box_middles(boxes: Array) -> Array:
    """Middles (n, 2) of boxes (n, 4), undistorted px."""
    return np.column_stack([boxes[:, U], (boxes[:, TOP] + boxes[:, BOTTOM]) / 2.0])


def with_noise_of_middles(camera: Camera, height_px: float) -> Camera:
    """Return a camera with the noise of the middles of boxes of a height, for what takes boxes for points."""
    u, top, bottom, _ = camera.detector.box_noise
    return camera.with_noise(np.hypot(FLOOR_PX, height_px * np.array([u, np.hypot(top, bottom) / 2.0])))


def box_variances(heights: Array, scales: Array, parts: Array) -> Array:
    """Variances (..., 4) of the values of boxes, px^2, for bodies whose images have heights (...), px.

    Scales (..., 4) are as in `Boxes`; `parts` (4,) are standard deviations as parts of the height
    (`Detector.box_noise`).
    """
    return np.asarray((parts * heights[..., None]) ** 2 + (FLOOR_PX * scales) ** 2)


def share_in_image(boxes: Array, camera: Camera) -> Array:
    """Return the share (n,) of boxes (n, 4) in undistorted px that lies in the image; 0 for NaN."""
    with np.errstate(invalid="ignore"):
        low, high = corners(boxes, camera)
        edge = np.array([camera.width, camera.height]) - 0.5
        inside = np.minimum(high, edge) - np.maximum(low, -0.5)
        share = np.clip(inside / np.maximum(high - low, 1e-9), 0.0, 1.0)
    return np.asarray(np.nan_to_num(share[:, 0] * share[:, 1]))


def corners(boxes: Array, camera: Camera) -> tuple[Array, Array]:
    """Return the corners (n, 2), least and greatest u and v in distorted px, of boxes (n, 4) in undistorted px."""
    half, middle = boxes[:, WIDTH] / 2.0, (boxes[:, TOP] + boxes[:, BOTTOM]) / 2.0
    u = np.stack([boxes[:, U] - half, boxes[:, U] + half, boxes[:, U], boxes[:, U]], axis=1)
    v = np.stack([middle, middle, boxes[:, TOP], boxes[:, BOTTOM]], axis=1)
    if camera.lens.code != 0:
        points = camera.distort_pixels(np.stack([u.ravel(), v.ravel()], axis=1))[0].reshape(*u.shape, 2)
        u, v = points[..., 0], points[..., 1]
    return np.stack([u[:, 0], v[:, 2]], axis=1), np.stack([u[:, 1], v[:, 3]], axis=1)
