"""Frames of each camera: detections, reprojected tracks, and residuals."""

from typing import Any

import numpy as np

from stereophd.core.arrays import Array, Integers
from stereophd.core.bodies.boxes import corners
from stereophd.core.bodies.outline import LOG_AXES, POSITION, STATE_SIZE, outline_boxes
from stereophd.core.geometry.camera import Camera
from stereophd.io.logs.reading import LogReader
from stereophd.pipeline.inspection.runs import Columns, Run
from stereophd.pipeline.tracking.residuals import OUTLIER, PROBABLE, residuals_px
from stereophd.report.page.columns import Paths, chosen, packed, paths_of
from stereophd.report.summaries import tracking_part

# A reprojected track further outside the image than this share of its size is not drawn.
MARGIN = 0.1


def detections_of(run: Run) -> tuple[Array, Integers, Integers, Array]:
    """Return times (n,), cameras (n,), frames (n,) and detections (n, 4) of all frames of a run, NaN in an empty frame.

    A detection is u, v, and the width and the height of its box, px, NaN without one. They come from the log if it is
    known, else from the associations, which hold only the detections of tracks.
    """
    if run.log is not None:
        reader = LogReader(run.log, run.cameras, "drop", float("inf"))
        rows = [
            (frame.time_s, frame.camera, frame.frame, *row)
            for frame in reader
            for row in (_with_sizes(frame.pixels, frame.sizes).tolist() or [(np.nan,) * 4])
        ]
        table = np.array(rows, dtype=np.float64).reshape(-1, 7)
        return table[:, 0], table[:, 1].astype(np.int64), table[:, 2].astype(np.int64), table[:, 3:]
    detections = run.associations
    if detections is None:
        empty = np.empty(0, dtype=np.int64)
        return np.empty(0), empty, empty, np.empty((0, 4))
    numbers = {camera.name: number for number, camera in enumerate(run.cameras)}
    cameras = np.array([numbers.get(name, -1) for name in detections["camera"].tolist()], dtype=np.int64)
    pixels = np.column_stack([detections["u_px"], detections["v_px"]])
    return detections["time_s"], cameras, detections["frame"], _with_sizes(pixels, None)


