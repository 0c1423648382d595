"""Checks of a finished tracking run: is the log explained, and by more than one camera?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from stereophd.core.geometry.camera import Camera
from stereophd.pipeline.checks.finding import Finding
from stereophd.wording import percent

# Share of the detections of objects that tracks must explain, and detections from which it is judged.
LEAST_EXPLAINED, LEAST_DETECTIONS = 0.35, 100
# A track is one camera's if this share of its detections is; reported if most estimates belong to such tracks.
ONE_CAMERA, MOST_ALONE = 0.95, 0.5


def check_tracking(
    summary: Mapping[str, Any], counts: Mapping[str, int], cameras: tuple[Camera, ...]
) -> Iterator[Finding]:
    """Yield findings about the tracks of a run.

    Parameters
    ----------
    summary : mapping
        Figures of the run, as in ``report.json``; ``tracks.n_detections`` by camera, and ``left_out``, are used.
    counts : mapping
        Counts of the log: ``detections``, ``frames``.
    cameras : tuple of Camera
    """
    detections, frames = counts["detections"], counts["frames"]
    clutter = frames * float(np.mean([camera.detector.clutter_per_frame for camera in cameras]))
    objects = detections - clutter - summary["left_out"]["burst_detections"]
    tracks = summary["tracks"]
    count = len(tracks)
    if count == 0 and objects >= LEAST_DETECTIONS:
        yield Finding(
            "tracking.tracks", "warning", "no track was reported although the log has detections beyond the clutter",
            0, None, None, "run `check` on the same configuration and log; look at filter.birth and the cameras",
            "no_tracks",
        )  # fmt: skip
        return
    if count == 0 or objects < LEAST_DETECTIONS:
        yield Finding("tracking.tracks", "not checked", "too few detections or tracks to judge the run")
        return
    own = np.array([[track["n_detections"][camera.name] for track in tracks] for camera in cameras], dtype=float)
    explained = float(own.sum()) / objects
    if explained < LEAST_EXPLAINED:
        yield Finding(
            "tracking.explained", "warning",
            f"tracks explain {percent(explained)} of the detections that are not expected to be clutter",
            round(explained, 3), float(np.mean([camera.detector.p_detect for camera in cameras])), None,
            "run `check` on the same configuration and log: cameras, clocks, clutter or births do not fit",
            "unexplained",
        )  # fmt: skip
    else:
        yield Finding(
            "tracking.explained", "ok", f"tracks explain {percent(min(explained, 1.0))} of the expected detections",
            round(explained, 3),
        )  # fmt: skip
    if len(cameras) < 2:
        return
    largest = own.max(axis=0) / np.maximum(own.sum(axis=0), 1.0)
    estimates = np.array([track["n_estimates"] for track in tracks], dtype=float)
    alone = float(estimates[largest >= ONE_CAMERA].sum() / max(estimates.sum(), 1.0))
    text = f"{percent(alone)} of the estimates belong to tracks that one camera alone supports"
    if alone > MOST_ALONE:
        yield Finding(
            "tracking.cameras", "warning", text, round(alone, 3), None, None,
            "check poses, intrinsics and clocks: cameras that see the same object do not agree", "one_camera_tracks",
        )  # fmt: skip
    else:
        yield Finding("tracking.cameras", "ok", text, round(alone, 3))
