"""Frames of each camera: detections, reprojected tracks, and residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.io.logs.reading import LogReader
from stereophd.pipeline.inspection.runs import Run
from stereophd.pipeline.tracking.run_figures.explained import PROBABLE, residuals_px
from stereophd.report.page.columns import Paths, chosen, packed, paths_of

# A reprojected track further outside the image than this share of its size is not drawn.
MARGIN = 0.1


def detections_of(run: Run) -> tuple[Array, Integers, Integers, Array]:
    """Return times (n,), cameras (n,), frames (n,) and pixels (n, 2) of all frames of a run, NaN in an empty frame.

    They come from the log if it is known, else from the associations, which hold only the detections of tracks.
    """
    if run.log is not None:
        reader = LogReader(run.log, run.cameras, "drop", float("inf"))
        rows = [
            (frame.time_s, frame.camera, frame.frame, u, v)
            for frame in reader
            for u, v in (frame.pixels.tolist() or [(np.nan, np.nan)])
        ]
        table = np.array(rows, dtype=np.float64).reshape(-1, 5)
        return table[:, 0], table[:, 1].astype(np.int64), table[:, 2].astype(np.int64), table[:, 3:]
    detections = run.associations
    if detections is None:
        empty = np.empty(0, dtype=np.int64)
        return np.empty(0), empty, empty, np.empty((0, 2))
    numbers = {camera.name: number for number, camera in enumerate(run.cameras)}
    cameras = np.array([numbers.get(name, -1) for name in detections["camera"].tolist()], dtype=np.int64)
    return detections["time_s"], cameras, detections["frame"], np.column_stack([detections["u_px"], detections["v_px"]])


def camera_frames(run: Run, paths: Paths, budget: int, start_s: float) -> list[dict[str, Any]]:
    """Return detections, whose they probably are, and reprojected tracks, of frames spread over the run."""
    times, cameras, frames, pixels = detections_of(run)
    owners = _owners(run, paths)
    out = []
    for number, camera in enumerate(run.cameras):
        rows_of = np.flatnonzero(cameras == number)
        events, event = np.unique(np.column_stack([times[rows_of], frames[rows_of]]), axis=0, return_inverse=True)
        event = event.reshape(-1)
        per_frame = max(len(rows_of) / max(len(events), 1), _tracks_at_a_time(paths), 1.0)
        kept = chosen(len(events), max(int(budget / (per_frame * len(run.cameras))), 1))
        place = np.full(len(events), -1)
        place[kept] = np.arange(len(kept))
        rows = rows_of[(place[event] >= 0) & np.isfinite(pixels[rows_of, 0])]
        at = place[event[(place[event] >= 0) & np.isfinite(pixels[rows_of, 0])]]
        order = np.argsort(at, kind="stable")
        rows, at = rows[order], at[order]
        keys = zip(frames[rows].tolist(), pixels[rows, 0].tolist(), pixels[rows, 1].tolist(), strict=True)
        owner = np.array([owners.get((camera.name, *key), -1) for key in keys])
        seen_at, seen_path, seen = _reprojected(camera, paths, events[kept, 0])
        out.append(
            {
                "t": packed(events[kept, 0] - start_s),
                "frame": events[kept, 1].astype(int).tolist(),
                "at": packed(at),
                "u": packed(pixels[rows, 0]),
                "v": packed(pixels[rows, 1]),
                "track": packed(owner),
                "seen_at": packed(seen_at),
                "seen_track": packed(seen_path),
                "seen_u": packed(seen[:, 0]),
                "seen_v": packed(seen[:, 1]),
                "whole": len(kept) == len(events),
            }
        )
    return out


def residuals(run: Run, paths: Paths, budget: int, start_s: float) -> list[dict[str, Any]] | None:
    """Return detections minus reprojected tracks by camera; None without associations or cameras."""
    by_camera = camera_residuals(run, paths, max(budget // max(len(run.cameras), 1), 1))
    if by_camera is None:
        return None
    return [
        {"t": packed(times - start_s), "u": packed(values[:, 0]), "v": packed(values[:, 1]), "track": packed(tracks)}
        for times, values, tracks in by_camera
    ]


def camera_residuals(run: Run, paths: Paths, most: int) -> list[tuple[Array, Array, Integers]] | None:
    """Return times (n,), residuals (n, 2) in px and tracks (n,) of every camera; None without associations or cameras.

    Only detections that belong to a track more probably than not are taken, at most `most` of each camera, evenly
    spread.
    """
    detections = run.associations
    if detections is None or not run.cameras:
        return None
    probable = np.flatnonzero(detections["probability"] > PROBABLE)
    place = {track_id: number for number, track_id in enumerate(paths.ids.tolist())}
    path = np.array([place.get(label, -1) for label in detections["track_id"][probable].tolist()], dtype=np.int64)
    out = []
    for camera in run.cameras:
        of_camera = (detections["camera"][probable] == camera.name) & (path >= 0)
        rows, owner = probable[of_camera], path[of_camera]
        few = chosen(len(rows), most)
        rows, owner = rows[few], owner[few]
        times = detections["time_s"][rows]
        pixels = np.column_stack([detections["u_px"][rows], detections["v_px"][rows]])
        values = residuals_px(camera, times, _states(paths, owner, times), pixels)
        known = np.isfinite(values).all(axis=1)
        out.append((times[known], values[known], owner[known]))
    return out


def _states(paths: Paths, path_of_row: Integers, times: Array) -> Array:
    """States (n, 6) of tracks (n,) at times (n,), interpolated; NaN outside of their lives."""
    states = np.full((len(times), 6), np.nan)
    for number in np.unique(path_of_row).tolist():
        rows = np.flatnonzero(path_of_row == number)
        span = slice(int(paths.starts[number]), int(paths.starts[number + 1]))
        for axis, name in enumerate(("x", "y", "z", "vx", "vy", "vz")):
            states[rows, axis] = np.interp(times[rows], paths.times[span], paths.columns[name][span], np.nan, np.nan)
    return states


def paths_of_run(run: Run) -> Paths:
    """Return the tracks of a run as paths."""
    assert run.tracks is not None
    names = ("time_s", "x", "y", "z", "vx", "vy", "vz", "speed", "position_std", "existence")
    return paths_of(run.tracks["track_id"], {name: run.tracks[name] for name in names})


def _owners(run: Run, paths: Paths) -> dict[tuple[str, int, float, float], int]:
    """Detection -> the track that it probably belongs to."""
    detections = run.associations
    if detections is None:
        return {}
    rows = np.flatnonzero(detections["probability"] > PROBABLE)
    place = {track_id: number for number, track_id in enumerate(paths.ids.tolist())}
    columns = [detections[name][rows].tolist() for name in ("camera", "frame", "u_px", "v_px", "track_id")]
    return {(c, f, u, v): place.get(i, -1) for c, f, u, v, i in zip(*columns, strict=True)}


def _tracks_at_a_time(paths: Paths) -> float:
    if not len(paths.ids):
        return 0.0
    lives = paths.times[paths.starts[1:] - 1] - paths.times[paths.starts[:-1]]
    return float(lives.sum() / max(float(np.ptp(paths.times)), 1e-9))


def _reprojected(camera: Camera, paths: Paths, times: Array) -> tuple[Integers, Integers, Array]:
    """Return frame (m,), track (m,) and pixel (m, 2) of every track in view of every frame."""
    ats, tracks, pixels = [], [], []
    low = -MARGIN * np.array([camera.width, camera.height])
    high = (1.0 + MARGIN) * np.array([camera.width, camera.height])
    for number in range(len(paths.ids)):
        positions = paths.positions_at(number, times)
        at = np.flatnonzero(np.isfinite(positions).all(axis=1))
        if camera.pose.is_static:
            seen = camera.project(positions[at])
        else:
            views = [camera.at(float(times[k])).project(positions[k][None])[0] for k in at.tolist()]
            seen = np.reshape(np.array(views), (-1, 2))
        with np.errstate(invalid="ignore"):
            inside = ((seen >= low) & (seen <= high)).all(axis=1)
        ats.append(at[inside])
        tracks.append(np.full(int(inside.sum()), number))
        pixels.append(seen[inside])
    if not ats:
        empty = np.empty(0, dtype=np.int64)
        return empty, empty, np.empty((0, 2))
    at, track, pixel = np.concatenate(ats), np.concatenate(tracks), np.concatenate(pixels)
    order = np.argsort(at, kind="stable")
    return at[order], track[order], pixel[order]
