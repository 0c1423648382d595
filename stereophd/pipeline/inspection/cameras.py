"""Summary of cameras: what each is and sees, and how they stand to each other."""

import math
from collections.abc import Mapping
from itertools import pairwise
from string import ascii_uppercase
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.geometry.pose import Pose
from stereophd.core.geometry.projection import nearest_points
from stereophd.io.cameras.models import CameraConfig

# Optical axes whose directions all lie this close together have no point that they look at, condition number.
PARALLEL = 1e4
# Columns and rows of the sketch of a layout.
WIDTH, HEIGHT = 60, 18


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


def sketch(summary: Mapping[str, Any]) -> list[str]:
    """Draw the layout of cameras of known pose in text: each a letter, with dots along the direction that it looks in.

    The two world axes along which the cameras (and what they look at) spread most are drawn; ``+`` is where the optical
    axes meet.
    """
    rows = {name: row for name, row in summary["cameras"].items() if row["center"] is not None}
    centers = np.array([row["center"] for row in rows.values()])
    axes = np.array([row["looks_along"] for row in rows.values()])
    target = summary["axes_meet_near"]
    reach = _reach(centers, target)
    points = np.concatenate([centers, centers + reach * axes, *([] if target is None else [np.array([target])])])
    spread = np.ptp(points, axis=0)
    across, up = sorted(np.argsort(spread)[-2:].tolist())
    low, extent = points.min(axis=0), np.maximum(spread, 1e-9)
    # a letter is about twice as high as it is wide: one scale for both directions
    scale = max(extent[across] / (WIDTH - 1), extent[up] / (HEIGHT - 1) / 2)
    lines = [[" "] * WIDTH for _ in range(HEIGHT)]

    def put(point: Array, letter: str) -> None:
        column = round((point[across] - low[across]) / scale)
        row = HEIGHT - 1 - round((point[up] - low[up]) / scale / 2)
        if 0 <= column < WIDTH and 0 <= row < HEIGHT and (letter.isalnum() or lines[row][column] == " "):
            lines[row][column] = letter

    for center, axis in zip(centers, axes, strict=True):
        for share in np.linspace(0.08, 1.0, 14):
            put(center + share * reach * axis, ".")
    if target is not None:
        put(np.array(target), "+")
    for index, center in enumerate(centers):
        put(center, ascii_uppercase[index % 26])
    names = ", ".join(f"{ascii_uppercase[k % 26]} {name}" for k, name in enumerate(rows))
    drawn = ["".join(line).rstrip() for line in lines]
    used = [k for k, line in enumerate(drawn) if line]
    right, top = "xyz"[across], "xyz"[up]
    note = f"{right} to the right, {top} up the page, {scale:.3g} {summary['length_unit']} a column: {names}"
    return [*drawn[used[0] : used[-1] + 1], note]


def _reach(centers: Array, target: Any) -> float:
    """Return how far the direction of a camera is drawn: half-way to what it looks at."""
    if target is not None:
        return float(np.median(np.linalg.norm(centers - np.array(target), axis=1))) / 2
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(centers)]
    return max(steps, default=1.0) or 1.0
