"""Pixels of other programs in native ones: where pixel (0, 0) lies, and from which side rows count."""

from pathlib import Path

import numpy as np

from stereophd.core.arrays import Array
from stereophd.io.interchange.base import ForeignRecording, ImportOptions, Piece
from stereophd.io.interchange.cameras import image_size

#: What to subtract for the centre of the first pixel to be (0, 0).
ORIGINS = {"center": 0.0, "corner": 0.5, "one": 1.0}


def native_pixels(
    pixels: Array, camera: str, options: ImportOptions, recording: ForeignRecording, origin: str = "center"
) -> Array:
    """Return native pixels (n, 2): (0, 0) is the centre of the top-left pixel, rows count from the top.

    The conventions are those that the user states in the options, else the origin of the format, a key of `ORIGINS`,
    and rows from the top. Raises InputError when rows count from the bottom, and the image height of the camera (its
    native name) is not known.
    """
    shift = ORIGINS[options.pixel_origin or origin]
    if options.rows_from != "bottom":
        return pixels - shift
    known = recording.cameras.get(camera)
    stated = None if known is None else known.image_size_px
    size = image_size(camera, stated, options, "rows count from the bottom")
    result = pixels - shift
    result[:, 1] = size[1] - 1 - result[:, 1]
    return result


def point_rows(file: Path, camera: str, frames: Array, points: Array, scores: Array | None) -> Piece:
    """Return the detections of a camera; a frame without any is one row of NaN.

    Frame numbers are (n,), native pixels (n, points, 2), NaN where a point is not seen, scores (n, points). The number
    of a point is its ``object_id``.
    """
    is_seen = np.isfinite(points[:, :, 0]) | np.isfinite(points[:, :, 1])  # one coordinate alone makes a bad row
    frame_index, point_index = np.nonzero(is_seen)
    empty = np.flatnonzero(~is_seen.any(axis=1))
    number = np.concatenate([frames[frame_index], frames[empty]])
    order = np.argsort(number, kind="stable")
    gaps = np.full(len(empty), np.nan)
    extra = {"object_id": np.concatenate([point_index.astype(float), gaps])[order]}
    if scores is not None:
        extra["score"] = np.concatenate([scores[frame_index, point_index], gaps])[order]
    pixels = np.concatenate([points[frame_index, point_index], np.full((len(empty), 2), np.nan)])
    return Piece(file, camera, pixels[order], number[order], extra=extra)
