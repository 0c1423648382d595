"""Accuracy of `calibrate` over many simulated scenes, beside the Cramer-Rao bound.

Every run draws another scene and another guess of the cameras (so that the truth is a draw from the prior),
calibrates, and compares with the true cameras. With --ospa the scene is also tracked with the calibrated cameras
(moved to the true scale) and with the true ones.

    python benchmarks/calibration_monte_carlo.py                                   the paper's priors: 20 runs
    python benchmarks/calibration_monte_carlo.py --prior-factor 3                  priors three times as wide
    python benchmarks/calibration_monte_carlo.py --baseline-std 0.1                with a known baseline
    python benchmarks/calibration_monte_carlo.py --set calibration.method=sequential
    python benchmarks/calibration_monte_carlo.py --config configs/three_cameras_calibration.yaml --runs 10
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import with_measured_distance

# isort: split
import numpy as np
import pyarrow.parquet as pq

from stereophd.commands.calibrate import calibrate
from stereophd.commands.evaluate import evaluate
from stereophd.commands.evaluate_cameras import evaluate_calibration, read_posterior
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import LoadedConfig, load_cameras, load_config
from stereophd.core.arrays import Array
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.geometry.pose import Pose
from stereophd.core.numerics.weights import weighted_mean_covariance
from stereophd.io.cameras.writing import write_cameras
from stereophd.pipeline.calibration.configured_unknowns import prior_stds, with_quantities

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "calibration.yaml"
# In units of the bound on its root mean square: what counts as success.
SUCCESS = 5.0
# Part of its median within which an estimate's range counts for the scale.
SAME_RANGE = 0.1
# Angle from the reference camera within which an estimate is of an object, rad.
SAME_DIRECTION = 0.01


def overrides(options: argparse.Namespace) -> list[str]:
    """Overrides of the configuration that the options mean."""
    out = list(options.set or [])
    loaded = load_config(options.config, out)
    section = loaded.config.calibration
    assert section is not None
    for name in section.priors:
        for quantity in quantities():
            key = quantity.prior
            scale = options.prior_factor / quantity.prior_unit
            spread = [scale * std for std in prior_stds(section, name, quantity)]
            if not any(spread):
                continue
            given = dict(zip(quantity.components, spread, strict=True)) if quantity.named else spread
            out += [f"calibration.priors.{name}.{key}={given if len(spread) > 1 else spread[0]}"]
    if options.baseline_std is not None:
        cameras = {camera.name: camera for camera in loaded.build_cameras()}
        other = next(iter(section.priors))
        distance = np.linalg.norm(cameras[section.reference].pose.center - cameras[other].pose.center)
        out.append(
            f"calibration.scale={{kind: baseline, cameras: [{section.reference}, {other}], "
            f"distance: {float(distance)!r}, std: {options.baseline_std}}}"
        )
    return out


def one_run(options: argparse.Namespace, changes: Sequence[str], run: int, folder: Path) -> dict[str, Any]:
    """Simulate, calibrate, and score one scene."""
    seed = options.seed + run
    changes = with_measured_distance(options.config, changes, seed)
    scene, out = folder / "scene", folder / "calibrated"
    simulate(load_config(options.config, changes, seed), scene)
    log, true = scene / "detections.parquet", scene / "cameras.yaml"
    loaded = load_config(options.config, changes, seed, scene / "guess.yaml")
    since = time.perf_counter()
    report = calibrate(loaded, log, out, jobs=options.jobs, plots=False)
    row: dict[str, Any] = {"run": run, "status": report["status"], "seconds": time.perf_counter() - since}
    row["starts"] = len(report.get("starts", []))
    if not (out / "posterior.parquet").exists():
        return row
    if not (out / "cameras.yaml").exists():
        # not to be trusted, but how far off is it?
        posterior = read_posterior(out / "posterior.parquet")
        assert posterior is not None
        mean, _ = weighted_mean_covariance(posterior.particles, posterior.log_weights)
        cameras = with_quantities(loaded.cameras, posterior.parameters.build(mean))
        write_cameras(out / "cameras.yaml", cameras, loaded.config.units.length)
    truth = load_config(options.config, changes, seed, true)
    scores = evaluate_calibration(out / "cameras.yaml", true, loaded=truth)
    row["scale_ratio"] = report["scale"]["posterior_over_prior_std"]
    row["nees"], row["covered_90"] = scores["posterior"]["nees"], scores["posterior"]["covered_90"]
    row["cameras"] = {
        name: {
            **errors,
            **{f"{key}_bound": scores["bounds"]["cameras"][name][key] for key in ("rotation_deg", "direction_deg")},
            "center_bound": scores["bounds"]["cameras"][name]["center"],
        }
        for name, errors in scores["cameras"].items()
    }
    row["success"] = all(
        c[key] < SUCCESS * c[f"{key}_bound"]
        for c in row["cameras"].values()
        for key in ("rotation_deg", "direction_deg")
    )
    if options.ospa and row["status"] != "undetermined":
        row["ospa"] = compare_tracking(loaded, truth, changes, scene, out, folder)
    return row


def compare_tracking(
    loaded: LoadedConfig, truth: LoadedConfig, changes: Sequence[str], scene: Path, out: Path, folder: Path
) -> dict[str, float]:
    """Mean OSPA with the calibrated cameras, the free scale removed, and with the true ones."""
    section = loaded.config.calibration
    assert section is not None
    estimated = load_cameras(out / "cameras.yaml").cameras
    cameras = [camera.build(name) for name, camera in estimated.items()]
    origin = next(c.pose.center for c in cameras if c.name == section.reference)
    scale = scene_scale(out / "tracks.parquet", scene / "truth.parquet", origin)
    moved = [replace(c, pose=Pose(c.pose.rotation, origin + (c.pose.center - origin) * scale)) for c in cameras]
    scaled = folder / "scaled.yaml"
    write_cameras(scaled, with_quantities(estimated, moved), loaded.config.units.length)
    scores = {}
    for name, path in (("calibrated", scaled), ("true", scene / "cameras.yaml")):
        tracked = folder / f"tracked-{name}"
        track(load_config(loaded.path, changes, truth.config.seed, path), scene / "detections.parquet", tracked)
        result = evaluate(tracked / "tracks.parquet", scene / "truth.parquet", plots=False)
        scores[name] = float(result["ospa"]["mean"])
    return scores


def scene_scale(tracks: Path, truth: Path, origin: Array) -> float:
    """Factor about the reference camera that fits estimated positions to the true ones best (least squares).

    Estimates and objects are matched by their direction from the reference camera, which does not depend on scale;
    estimates whose range is far from that of most others (tracks that just began) do not count.
    """
    estimates, objects = pq.read_table(tracks), pq.read_table(truth)
    found = np.column_stack([estimates[axis].to_numpy() for axis in "xyz"]) - origin
    true = np.column_stack([objects[axis].to_numpy() for axis in "xyz"]) - origin
    times, true_times = estimates["time_s"].to_numpy(), objects["time_s"].to_numpy()
    pairs = []
    for time_s in np.unique(times):
        x, y = found[times == time_s], true[true_times == time_s]
        if not len(y):
            continue
        cosine = (x / np.linalg.norm(x, axis=1)[:, None]) @ (y / np.linalg.norm(y, axis=1)[:, None]).T
        near = cosine.max(axis=1) > np.cos(SAME_DIRECTION)
        # in units of the true range: near and far objects count alike
        pairs.append(
            np.column_stack([np.linalg.norm(x, axis=1), np.linalg.norm(y[cosine.argmax(axis=1)], axis=1)])[near]
        )
    ranges = np.concatenate([*pairs, np.empty((0, 2))])
    if not len(ranges):
        return 1.0
    ratios = ranges[:, 0] / ranges[:, 1]
    ratios = ratios[np.abs(ratios / np.median(ratios) - 1.0) < SAME_RANGE]
    return float(ratios.sum() / (ratios**2).sum())


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of all runs."""
    done = [row for row in rows if "cameras" in row]
    cameras = [camera for row in done for camera in row["cameras"].values()]

    def ratios(key: str) -> np.ndarray[Any, Any]:
        return np.array([camera[key] / camera[f"{key}_bound"] for camera in cameras])

    figures: dict[str, Any] = {
        "runs": len(rows),
        "undetermined": sum(row["status"] == "undetermined" for row in rows),
        "within_5_bounds": sum(row["success"] for row in done if row["status"] != "undetermined"),
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "seconds_most": max(row["seconds"] for row in rows),
    }
    if done:
        for key in ("rotation_deg", "direction_deg", "center"):
            values = np.array([camera[key] for camera in cameras])
            figures[key] = {
                "median": float(np.median(values)),
                "most": float(values.max()),
                "bound_median": float(np.median([camera[f"{key}_bound"] for camera in cameras])),
                "over_bound_median": float(np.median(ratios(key))),
                "over_bound_most": float(ratios(key).max()),
            }
        figures["covered_90"] = float(np.mean([row["covered_90"] for row in done]))
        figures["nees_mean"] = float(np.mean([row["nees"] for row in done if row["nees"] is not None]))
        scale = [row["scale_ratio"] for row in done if row["scale_ratio"] is not None]
        figures["scale_posterior_over_prior_least"] = min(scale) if scale else None
    ospa = [row["ospa"] for row in done if "ospa" in row]
    if ospa:
        figures["ospa_calibrated_mean"] = float(np.mean([one["calibrated"] for one in ospa]))
        figures["ospa_true_mean"] = float(np.mean([one["true"] for one in ospa]))
    return figures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print; 0 if all runs are within 5 bounds or say that they are undetermined, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    parser.add_argument("--seed", type=int, default=1000, help="run k has the seed SEED + k")
    parser.add_argument("--prior-factor", type=float, default=1.0, help="factor on the standard deviations")
    parser.add_argument("--baseline-std", type=float, help="know the first camera's distance, to this std")
    parser.add_argument("--ospa", action="store_true", help="compare tracking with true cameras")
    parser.add_argument("--set", action="append", metavar="KEY=VALUE", help="override of the configuration")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", action="store_true", help="every run as JSON, not only the summary")
    options = parser.parse_args(arguments)
    changes = overrides(options)
    rows = []
    for run in range(options.first, options.first + options.runs):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(one_run(options, changes, run, Path(folder)))
        print(json.dumps(rows[-1]) if options.json else brief(rows[-1]), flush=True)
    figures = summary(rows)
    print(json.dumps(figures, indent=2))
    return 0 if figures["within_5_bounds"] + figures["undetermined"] == len(rows) else 1


def brief(row: dict[str, Any]) -> str:
    """One line of a run."""
    cameras = "  ".join(
        f"{name}: rotation {c['rotation_deg']:.3f}/{c['rotation_deg_bound']:.3f} deg, "
        f"direction {c['direction_deg']:.3f}/{c['direction_deg_bound']:.3f} deg, center {c['center']:.2f}"
        for name, c in row.get("cameras", {}).items()
    )
    return f"{row['run']:3d} {row['status']}, {row['starts']} starts, {row['seconds']:.1f} s  {cameras}"


if __name__ == "__main__":
    raise SystemExit(main())
