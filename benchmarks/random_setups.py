"""Accuracy of `calibrate` over set-ups that are drawn at random: how often is an answer wrong that is called right?

The tables of `calibration_unknowns.py` draw scenes of one set-up. Here every run draws the set-up too: two to five
cameras in a row or around the scene, their images, lenses, frame rates and noise, one to twenty objects, their speed
and manoeuvres, clutter and missed detections, and which of lenses and clocks are unknown, with what priors. The guess
of the cameras is a draw from those priors, so a posterior that is right covers the truth as often as it says. A run
is a silent error where the status is `determined`, and the truth is far outside what is stated. The bound counts
what was freed as unknown.

    python benchmarks/random_setups.py --runs 50             one line of JSON a run, then a summary
    python benchmarks/random_setups.py --seed 7 --runs 1 --keep DIR     keep configuration, log and results of run 7
    python benchmarks/random_setups.py --misstated           noise, detection, clutter, lenses and clocks stated wrong
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import DrawnScene, measured_distance, rows_of_seeds

# isort: split
import numpy as np
import yaml

from stereophd.commands.calibrate import calibrate
from stereophd.commands.evaluate_cameras import evaluate_calibration
from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.core.calibration.unknowns.held import ASPECT_STD, FOCAL_STD, LENS_STD, RATE_STD

# Standard deviations beyond which an error of a parameter is wrong: one in 90,000 sets of 20 right ones.
WRONG_Z = 5.0
# Wide priors of the bound for what `calibrate` frees because the data contradict it.
FREED = {
    **{name: f"distortion_std.{name}={std}" for name, std in LENS_STD.items()},
    "focal": f"focal_std={FOCAL_STD}", "aspect": f"aspect_std={ASPECT_STD}", "readout": "readout_std_s=0.03",
    "principal_point_u": "principal_point_std_px=20", "principal_point_v": "principal_point_std_px=20",
    "clock_offset": "clock_offset_std_s=1", "clock_rate": f"clock_rate_std={RATE_STD}",
}  # fmt: skip
# Standard deviation of a distance that is stated as known, in parts of it.
KNOWN_DISTANCE = 0.003


def draw(seed: int, misstated: bool) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Configuration of the simulation, that of the calibration, and what was drawn, of a run."""
    rng = np.random.default_rng([seed, 20261122])
    count = int(rng.integers(2, 6))
    size = 10.0 ** rng.uniform(0.0, 1.5)  # half the side of the scene, m
    layout = str(rng.choice(["row", "ring"]))
    distance = size * rng.uniform(2.0, 4.0)
    scene = DrawnScene(rng, count, size, distance, layout)
    start = rng.uniform(-math.pi, math.pi)
    objects = int(rng.choice([1, 2, 3, 6, 12, 20]))
    speed = size * rng.uniform(0.1, 0.5)
    time_constant = float(rng.uniform(1.0, 4.0))
    frames = int(rng.integers(80, 250))
    rate = float(rng.choice([5.0, 10.0, 25.0, 30.0]))
    clocks, lenses = bool(rng.random() < 0.4), str(rng.choice(["known", "focal", "focal, k1, principal point"]))
    known = str(rng.choice(["baseline", "prior"]))
    cameras, priors = {}, {}
    for k in range(count):
        place = scene.place(k, start)
        sigma = float(rng.uniform(0.3, 2.0))
        k1 = float(rng.uniform(-0.2, 0.1)) if "k1" in lenses else 0.0
        own_rate = rate if rng.random() < 0.6 else float(rate * rng.choice([0.5, 0.7, 0.999]))
        cameras[f"cam{k}"] = {
            **scene.camera(*place),
            "distortion": {"model": "brown_conrady", "k1": k1},
            "detector": {
                "sigma_px": [sigma, sigma],
                "p_detect": float(rng.uniform(0.7, 0.99)),
                "clutter_per_frame": float(rng.choice([0.05, 0.5, 2.0, 5.0])),
            },
            "frame_rate_hz": own_rate,
            "phase_s": float(rng.uniform(0.0, 1.0 / own_rate)),
        }
        prior: dict[str, Any] = {}
        if k:
            prior["center_std"] = float(distance * rng.uniform(0.01, 0.08))
            prior["rotation_std_deg"] = float(rng.uniform(0.5, 6.0))
            if clocks:
                prior["clock_offset_std_s"] = float(rng.uniform(0.02, 0.5))
                if rng.random() < 0.5:
                    prior["clock_rate_std"] = 1e-3
        if lenses != "known":
            prior["focal_std"] = float(rng.uniform(0.01, 0.1))
        if "k1" in lenses:
            prior["distortion_std"] = {"k1": 0.1}
            prior["principal_point_std_px"] = 10.0
        if prior:
            priors[f"cam{k}"] = prior
    calibration: dict[str, Any] = {"reference": "cam0", "priors": priors}
    if known == "baseline":
        apart = math.dist(cameras["cam0"]["pose"]["center"], cameras["cam1"]["pose"]["center"])
        std = KNOWN_DISTANCE * apart
        calibration["scale"] = {
            "kind": "baseline", "cameras": ["cam0", "cam1"], "distance": measured_distance(apart, std, seed),
            "std": std,
        }  # fmt: skip
    tree = {**scene.tree(seed, cameras, objects, speed, time_constant, frames / rate), "calibration": calibration}
    stated = json.loads(json.dumps(tree))
    if misstated:
        for camera in stated["cameras"].values():
            detector = camera["detector"]
            detector["sigma_px"] = [detector["sigma_px"][0] * float(np.exp(rng.normal(0.0, 1.0)))] * 2
            detector["p_detect"] = float(np.clip(detector["p_detect"] + rng.normal(0.0, 0.1), 0.4, 0.99))
            detector["clutter_per_frame"] *= float(np.exp(rng.normal(0.0, 0.7)))
        stated["motion"]["acceleration_std"] *= float(np.exp(rng.normal(0.0, 0.5)))
        # lenses of a data sheet that says nothing of them, and a clock that was set by hand
        lens, late = float(rng.uniform(-0.4, 0.1)), float(rng.uniform(-1.0, 1.0) / rate)
        if rng.random() < 0.5:
            for camera in cameras.values():
                camera["distortion"]["k1"] = lens * (1.0 + float(rng.normal(0.0, 0.05)))
            for camera in stated["cameras"].values():
                del camera["distortion"]
            for prior in stated["calibration"]["priors"].values():
                prior.pop("distortion_std", None)
        if not clocks and rng.random() < 0.3:
            cameras[f"cam{count - 1}"]["clock"] = {"offset_s": late, "rate": 1.0}
    drawn = {
        "cameras": count, "layout": layout, "objects": objects, "frames": frames, "rate_hz": rate, "clocks": clocks,
        "lenses": lenses, "scale": known,
    }  # fmt: skip
    return tree, stated, drawn


