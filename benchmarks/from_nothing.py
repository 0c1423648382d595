"""Cameras from nothing: is what is found right, and does what cannot be found say so?

    python benchmarks/from_nothing.py --runs 60                 the paper's scene before two to five cameras
    python benchmarks/from_nothing.py --degenerate --runs 100   scenes that show no cameras, or hardly any
    ... --search                                                without the adjustment that follows the search

Poses are unknown, focal lengths off by up to 5 % (known to 3 %), clocks off by up to 100 s. The degenerate scenes take
turns: objects stand still, one moves straight, all move alike, they hover, fly in one plane or a circle; cameras stand
at one place or see everything from afar; logs are short, are not of one time, or of one scene. One line of JSON a run,
then a summary. A run is wrong where `determined` cameras are not the true ones: rotations or directions more than five
stated deviations and half a degree off, or any answer where there is none.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from common import facing, write_log

# isort: split
import numpy as np
import pyarrow.parquet as pq
import yaml

from stereophd.commands.calibrate import calibrate
from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_cameras, load_config
from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_to_vector
from stereophd.pipeline.calibration.found_cameras import with_found_cameras

PAPER = Path(__file__).resolve().parents[1] / "configs" / "paper" / "calibration.yaml"
KINDS = (
    "still", "one straight", "all alike", "hover", "one plane", "circle", "one place", "far", "short",
    "other times", "other scene",
)  # fmt: skip
# Kinds without a true answer.
NO_ANSWER = ("still", "one place", "other times", "other scene")
# Standard deviations, and degrees, beyond which an answer is wrong.
WRONG_Z, WRONG_DEG = 5.0, 0.5
WIDTH, HEIGHT, FOCAL, RATE = 1280, 720, 1100.0, 10.0

Path3 = Callable[[Array], Array]


def wandering(rng: np.random.Generator, size: float) -> Path3:
    """A path (n, 3) of times (n,) through a cube of this half side, 30 m before the cameras."""
    middle = np.array([0.0, 0.0, 30.0]) + rng.uniform(-0.4, 0.4, 3) * size
    waves = [(rng.uniform(0.15, 0.9), rng.uniform(0.0, 6.3, 3), rng.normal(0.0, 0.4 * size, 3)) for _ in range(3)]
    return lambda t: middle + sum(reach * np.sin(rate * t[:, None] + phase) for rate, phase, reach in waves)


def straight(rng: np.random.Generator, velocity: Array) -> Path3:
    """A straight path that is in the middle after ten seconds."""
    middle = np.array([0.0, 0.0, 30.0]) + rng.uniform(-5.0, 5.0, 3)
    return lambda t: middle + (t[:, None] - 10.0) * velocity


def degenerate(kind: str, rng: np.random.Generator) -> tuple[list[Array], list[list[Path3]], float, float]:
    """Centres of cameras, the paths that each sees, the duration, s, and how much later the last one records."""
    count = int(rng.integers(2, 4))
    centers = [np.array([8.0 * (k - 0.5 * (count - 1)), *rng.normal(0.0, 1.0, 2)]) for k in range(count)]
    paths = [wandering(rng, 8.0) for _ in range(int(rng.integers(1, 5)))]
    duration, late = 30.0, 0.0
    if kind == "still":
        paths = [straight(rng, np.zeros(3)) for _ in range(5)]
    elif kind == "one straight":
        paths = [straight(rng, rng.normal(0.0, 0.5, 3))]
    elif kind == "all alike":
        velocity = rng.normal(0.0, 0.4, 3)
        paths = [straight(rng, velocity) for _ in range(4)]
    elif kind == "hover":
        paths = [wandering(rng, 0.25)]
    elif kind == "one plane":
        paths = [lambda t, path=path: path(t) * [1.0, 0.0, 1.0] + [0.0, 4.0, 0.0] for path in paths]
    elif kind == "circle":
        rate, radius = rng.uniform(0.6, 2.0), rng.uniform(2.0, 6.0)
        paths = [lambda t: np.column_stack([radius * np.sin(rate * t), 0.0 * t, 30.0 + radius * np.cos(rate * t)])]
    elif kind == "one place":
        centers = [centers[0]] * count
    elif kind == "far":
        centers = [0.01 * center for center in centers]
    elif kind == "short":
        duration = float(rng.uniform(0.8, 2.5))
    elif kind == "other times":
        late = duration
    of_camera = [paths] * count
    if kind == "other scene":
        of_camera = [*of_camera[:-1], [wandering(rng, 8.0) for _ in paths]]
    return centers, of_camera, duration, late


def write_degenerate(kind: str, seed: int, folder: Path) -> tuple[Camera, ...]:
    """Write configuration and log of a scene, with clocks that are known or not; return the true cameras."""
    rng = np.random.default_rng([seed, 20261123])
    centers, of_camera, duration, late = degenerate(kind, rng)
    clocks, stated = bool(rng.random() < 0.5), FOCAL * (1.0 + rng.uniform(-0.03, 0.03))
    cameras = {
        f"cam{k}": {
            "image_size_px": [WIDTH, HEIGHT],
            "intrinsics": {"fx": FOCAL, "fy": FOCAL, "cx": (WIDTH - 1) / 2.0, "cy": (HEIGHT - 1) / 2.0},
            "pose": {"center": center.tolist(), "rotation_matrix": facing(center, np.array([0.0, 0.0, 30.0]))},
            "detector": {"sigma_px": [1.0, 1.0], "p_detect": 0.95, "clutter_per_frame": 0.5},
        }
        for k, center in enumerate(centers)
    }
    (folder / "true.yaml").write_text(yaml.safe_dump({"units": {"length": "m"}, "cameras": cameras}))
    true = tuple(config.build(name) for name, config in load_cameras(folder / "true.yaml").cameras.items())
    rows = []
    for number, (camera, paths) in enumerate(zip(true, of_camera, strict=True)):
        offset = rng.uniform(-100.0, 100.0) if clocks and number else 0.0
        is_last = number == len(true) - 1
        times = (late if is_last else 0.0) + np.arange(0.0, duration, 1.0 / RATE) + rng.uniform(0.0, 1.0 / RATE)
        seen = []
        for path in paths:
            points = (path(times) - camera.pose.center) @ camera.pose.rotation.T
            pixels = (
                points[:, :2] / points[:, 2:] * FOCAL + [camera.cx, camera.cy] + rng.normal(0.0, 1.0, (len(times), 2))
            )
            inside = (pixels > 0.0).all(axis=1) & (pixels < [WIDTH - 1, HEIGHT - 1]).all(axis=1)
            seen.append((pixels, inside & (points[:, 2] > 1.0) & (rng.random(len(times)) < 0.95)))
        for row, time_s in enumerate((times - offset).tolist()):
            found = [pixels[row] for pixels, inside in seen if inside[row]]
            found += list(rng.uniform(0.0, [WIDTH - 1, HEIGHT - 1], (rng.poisson(0.5), 2)))
            rows += [(time_s, camera.name, row, *pixel) for pixel in found or [(np.nan, np.nan)]]
    write_log(folder, rows)
    tree = {
        "units": {"length": "m"}, "seed": seed, "cameras": cameras, "disparity": {"baseline": 1.0},
        "motion": {"model": "constant_velocity", "acceleration_std": 2.0, "max_speed": 30.0},
        "filter": {"kind": "pmb", "birth": {"per_s": 0.1, "depth_range": [10.0, 90.0], "velocity_std": 4.0}},
        "calibration": {"reference": "cam0"},
    }  # fmt: skip
    write_unknown(folder, tree, [stated / FOCAL] * len(true), clocks)
    return true


def write_paper(seed: int, folder: Path) -> tuple[Camera, ...]:
    """Write configuration and log of the paper's scene before two to five cameras; return the true cameras."""
    rng = np.random.default_rng([seed, 20261123])
    tree, count = yaml.safe_load(PAPER.read_text()), 2 + seed % 4
    left = tree["cameras"]["left"]
    tree["cameras"] = {}
    for k in range(count):
        place = np.array([-20.0 + 40.0 * k / (count - 1), *(rng.normal(0.0, 3.0, 2) if k else np.zeros(2))])
        pose = {"center": place.tolist(), "rotation_matrix": facing(place, np.array([0.0, 0.0, 75.0]))}
        tree["cameras"][f"cam{k}"] = {**left, "pose": pose}
    del tree["calibration"]
    tree["seed"] = seed
    (folder / "simulated.yaml").write_text(yaml.safe_dump(tree))
    simulate(load_config(folder / "simulated.yaml"), folder / "scene", force=True)
    table = pq.read_table(folder / "scene" / "detections.parquet")
    offsets = {f"cam{k}": float(rng.uniform(-100.0, 100.0)) if k else 0.0 for k in range(count)}
    names = ("time_s", "camera", "frame", "u_px", "v_px")
    columns = [table[name].to_pylist() for name in names]
    nan = float("nan")
    write_log(folder, [
        (time_s - offsets[camera], camera, frame, nan if u is None else u, nan if v is None else v)
        for time_s, camera, frame, u, v in zip(*columns, strict=True)
    ])  # fmt: skip
    del tree["simulate"]
    tree["calibration"] = {"reference": "cam0"}
    write_unknown(folder, tree, (1.0 + rng.uniform(-0.05, 0.05, count)).tolist(), True)
    return tuple(config.build(name) for name, config in load_cameras(folder / "scene" / "cameras.yaml").cameras.items())


