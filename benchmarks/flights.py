"""Two cameras over a drone, stated as their makers state them: is what `calibrate` finds as sure as it states?

    python benchmarks/flights.py --seeds 600 12              one line of JSON a flight, then a summary
    python benchmarks/flights.py --seeds 607 1 --keep DIR    keep configuration, log and results in DIR/607
    python benchmarks/flights.py --white                     the drone moves by white acceleration, as filters assume

A seed draws the flight: images of 640 or 1280 px, focal lengths of 1.0 to 1.6 widths, k1 of -0.2 to -0.45, cameras of
10 to 30 Hz that are not synchronised and stand 12 to 56 m apart, one drone at 100 to 160 m from both for 90 to 230 s
with up to 12 m/s, which hovers at times, noise of 0.1 to 0.5 px, gaps, clutter and outliers. Stated are no lens, focal
lengths that are 1 to 4 % and principal points that are 5 to 20 px off, clocks that agree (3 to 30 ms off), a pose that
is 2 m and 5 degrees off, with priors of 1.2 m and 3 degrees, and the distance of the cameras to 0.05 m. All else is as
`init --preset drones` writes it.

Scored are points of the truth where the rays of the calibrated cameras meet, at one time by their clocks: the median
distance from the truth after a rigid alignment and without any, and the median of what the covariance of the cameras
states of each. An answer is wrong that is `determined` and more than three times as far off as it states. A mistake
that `init` names before the calibration (`must_be_corrected`) is none, and is counted.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import facing, measured_distance, rows_of_seeds, write_log

# isort: split
import numpy as np
import yaml
from scipy.interpolate import CubicSpline

from stereophd.commands.calibrate import calibrate
from stereophd.commands.init import init
from stereophd.config.loading import load_cameras, load_config
from stereophd.core.alignment.start import turns_between
from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.considered import CameraUncertainty
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.geometry.projection import nearest_points
from stereophd.core.geometry.rotations import cross_matrices
from stereophd.pipeline.cameras_covariance import stated_uncertainty

# Parts of what is stated beyond which a `determined` answer is wrong, and the largest error of a good one, m.
WRONG, GOOD_M = 3.0, 3.0
# How far the pose is off, its prior, and the standard deviation of the distance of the cameras.
OFF_M, OFF_DEG, PRIOR, DISTANCE_STD = 2.0, 5.0, {"center_std": 1.2, "rotation_std_deg": 3.0}, 0.05
# Distances of the drone from the cameras; time between the knots of its path, and how far wind moves them.
NEAREST_M, FARTHEST_M, KNOT_S, WIND_M = 100.0, 160.0, 2.0, 0.1
# White acceleration, m/s^2, of a drone that a spring holds near the middle: rate, 1/s, and damping; step of time, s.
WHITE, SPRING, DAMPING, WHITE_S = 1.2, 0.15, 0.7, 0.05
# Step of a derivative, in standard deviations.
SMALL = 1e-3


def unit(rng: np.random.Generator, size: int) -> Array:
    """A random direction (size,)."""
    direction = rng.standard_normal(size)
    return np.asarray(direction / np.linalg.norm(direction))


def described(size: tuple[int, int], focal: float, principal: Array, center: Array, rotation: Array) -> dict[str, Any]:
    """A camera as a configuration has it, without a lens."""
    intrinsics = dict(zip(("fx", "fy", "cx", "cy"), (float(focal), float(focal), *principal.tolist()), strict=True))
    pose = {"center": center.tolist(), "rotation_matrix": rotation.tolist()}
    return {"image_size_px": list(size), "intrinsics": intrinsics, "pose": pose}


def draw_cameras(rng: np.random.Generator) -> tuple[dict[str, Any], dict[str, Any]]:
    """True cameras, and cameras as stated, of a flight."""
    width = int(rng.choice([640, 1280]))
    size, focal, k1 = (width, width * 3 // 4), width * rng.uniform(1.03, 1.55), rng.uniform(-0.43, -0.21)
    climb, late_s = rng.uniform(0.15, 0.6), float(rng.choice([-1.0, 1.0]) * rng.uniform(0.003, 0.03))
    target = 0.5 * (NEAREST_M + FARTHEST_M) * np.array([0.0, -math.sin(climb), math.cos(climb)])
    side = rng.uniform(12.0, 56.0) * np.array([0.5, *rng.uniform(-0.05, 0.05, 2)])
    true: dict[str, Any] = {}
    stated: dict[str, Any] = {}
    for name, center, offset_s in (("cam0", -side, 0.0), ("cam1", side, late_s)):
        one, principal = focal * rng.uniform(0.97, 1.03), 0.5 * (np.array(size) - 1.0)
        rotation = np.array(facing(center, target + rng.normal(0.0, 4.0, 3)))
        true[name] = {
            **described(size, one, principal + rng.uniform(5.0, 20.0) * unit(rng, 2), center, rotation),
            "distortion": {"model": "radial", "k1": float(np.clip(k1 * rng.normal(1.0, 0.05), -0.45, -0.2))},
            "clock": {"offset_s": offset_s},
        }
        if name == "cam1":
            center = center + OFF_M * unit(rng, 3)
            rotation = rotation_from_vector(np.deg2rad(OFF_DEG) * unit(rng, 3)) @ rotation
        one *= 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.04)
        stated[name] = described(size, one, principal, center, rotation)
    return true, stated


def draw_place(rng: np.random.Generator, cameras: Sequence[Camera]) -> Array:
    """A place (3,) that all cameras see, neither near nor far."""
    while True:
        pixel = rng.uniform(0.0, [[cameras[0].width, cameras[0].height]])
        place = cameras[0].unproject(pixel, rng.uniform([0.8 * NEAREST_M], [FARTHEST_M]))
        away = np.array([np.linalg.norm(place[0] - camera.pose.center) for camera in cameras])
        seen = all(camera.contains(camera.project(place), -0.03 * camera.width)[0] for camera in cameras)
        if seen and away.min() >= NEAREST_M and away.max() <= FARTHEST_M:
            return np.asarray(place[0])


def draw_path(rng: np.random.Generator, cameras: Sequence[Camera], duration_s: float) -> CubicSpline:
    """A path of places (n, 3) at times (n,), s, from place to place in the view of all cameras."""
    times, places = [-KNOT_S], [draw_place(rng, cameras)]
    while times[-1] <= duration_s + KNOT_S:
        goal = draw_place(rng, cameras)
        times.append(times[-1] + KNOT_S + float(np.linalg.norm(goal - places[-1])) / rng.uniform(3.0, 12.0))
        places.append(goal)
        if rng.random() < 0.3:  # it hovers
            times.append(times[-1] + rng.uniform(4.0, 15.0))
            places.append(goal)
    knots = np.arange(-KNOT_S, duration_s + 2.0 * KNOT_S, KNOT_S)
    along = np.column_stack([np.interp(knots, times, axis) for axis in np.transpose(places)])
    return CubicSpline(knots, along + rng.normal(0.0, WIND_M, along.shape))


def white_path(rng: np.random.Generator, cameras: Sequence[Camera], duration_s: float) -> CubicSpline:
    """A path as `draw_path` returns it, of white acceleration: 12 m about its middle and 1.8 m/s on each axis."""
    middle = np.mean([draw_place(rng, cameras) for _ in range(200)], axis=0)
    times = np.arange(-KNOT_S, duration_s + 2.0 * KNOT_S, WHITE_S)
    places, velocity = np.zeros((len(times), 3)), np.zeros(3)
    for k, push in enumerate(WHITE * math.sqrt(WHITE_S) * rng.standard_normal((len(times) - 1, 3))):
        velocity = velocity + push - WHITE_S * (SPRING**2 * places[k] + 2.0 * DAMPING * SPRING * velocity)
        places[k + 1] = places[k] + WHITE_S * velocity
    return CubicSpline(times, middle + places)


def detections(
    rng: np.random.Generator, camera: Camera, path: CubicSpline, duration_s: float, noise_px: float
) -> list[tuple[Any, ...]]:
    """Rows of the log of a camera."""
    rate = rng.uniform(10.0, 30.0)
    times = np.arange(rng.uniform(0.0, 1.0 / rate), duration_s, 1.0 / rate)
    pixels = camera.project(path(times)) + rng.normal(0.0, noise_px, (len(times), 2))
    off = rng.random(len(times)) < rng.uniform(0.0, 0.03)
    pixels[off] += rng.uniform(-30.0, 30.0, (int(off.sum()), 2))
    seen = camera.contains(pixels) & (rng.random(len(times)) < rng.uniform(0.85, 0.99))
    for begin in rng.uniform(0.0, duration_s, rng.integers(0, 4)):
        seen &= (times < begin) | (times > begin + rng.uniform(2.0, 10.0))
    clutter, size = rng.poisson(rng.uniform(0.02, 0.3), len(times)), [camera.width, camera.height]
    rows = []
    for frame, log_s in enumerate(camera.clock.to_log(times).tolist()):
        found = [*pixels[[frame]][seen[[frame]]], *rng.uniform(-0.5, np.subtract(size, 0.5), (clutter[frame], 2))]
        rows += [(log_s, camera.name, frame, *pixel) for pixel in found or [(np.nan, np.nan)]]
    return rows


def write_flight(seed: int, starts: int, white: bool, folder: Path) -> tuple[CubicSpline, dict[str, Any]]:
    """Write true cameras, log and configuration of a flight; return its path and what was drawn."""
    rng = np.random.default_rng([seed, 20261126])
    for name, tree in zip(("true", "stated"), draw_cameras(rng), strict=True):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump({"units": {"length": "m"}, "cameras": tree}))
    cameras, duration_s, noise_px = built(folder / "true.yaml"), rng.uniform(90.0, 230.0), rng.uniform(0.1, 0.5)
    path = (white_path if white else draw_path)(rng, cameras, duration_s)
    write_log(folder, [row for camera in cameras for row in detections(rng, camera, path, duration_s, noise_px)])
    first = init(folder / "init", folder / "log.parquet", folder / "stated.yaml", kind="drones", force=True)
    tree = yaml.safe_load((folder / "init" / "config.yaml").read_text())
    apart = float(np.linalg.norm(cameras[1].pose.center - cameras[0].pose.center))
    distance = {"distance": measured_distance(apart, DISTANCE_STD, seed), "std": DISTANCE_STD}
    tree["calibration"] = {
        "reference": "cam0", "priors": {"cam1": PRIOR}, "annealed": {"starts": starts},
        "scale": {"kind": "baseline", "cameras": ["cam0", "cam1"], **distance},
    }  # fmt: skip
    (folder / "config.yaml").write_text(yaml.safe_dump(tree))
    return path, {
        "width": cameras[0].width, "apart_m": round(apart, 1), "noise_px": round(noise_px, 2),
        "duration_s": round(duration_s), "k1": [round(float(camera.lens.coefficients[0]), 3) for camera in cameras],
        "clock_ms": round(1e3 * cameras[1].clock.offset_s, 1), "is_called_mistaken": first["must_be_corrected"],
    }  # fmt: skip


def built(path: Path) -> tuple[Camera, ...]:
    """Return the cameras of a file."""
    return tuple(config.build(name) for name, config in load_cameras(path).cameras.items())


def rays_meet(found: Sequence[Camera], true: Sequence[Camera], path: CubicSpline, times: Array) -> Array:
    """Points (n, 3) where the rays of cameras meet at times (n,) of their clocks; NaN where one sees nothing."""
    rays = []
    for camera, other in zip(found, true, strict=True):
        pixels = other.project(path(other.clock.to_true(camera.clock.to_log(times))))
        pixels[~other.contains(pixels)] = np.nan
        rays.append(camera.rays(pixels) @ camera.pose.rotation)
    centers = np.repeat([camera.pose.center for camera in found], len(times), axis=0)
    return nearest_points(np.concatenate(rays), centers, np.tile(np.arange(len(times)), len(rays)), len(times))


def score(uncertainty: CameraUncertainty, true: Sequence[Camera], path: CubicSpline) -> dict[str, tuple[float, float]]:
    """Median errors, and medians of what is stated of them, m, after a rigid alignment and without any."""
    cameras, times = uncertainty.parameters, np.arange(0.0, path.x[-1] - KNOT_S, 0.5)
    ends = [
        rays_meet(cameras.build(step), true, path, times)
        for step in SMALL * np.vstack([uncertainty.root.T, -uncertainty.root.T])
    ]
    points, moves = rays_meet(cameras.cameras, true, path, times), np.stack(ends, axis=2)
    known = np.isfinite(moves).all(axis=(1, 2)) & np.isfinite(points).all(axis=1)
    points, truth = points[known], path(times[known])
    moves = (moves[known, :, : cameras.size] - moves[known, :, cameras.size :]) / (2.0 * SMALL)
    middle, target = points.mean(axis=0), truth.mean(axis=0)
    left, right, _ = turns_between(((truth - target).T @ (points - middle))[None])
    # what a rigid motion of all points takes away of small moves
    rigid = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), cross_matrices(points - middle)], axis=2)
    basis, flat = rigid.reshape(-1, 6), moves.reshape(-1, cameras.size)
    left_over = (flat - basis @ np.linalg.lstsq(basis, flat)[0]).reshape(moves.shape)
    errors = (points - middle) @ (left[0] @ right[0]).T + target - truth, points - truth
    return {
        name: (float(np.median(np.linalg.norm(error, axis=1))), float(np.median(np.sqrt((moved**2).sum(axis=(1, 2))))))
        for name, error, moved in zip(("aligned_m", "not_aligned_m"), errors, (left_over, moves), strict=True)
    }


def one_run(seed: int, starts: int, white: bool, folder: Path, changes: Sequence[str] = ()) -> dict[str, Any]:
    """Draw a flight, calibrate its cameras, and compare with the truth."""
    path, drawn = write_flight(seed, starts, white, folder)
    row, since = {"seed": seed, **drawn}, time.process_time()
    loaded = load_config(folder / "config.yaml", changes)
    report = calibrate(loaded, folder / "log.parquet", folder / "out", jobs=1, plots=False, force=True)
    row |= {"status": report["status"], "reason": report["reason"], "seconds": round(time.process_time() - since, 1)}
    if not (folder / "out" / "cameras.yaml").exists():
        return row
    cameras, rows = built(folder / "out" / "cameras.yaml"), load_cameras(folder / "out" / "cameras.yaml").covariance
    uncertainty = stated_uncertainty(cameras, rows)
    assert uncertainty is not None
    scores = score(uncertainty, built(folder / "true.yaml"), path)
    row |= {name: [float(f"{value:.2g}") for value in pair] for name, pair in scores.items()}
    row["ratio"] = round(max(error / stated for error, stated in scores.values()), 2)
    row["k1_found"] = [round(float(camera.lens.coefficients[0]), 3) for camera in cameras]
    row["clock_found_ms"] = round(1e3 * cameras[1].clock.offset_s, 1)
    return row


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of all flights."""
    done, states = [row for row in rows if "ratio" in row], [row["status"] for row in rows]
    beyond = [row for row in done if row["ratio"] > WRONG]
    return {
        "flights": len(rows),
        "status": {state: states.count(state) for state in sorted(set(states))},
        "beyond_3_of_what_is_stated": [row["seed"] for row in beyond],
        "wrong": [row["seed"] for row in beyond if row["status"] == "determined"],
        "mistakes_that_are_none": [row["seed"] for row in rows if row["is_called_mistaken"]],
        "aligned_m_median": float(np.median([row["aligned_m"][0] for row in done])) if done else None,
        "within_3_m": sum(row["aligned_m"][0] <= GOOD_M for row in done),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print; 0 if no answer is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs=2, default=(600, 10), metavar=("FIRST", "COUNT"))
    parser.add_argument("--starts", type=int, default=1, help="starts of the calibration")
    parser.add_argument("--white", action="store_true", help="the acceleration of the drone is white")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files of every flight in DIR/SEED")
    parser.add_argument("--set", action="append", default=[], dest="changes", metavar="KEY=VALUE")
    options = parser.parse_args(arguments)
    seeds = range(options.seeds[0], sum(options.seeds))
    rows = rows_of_seeds(
        seeds, options.keep,
        lambda seed, folder: one_run(seed, options.starts, options.white, folder, options.changes),
    )  # fmt: skip
    figures = summary(rows)
    print(json.dumps(figures, indent=2))
    return 1 if figures["wrong"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