def _with_sizes(pixels: Array, sizes: Array | None) -> Array:
    return np.concatenate([pixels, np.full_like(pixels, np.nan) if sizes is None else sizes], axis=1)


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
        shown = np.flatnonzero((place[event] >= 0) & np.isfinite(pixels[rows_of, 0]))
        shown = shown[np.argsort(place[event[shown]], kind="stable")]
        rows, at = rows_of[shown], place[event[shown]]
        keys = zip(frames[rows].tolist(), pixels[rows, 0].tolist(), pixels[rows, 1].tolist(), strict=True)
        owner = np.array([owners.get((camera.name, *key), -1) for key in keys])
        seen_at, seen_path, seen = _reprojected(camera, paths, events[kept, 0], run.up)
        names = ("u", "v") if np.isnan(pixels[:, 2]).all() else ("u", "v", "w", "h")
        outline = ("u", "v") if seen.shape[1] == 2 else ("u", "v", "left", "top", "right", "bottom")
        out.append(
            {
                "t": packed(events[kept, 0] - start_s),
                "frame": events[kept, 1].astype(int).tolist(),
                "at": packed(at),
                **{name: packed(pixels[rows, k]) for k, name in enumerate(names)},
                "track": packed(owner),
                "seen_at": packed(seen_at),
                "seen_track": packed(seen_path),
                **{f"seen_{name}": packed(seen[:, k]) for k, name in enumerate(outline)},
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
        {
            "t": packed(times - start_s),
            "u": packed(values[:, 0]),
            "v": packed(values[:, 1]),
            "track": packed(tracks),
            "outliers": outliers,
        }
        for times, values, tracks, outliers in by_camera
    ]


def camera_residuals(run: Run, paths: Paths, most: int) -> list[tuple[Array, Array, Integers, int]] | None:
    """Return times (n,), residuals (n, 2) in px and tracks (n,) of every camera; None without associations or cameras.

    Only detections that belong to a track more probably than not are taken, at most `most` of each camera, evenly
    spread; of these none beyond `OUTLIER` times the root mean square of the report, whose number stands last.
    """
    detections = run.associations
    if detections is None or not run.cameras:
        return None
    probable, path = _probable(detections, paths)
    figures, out = tracking_part(run.report).get("cameras") or {}, []
    for camera in run.cameras:
        of_camera = (detections["camera"][probable] == camera.name) & (path >= 0)
        rows, owner = probable[of_camera], path[of_camera]
        few = chosen(len(rows), most)
        rows, owner = rows[few], owner[few]
        times = detections["time_s"][rows]
        pixels = np.column_stack([detections["u_px"][rows], detections["v_px"][rows]])
        values = residuals_px(camera, times, _states(paths, owner, times), pixels)
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        rms = figures.get(camera.name, {}).get("residual_rms_px") or np.inf
        near = known[(values[known] ** 2).sum(axis=1) <= 2.0 * (OUTLIER * rms) ** 2]
        out.append((times[near], values[near], owner[near], len(known) - len(near)))
    return out


def _states(paths: Paths, path_of_row: Integers, times: Array) -> Array:
    """States (n, 6) of tracks (n,) at times (n,), interpolated; NaN outside of their lives."""
    states = np.full((len(times), 6), np.nan)
    for number in np.unique(path_of_row).tolist():
        rows = np.flatnonzero(path_of_row == number)
        states[rows] = paths.at(number, times[rows], ("x", "y", "z", "vx", "vy", "vz"))
    return states


def paths_of_run(run: Run) -> Paths:
    """Return the tracks of a run as paths."""
    assert run.tracks is not None
    names = ("time_s", "x", "y", "z", "vx", "vy", "vz", "speed", "position_std", "existence")
    extents = tuple(name for name in ("height", "width") if name in run.tracks)
    return paths_of(run.tracks["track_id"], {name: run.tracks[name] for name in (*names, *extents)})


def _owners(run: Run, paths: Paths) -> dict[tuple[str, int, float, float], int]:
    """Detection -> the track that it probably belongs to."""
    if run.associations is None:
        return {}
    rows, path = _probable(run.associations, paths)
    columns = [run.associations[name][rows].tolist() for name in ("camera", "frame", "u_px", "v_px")]
    return dict(zip(zip(*columns, strict=True), path.tolist(), strict=True))


def _probable(detections: Columns, paths: Paths) -> tuple[Integers, Integers]:
    """Return the rows (n,) that belong to a track more probably than not, and the path of each; -1 for none."""
    rows = np.flatnonzero(detections["probability"] > PROBABLE)
    place = {track_id: number for number, track_id in enumerate(paths.ids.tolist())}
    return rows, np.array([place.get(one, -1) for one in detections["track_id"][rows].tolist()], dtype=np.int64)


def _tracks_at_a_time(paths: Paths) -> float:
    if not len(paths.ids):
        return 0.0
    lives = paths.times[paths.starts[1:] - 1] - paths.times[paths.starts[:-1]]
    return float(lives.sum() / max(float(np.ptp(paths.times)), 1e-9))


def _reprojected(camera: Camera, paths: Paths, times: Array, up: Array) -> tuple[Integers, Integers, Array]:
    """Return frame (m,), track (m,) and pixel (m, 2) of every track in view of every frame.

    Of bodies, whose height is along `up`, the left, upper, right and lower sides of their images follow the pixel.
    """
    size = np.array([camera.width, camera.height])
    has_extents = "height" in paths.columns
    found = [np.empty((0, 8 if has_extents else 4))]
    for number in range(len(paths.ids)):
        positions = paths.at(number, times, ("x", "y", "z"))
        at = np.flatnonzero(np.isfinite(positions).all(axis=1))
        extents = paths.at(number, times[at], ("height", "width")) if has_extents else None
        rows = np.arange(len(at))
        # one at a time where the camera moves
        for part in [rows] if camera.pose.is_static else np.array_split(rows, len(rows)):
            frozen = camera.at(float(times[at[part[0]]])) if len(part) else camera
            seen = frozen.project(positions[at[part]])
            if extents is not None:
                seen = np.concatenate([seen, _sides(frozen, positions[at[part]], extents[part], up)], axis=1)
            with np.errstate(invalid="ignore"):
                inside = ((seen[:, :2] >= -MARGIN * size) & (seen[:, :2] <= (1.0 + MARGIN) * size)).all(axis=1)
            found.append(np.column_stack([at[part], np.full(len(part), number), seen])[inside])
    table = np.concatenate(found)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:]


def _sides(camera: Camera, positions: Array, extents: Array, up: Array) -> Array:
    """Left, upper, right and lower sides (n, 4), px, of the images of bodies of heights and widths (n, 2)."""
    states = np.zeros((len(positions), STATE_SIZE))
    states[:, POSITION], states[:, LOG_AXES] = positions, np.log(extents / 2.0)
    return np.concatenate(corners(outline_boxes(states, camera, up)[0], camera), axis=1)
