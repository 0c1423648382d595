"""Figures of the scene measured from a log: roughly from rays and one-camera tracks, then from tracks of a first filter
run."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.pipeline.build import build_labelled_filter
from stereophd.pipeline.tracking.loop import Estimator, run_estimator
from stereophd.pipeline.tracking.smoothed import trajectories_of

# Largest standard deviation of a position, over its depth, that counts.
CERTAIN = 0.05
# Estimates of the shortest track that counts (of a short log: this share of its frames), and of all tracks together.
LEAST_ESTIMATES, LEAST_SHARE, LEAST_TOTAL = 20, 0.3, 12
# Pixels of each image side and depths (over the distance between cameras) at which it is asked what two cameras see.
VIEW_PIXELS, VIEW_DEPTHS = 5, np.geomspace(0.02, 50.0, 60)
# Share of a stretch after which a track that begins is a new object, and frames of a camera that pass in any case: so
# many may miss an object that was there.
STARTED, SETTLED_FRAMES = 0.15, 5


@dataclass(frozen=True)
class SceneFigures:
    """Depths, speeds and comings of the objects of a log."""

    depths: Array  # (2,): Quantiles of 1 and 99 % of the depth before the cameras that see the objects, length
    speed_std: float  # Root mean square of one component of the velocity, length/s
    fastest: float  # Quantile of 99 % of the speed, length/s
    objects: int  # Tracks
    # `births`, `duration_s`: Tracks that began within the stretches, and the length of these.
    births: int
    duration_s: float
    # `deaths`, `seen_s`: Tracks that ended within the stretches, and the time that all tracks lasted together.
    deaths: int
    seen_s: float


def measure_with_filter(loaded: LoadedConfig, parts: Sequence[Sequence[Event]]) -> SceneFigures | None:
    """Track stretches of a log with complete and wide enough settings; return what tracks show, None if hardly any."""
    cameras = loaded.build_cameras()
    estimator = build_labelled_filter(loaded.config, cameras, loaded.path, 1)
    centers = np.array([camera.pose.center for camera in cameras])
    depths, speeds, counted = [], [], []
    births = deaths = 0
    duration = seen = 0.0
    for part in parts:
        tracks = _tracks(estimator, part, centers, min(LEAST_ESTIMATES, int(np.ceil(LEAST_SHARE * len(part)))))
        begin, end = part[0].time_s, part[-1].time_s
        duration += end - begin
        settling = max(STARTED, SETTLED_FRAMES * len(cameras) / len(part)) * (end - begin)
        for states, times in tracks:
            counted.append(len(states))
            depths.append(_depths(states[:, :3], cameras))
            speeds.append(states[:, 3:])
            births += bool(times[0] > begin + settling)
            deaths += bool(times[-1] < end - settling)
            seen += float(times[-1] - times[0])
    if sum(counted) < LEAST_TOTAL or not sum(map(len, depths)):
        return None
    velocity = np.concatenate(speeds)
    return SceneFigures(
        np.quantile(np.concatenate(depths), [0.01, 0.99]),
        float(np.sqrt((velocity**2).mean())),
        float(np.quantile(np.linalg.norm(velocity, axis=1), 0.99)),
        len(counted),
        births,
        duration,
        deaths,
        seen,
    )


def _tracks(estimator: Estimator[Any], part: Sequence[Event], centers: Array, least: int) -> list[tuple[Array, Array]]:
    """Return states (n, 6) and times (n,) of every track of certain estimates."""
    records = list(run_estimator(estimator, part))
    tracks = []
    for track in trajectories_of(records, range(len(records)), np.array([record.time_s for record in records])):
        spread = np.sqrt(np.trace(track.covariances[:, :3, :3], axis1=1, axis2=2))
        distance = np.linalg.norm(track.states[:, None, :3] - centers, axis=2).min(axis=1)
        certain = spread < CERTAIN * distance
        if certain.sum() >= least:
            tracks.append((track.states[certain], track.times[certain]))
    return tracks


def shared_depths(cameras: Sequence[Camera]) -> Array | None:
    """Return quantiles of 5, 50 and 95 % of the depths (3,) at which another camera sees what a camera sees.

    None where no two cameras share a view, or all stand in one place.
    """
    size = float(np.ptp(np.array([camera.pose.center for camera in cameras]), axis=0).max())
    depths = []
    for camera in cameras:
        u, v = np.meshgrid(*(np.linspace(0.0, side - 1.0, VIEW_PIXELS) for side in (camera.width, camera.height)))
        rays = camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
        directions = rays[np.isfinite(rays).all(axis=1)] @ camera.pose.rotation
        for depth in (size * VIEW_DEPTHS).tolist():
            points = camera.pose.center + depth * directions
            seen = np.array([other.in_view(points) for other in cameras if other is not camera]).any(axis=0)
            depths.append(np.full(int(np.sum(seen)), depth))
    found = np.concatenate(depths)
    return np.quantile(found, [0.05, 0.5, 0.95]) if size > 0.0 and len(found) else None


def _depths(positions: Array, cameras: tuple[Camera, ...]) -> Array:
    """Return the depths of positions (n, 3) before the cameras that have them in view."""
    found = []
    for camera in cameras:
        seen = camera.in_view(positions)
        pose = camera.pose
        found.append(((positions[seen] - pose.center) @ pose.rotation.T)[:, 2])
    return np.concatenate(found)