def write_unknown(folder: Path, tree: dict[str, Any], factors: list[float], clocks: bool) -> None:
    """Write the configuration of the calibration: no pose, focal lengths off by factors."""
    tree["calibration"]["priors"] = {name: {"focal_std": 0.03} for name in tree["cameras"]}
    for number, (camera, factor) in enumerate(zip(tree["cameras"].values(), factors, strict=True)):
        camera["pose"] = "unknown"
        camera["intrinsics"] = {**camera["intrinsics"], **{f: factor * camera["intrinsics"][f] for f in ("fx", "fy")}}
        if clocks and number:
            camera["clock"] = {"offset_s": "unknown"}
    (folder / "unknown.yaml").write_text(yaml.safe_dump(tree))


def errors_deg(found: tuple[Camera, ...], true: tuple[Camera, ...]) -> tuple[list[float], list[float]]:
    """Errors of rotations and of directions from the first camera."""
    turns, directions = [], []
    for one, other in zip(found[1:], true[1:], strict=True):
        relative = [c.pose.rotation @ first.pose.rotation.T for c, first in ((one, found[0]), (other, true[0]))]
        steps = [f.pose.rotation @ (c.pose.center - f.pose.center) for c, f in ((one, found[0]), (other, true[0]))]
        turns.append(float(np.rad2deg(np.linalg.norm(rotation_to_vector(relative[0] @ relative[1].T)))))
        cosine = steps[0] @ steps[1] / max(float(np.linalg.norm(steps[0]) * np.linalg.norm(steps[1])), 1e-12)
        directions.append(float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    return turns, directions


def one_run(seed: int, kind: str, folder: Path, search: bool) -> dict[str, Any]:
    """Write a scene, find its cameras, and compare with the truth."""
    true = write_degenerate(kind, seed, folder) if kind != "paper" else write_paper(seed, folder)
    row: dict[str, Any] = {"seed": seed, "kind": kind, "cameras": len(true)}
    loaded, since = load_config(folder / "unknown.yaml"), time.process_time()
    stds = [(0.5, 0.5)] * len(true)
    if search:
        _, found = with_found_cameras(loaded, folder / "log.parquet")
        assert found is not None
        row |= {"status": "undetermined" if found.reason else "determined", "reason": found.reason}
        cameras = None if found.rig is None else found.rig.cameras
    else:
        report = calibrate(loaded, folder / "log.parquet", folder / "out", jobs=1, plots=False, force=True)
        row |= {"status": report["status"], "reason": report["reason"]}
        cameras, path = None, folder / "out" / "cameras.yaml"
        if path.exists():
            cameras = tuple(config.build(name) for name, config in load_cameras(path).cameras.items())
            stds = [(of["rotation_std_deg"], of["direction_std_deg"]) for of in report["cameras"].values()]
    row["seconds"] = round(time.process_time() - since, 1)
    if cameras is not None:
        errors = errors_deg(cameras, true)
        row["rotation_deg"], row["direction_deg"] = (round(max(part), 3) for part in errors)
        each = zip(*errors, stds, strict=False)
        off = any(e > max(WRONG_Z * s, WRONG_DEG) for *two, std in each for e, s in zip(two, std, strict=True))
        row["wrong"] = row["status"] == "determined" and (off or kind in NO_ANSWER)
    return row


def main() -> int:
    """Run and print; 0 if no answer is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=22)
    parser.add_argument("--seed", type=int, default=0, help="run k has the seed SEED + k")
    parser.add_argument("--degenerate", action="store_true")
    parser.add_argument("--search", action="store_true", help="the search alone")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files of every run in DIR/SEED")
    options = parser.parse_args()
    rows = []
    for seed in range(options.seed, options.seed + options.runs):
        kind = KINDS[seed % len(KINDS)] if options.degenerate else "paper"
        with tempfile.TemporaryDirectory() as temporary:
            folder = options.keep / str(seed) if options.keep else Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            rows.append(one_run(seed, kind, folder, options.search))
        print(json.dumps(rows[-1]), flush=True)
    wrong = [row["seed"] for row in rows if row.get("wrong")]
    states = [row["status"] for row in rows]
    figures = {
        "runs": len(rows), "wrong": wrong, "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "status": {state: states.count(state) for state in sorted(set(states))},
        "below_3_and_4_deg": sum(
            row.get("rotation_deg", 90.0) < 3.0 and row.get("direction_deg", 90.0) < 4.0 for row in rows
        ),
    }  # fmt: skip
    print(json.dumps(figures, indent=2))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
