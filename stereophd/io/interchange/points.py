"""Tables with a place for every point in every frame: from programs that follow named or numbered points."""

from __future__ import annotations

import numpy as np

from stereophd.core.arrays import Array
from stereophd.io.interchange.base import Piece


def point_rows(camera: str, frames: Array, points: Array, scores: Array | None, least: float | None) -> Piece:
    """Return the detections of a camera; a frame without any is one row of NaN.

    Frame numbers are (n,), native pixels (n, points, 2), NaN where a point is not seen, scores (n, points). The number
    of a point is its ``object_id``. Points of a smaller score than `least` are not seen.
    """
    is_seen = np.isfinite(points[:, :, 0]) & np.isfinite(points[:, :, 1])
    if scores is not None and least is not None:
        is_seen &= ~(scores < least)
    frame_index, point_index = np.nonzero(is_seen)
    empty = np.flatnonzero(~is_seen.any(axis=1))
    number = np.concatenate([frames[frame_index], frames[empty]])
    order = np.argsort(number, kind="stable")
    gaps = np.full(len(empty), np.nan)
    extra = {"object_id": np.concatenate([point_index.astype(float), gaps])[order]}
    if scores is not None:
        extra["score"] = np.concatenate([scores[frame_index, point_index], gaps])[order]
    pixels = np.concatenate([points[frame_index, point_index], np.full((len(empty), 2), np.nan)])
    return Piece(camera, pixels[order], number[order], extra=extra)
