"""Summary of cameras: what each is and sees, and how they stand to each other."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from stereophd.core.geometry.pose import Pose
from stereophd.core.geometry.projection import nearest_points
from stereophd.io.cameras.models import CameraConfig

# Optical axes whose directions all lie this close together have no point that they look at, condition number.
PARALLEL = 1e4


def summarise_cameras(cameras: Mapping[str, CameraConfig], length_unit: str) -> dict[str, Any]:
    """Return a row for each camera; the distances between those of known pose, and the point that they look at."""
    rows = {name: _row(name, config) for name, config in cameras.items()}
    known = {name: row for name, row in rows.items() if row["center"] is not None}
    centers = np.array([row["center"] for row in known.values()]).reshape(-1, 3)
    axes = np.array([row["looks_along"] for row in known.values()]).reshape(-1, 3)
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)[np.triu_indices(len(centers), 1)]
    nearest = nearest_points(axes, centers, np.zeros(len(axes), dtype=np.int64), 1, PARALLEL)[0]
    target = nearest if np.isfinite(nearest).all() else None
    offset = centers - (np.zeros(3) if target is None else target)
    across = offset - np.einsum("ki,ki->k", offset, axes)[:, None] * axes
    return {
        "length_unit": length_unit,
        "distances": {"nearest": float(distances.min()), "farthest": float(distances.max())}
        if len(distances)
        else None,
        "axes_meet_near": None if target is None else target.tolist(),
        "axes_distance_rms": None if target is None else float(np.sqrt(np.mean(np.sum(across**2, axis=1)))),
        "axes_meet_behind": []
        if target is None
        else [name for name, center, axis in zip(known, centers, axes, strict=True) if (target - center) @ axis < 0],
        "cameras": rows,
    }


def _row(name: str, config: CameraConfig) -> dict[str, Any]:
    camera = config.build(name)
    return {
        "image_size_px": [camera.width, camera.height],
        "focal_px": [camera.fx, camera.fy],
        "principal_point_px": [camera.cx, camera.cy],
        "field_of_view_deg": [
            math.degrees(2 * math.atan(camera.width / 2 / camera.fx)),
            math.degrees(2 * math.atan(camera.height / 2 / camera.fy)),
        ],
        "lens": camera.lens.model,
        "center": None if config.pose.unknown else camera.pose.center.tolist(),
        "looks_along": None if config.pose.unknown else camera.pose.rotation[2].tolist(),
        "pose_is_unknown": config.pose.unknown,
        "moves": not camera.pose.is_static,
        "trajectory": _trajectory(camera.pose),
        "sigma_px": list(config.detector.sigma_px),
        "p_detect": config.detector.p_detect,
        "clutter_per_frame": config.detector.clutter_per_frame,
        "detector_is_estimated": config.detector.estimate,
        "frame_rate_hz": config.frame_rate_hz,
        "clock": config.clock.model_dump(),
        "readout_s": config.readout_s,
    }


def _trajectory(pose: Pose) -> dict[str, Any] | None:
    """Return the poses, period and length of a known trajectory; None of a camera without one."""
    if pose.path is None:
        return None
    poses = pose.path.trajectory.poses
    steps = np.linalg.norm(np.diff(poses[:, 1:4], axis=0), axis=1)
    return {
        "poses": len(poses),
        "first_s": float(poses[0, 0]),
        "last_s": float(poses[-1, 0]),
        "longest_gap_s": float(np.diff(poses[:, 0]).max()),
        "length": float(steps.sum()),
    }