def one_run(seed: int, misstated: bool, folder: Path) -> dict[str, Any]:
    """Simulate, calibrate, and compare with the truth."""
    tree, stated, row = draw(seed, misstated)
    row = {"seed": seed, **row}
    for name, content in (("simulated", tree), ("stated", stated)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    scene, out = folder / "scene", folder / "calibrated"
    simulate(load_config(folder / "simulated.yaml"), scene, force=True)
    guess = yaml.safe_load((scene / "guess.yaml").read_text())
    if misstated:
        for name, camera in guess["cameras"].items():
            camera["detector"] = stated["cameras"][name]["detector"]
            camera["distortion"] = stated["cameras"][name].get("distortion", {"model": "none"})
            if not row["clocks"]:
                camera.pop("clock", None)
        (scene / "guess.yaml").write_text(yaml.safe_dump(guess))
    loaded = load_config(folder / "stated.yaml", (), seed, scene / "guess.yaml")
    since = time.process_time()
    report = calibrate(loaded, scene / "detections.parquet", out, jobs=1, plots=False, force=True)
    row |= {"status": report["status"], "reason": report["reason"], "seconds": round(time.process_time() - since, 1)}
    row["said"] = [f["name"] for f in report["checks"] if f["name"].startswith("calibration.")]
    if not (out / "cameras.yaml").exists():
        return row
    true = scene / "cameras.yaml"
    # the bound of an answer is that of the unknowns that it has
    freed = [name.rsplit(".", 1) for name in report["freed"]]
    priors = [f"calibration.priors.{camera}.{FREED[component]}" for camera, component in freed]
    scores = evaluate_calibration(
        out / "cameras.yaml", true, loaded=load_config(folder / "simulated.yaml", priors, seed, true)
    )
    posterior = scores["posterior"]
    row["nees"], row["covered_90"] = posterior["nees"], posterior["covered_90"]
    row["rotation_deg"] = max(c["rotation_deg"] for c in scores["cameras"].values())
    row["direction_deg"] = max(c["direction_deg"] for c in scores["cameras"].values())
    bounds = scores["bounds"]["cameras"]
    row["over_bound"] = max(
        scores["cameras"][name][key] / bounds[name][key] for name in bounds for key in ("rotation_deg", "direction_deg")
    )
    row["largest_z"] = max(abs(p["error"] / p["std"]) for p in posterior["parameters"].values())
    row["silent_error"] = row["status"] == "determined" and row["largest_z"] > WRONG_Z
    return row


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of all runs."""
    done = [row for row in rows if "nees" in row]
    by_status: dict[str, int] = {}
    for row in rows:
        by_status[row["status"]] = by_status.get(row["status"], 0) + 1
    return {
        "runs": len(rows),
        "status": by_status,
        "silent_errors": [row["seed"] for row in done if row["silent_error"]],
        "wrong_but_called_partly_determined": [
            row["seed"] for row in done if row["status"] != "determined" and row["largest_z"] > WRONG_Z
        ],
        "nees_median": float(np.median([row["nees"] for row in done])) if done else None,
        "covered_90": float(np.mean([row["covered_90"] for row in done])) if done else None,
        "over_bound_median": float(np.median([row["over_bound"] for row in done])) if done else None,
        "seconds_median": float(np.median([row["seconds"] for row in rows])),
        "seconds_most": max(row["seconds"] for row in rows),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print; 0 if no error is silent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="run k has the seed SEED + k")
    parser.add_argument(
        "--misstated",
        action="store_true",
        help="state noise, detection, clutter, acceleration wrong, lenses (k1 up to 0.4) and clocks not at all",
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files of every run in DIR/SEED")
    parser.add_argument("--most-objects", type=int, default=20, help="leave out runs of more objects: they take long")
    options = parser.parse_args(arguments)
    seeds = range(options.seed, options.seed + options.runs)
    few = [seed for seed in seeds if draw(seed, options.misstated)[2]["objects"] <= options.most_objects]
    rows = rows_of_seeds(few, options.keep, lambda seed, folder: one_run(seed, options.misstated, folder))
    figures = summary(rows)
    print(json.dumps(figures, indent=2))
    return 1 if figures["silent_errors"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
