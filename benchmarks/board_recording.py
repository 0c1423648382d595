"""Calibrate the board recording from a wrong guess, track it, and score distances of corners and focal lengths.

    python benchmarks/board_recording.py --seed 0 --out out/board [--metres 0.1] [--degrees 5] [--focal 0.1]
    python benchmarks/board_recording.py --simulated --seed 0 --out out/board

Every camera but the reference is off by --metres and --degrees in random directions, all focal lengths are off by the
part --focal, up or down, principal points are taken at the middle of the image and lenses as straight. `calibrate` gets
no labels; then `track --smooth` follows the corners with the cameras found. The labels of the recording name the corner
of each track only to score it: distances of neighbouring corners beside the known 0.054 m wherever both are tracked.
The recording is not part of the project: its folder is $STEREOPHD_DATA/board/1, or that of ../shared/data. With
--simulated the scene of the config takes its place, with that seed, and its guess is a draw from the prior. With
--supplied nothing is calibrated: the tracker gets the cameras of the recording, or the true ones. Further `--set` go to
both commands.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import yaml

from stereophd.commands.calibrate import calibrate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_cameras, load_config
from stereophd.core.arrays import Array
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.io.cameras.writing import write_cameras
from stereophd.pipeline.calibration.configured_unknowns import with_quantities

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "configs" / "board_calibration.yaml"
REFERENCE, SPACING = "cam1", 0.054


def data_folder() -> Path:
    """Folder of the recording."""
    return Path(os.environ.get("STEREOPHD_DATA", ROOT.parent / "shared" / "data")) / "board" / "1"


def write_guess(folder: Path, path: Path, seed: int, metres: float, degrees: float, focal: float) -> None:
    """Write cameras that are as far off as the head of this file says."""
    rng = np.random.default_rng(seed)
    supplied, cameras = load_cameras(folder / "cameras.yaml").cameras, []
    for name, config in supplied.items():
        camera = config.build(name)
        moved, turned = rng.standard_normal(3), rng.standard_normal(3)
        pose = camera.pose
        if name != REFERENCE:
            turn = rotation_from_vector(np.deg2rad(degrees) * turned / np.linalg.norm(turned))
            pose = Pose(turn @ pose.rotation, pose.center + metres * moved / np.linalg.norm(moved))
        length = camera.fx * (1.0 + focal * rng.choice([-1.0, 1.0]))
        u, v = 0.5 * (camera.width - 1), 0.5 * (camera.height - 1)
        lens = Lens(camera.lens.model)
        cameras.append(replace(camera, pose=pose, fx=length, fy=length, cx=u, cy=v, lens=lens))
    write_cameras(path, with_quantities(supplied, cameras), "m")


def corners_of(folder: Path, tracks: Path) -> dict[int, int]:
    """Corner of each track: that of most of its detections by the labels of the recording."""
    key = ("camera", "u_px", "v_px")
    labelled = folder / "labels.parquet"
    labels = pq.read_table(labelled if labelled.exists() else folder / "detections.parquet").to_pylist()
    corner = {tuple(row[name] for name in key): row["object_id"] for row in labels}
    found: dict[int, Counter[int]] = {}
    for row in pq.read_table(tracks / "associations.parquet").to_pylist():
        label = corner.get(tuple(row[name] for name in key))
        if label is not None and label >= 0 and row["probability"] > 0.5:
            found.setdefault(row["track_id"], Counter())[label] += 1
    return {track_id: count.most_common(1)[0][0] for track_id, count in found.items()}


def distances(folder: Path, tracks: Path) -> Array:
    """Distances less the known one, m, of neighbouring corners at all times at which both are tracked."""
    if (folder / "grid.yaml").exists():
        grid = yaml.safe_load((folder / "grid.yaml").read_text())["corners_m"]
    else:
        (board,) = yaml.safe_load(CONFIG.read_text())["simulate"]["bodies"]
        grid = {number: point[:2] for number, point in enumerate(board["points"])}
    corner = corners_of(folder, tracks)
    at: dict[float, dict[int, Array]] = {}
    for row in pq.read_table(tracks / "tracks.parquet").to_pylist():
        if row["track_id"] in corner:
            point = np.array([row[name] for name in "xyz"])
            at.setdefault(row["time_s"], {})[corner[row["track_id"]]] = point
    neighbours = [
        (i, j) for i in grid for j in grid if i < j and abs(np.hypot(*np.subtract(grid[i], grid[j])) - SPACING) < 1e-3
    ]
    return np.array(
        [
            float(np.linalg.norm(points[i] - points[j])) - SPACING
            for points in at.values()
            for i, j in neighbours
            if i in points and j in points
        ]
    )


def scores(folder: Path, calibrated: Path, tracks: Path) -> dict[str, Any]:
    """Errors of distances, mm, and of focal lengths, per cent."""
    found = 1e3 * distances(folder, tracks)
    supplied = load_cameras(folder / "cameras.yaml").cameras
    focal = {}
    for name, config in load_cameras(calibrated / "cameras.yaml").cameras.items():
        camera, other = config.build(name), supplied[name].build(name)
        focal[name] = round(50.0 * (camera.fx / other.fx + camera.fy / other.fy) - 100.0, 2)
    return {
        "distances": len(found),
        "rms_mm": round(float(np.sqrt((found**2).mean())), 2) if len(found) else None,
        "median_abs_mm": round(float(np.median(np.abs(found))), 2) if len(found) else None,
        "beyond_3_mm": int((np.abs(found) > 3.0).sum()),
        "mean_mm": round(float(found.mean()), 2) if len(found) else None,
        "tracks": len(corners_of(folder, tracks)),
        "focal_percent": focal,
    }


def main() -> None:
    """Run one guess."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--metres", type=float, default=0.1)
    parser.add_argument("--degrees", type=float, default=5.0)
    parser.add_argument("--focal", type=float, default=0.1)
    parser.add_argument("--set", action="append", default=[], dest="changes")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--simulated", action="store_true", help="the scene of the config in place of the recording")
    parser.add_argument("--supplied", action="store_true", help="track with the supplied cameras, and score")
    parser.add_argument("--score-only", action="store_true", help="track with the cameras in --out, and score")
    given = parser.parse_args()
    out = given.out
    folder, guess = data_folder(), out.with_name(f"{out.name}_guess.yaml")
    tracks = out.with_name(f"{out.name}_tracks")
    log = "detections.parquet"
    out.parent.mkdir(parents=True, exist_ok=True)
    if given.simulated:
        folder = out.with_name(f"{out.name}_scene")
        simulate(load_config(CONFIG, [*given.changes, f"seed={given.seed}"]), folder, force=True)
        guess = folder / "guess.yaml"
    if not (given.score_only or given.supplied):
        if not given.simulated:
            write_guess(folder, guess, given.seed, given.metres, given.degrees, given.focal)
        begin = time.process_time()
        report = calibrate(load_config(CONFIG, given.changes, cameras_path=guess), folder / log, out, force=True)
        seconds = round(time.process_time() - begin, 1)
        agreeing = f"{report['agreeing_starts']} of {len(report['starts'])}"
        print(json.dumps({"status": report["status"], "processor_s": seconds, "agreeing_starts": agreeing}))
        print(json.dumps(report["reason"]))
    changes = [*given.changes, "report.associations=true"]
    found = folder if given.supplied else out
    track(load_config(CONFIG, changes, cameras_path=found / "cameras.yaml"), folder / log, tracks, force=True)
    print(json.dumps(scores(folder, found, tracks), indent=1))


if __name__ == "__main__":
    main()
