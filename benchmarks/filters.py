"""Accuracy of the filters side by side: OSPA, OSPA(2) and identities of PHD, PMB and smoothed PMB on harder scenes.

    python benchmarks/filters.py --runs 10
    python benchmarks/filters.py --authors DIR

Every scene is a variation of configs/paper/multi_object.yaml, simulated with seeds of its own; all filters see the
same logs. Prints a Markdown table (docs/filters.md holds one). Means over runs, standard error in brackets.
With --authors the logs are those in the folders of DIR (cameras.yaml, detections.parquet, truth.parquet, in cm), one
run each.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config

CONFIG = Path(__file__).parents[1] / "configs" / "paper" / "multi_object.yaml"
DETECTORS = [f"cameras.{name}.detector" for name in ("left", "right")]
# The pair of the paper, turned by 90 degrees about the viewing direction: above and below, inclined inward.
INSIDE = (
    "image_size_px: [800, 600], intrinsics: {fx: 898.8764044943821, fy: 888.8888888888889, cx: 400.0, cy: 300.0}, "
    "detector: {sigma_px: [1.4142135623730951, 1.4142135623730951], p_detect: 0.95, clutter_per_frame: 10.0}"
)
UPPER = f"{{{INSIDE}, pose: {{center: [0.0, -20.0, 0.0], rotation_vector_deg: [15.0, 0.0, 0.0]}}}}"
LOWER = f"{{{INSIDE}, pose: {{center: [0.0, 20.0, 0.0], rotation_vector_deg: [-15.0, 0.0, 0.0]}}}}"
SCENES = {
    "six objects (the paper's)": [],
    "detection probability 0.7": [f"{key}.p_detect=0.7" for key in DETECTORS],
    "clutter 50": [f"{key}.clutter_per_frame=50" for key in DETECTORS],
    "twelve objects that cross": ["simulate.objects.count=12"],
    "twelve objects, three cameras": ["simulate.objects.count=12", f"cameras.upper={UPPER}"],
    "10 and 7 Hz, phase 30 ms, 20 s": [
        "cameras.left.frame_rate_hz=10",
        "cameras.right.frame_rate_hz=7",
        "cameras.right.phase_s=0.03",
        "simulate.duration_s=20",
    ],
    "objects leave one camera's view": ["simulate.objects.stay_in_view=any"],
    "births 0.05 /s, mean life 40 s": ["simulate.objects.births_per_s=0.05", "simulate.objects.mean_lifetime_s=40"],
    "three cameras": [f"cameras.upper={UPPER}"],
    "four cameras": [f"cameras.upper={UPPER}", f"cameras.lower={LOWER}"],
    "velocity forgotten in 3 s, 2 Hz, 30 s": [
        "motion={model: damped_velocity, time_constant_s: 3, acceleration_std: 1.2, max_speed: 8}",
        "simulate.duration_s=30",
        "simulate.frame_rate_hz=2",
        "simulate.acceleration_std=1.2",
    ],
    "balls in flight, 100 Hz, 0.5 s": [
        "motion={model: ballistic, gravity: [0, 981, 0], acceleration_std: 5, max_speed: 800}",
        "simulate.duration_s=0.5",
        "simulate.frame_rate_hz=100",
        "simulate.objects.velocity_std=150",
        "filter.birth.velocity_std=150",
    ],
}
FILTERS = {
    "PHD": [],
    "PMB": ["filter.kind=pmb"],
    "PMB, smoothed": ["filter.kind=pmb", "report.smooth={}"],
}
# What a scene's motion is worth: the same logs tracked with constant velocity and as much white acceleration.
WITHOUT = {
    "velocity forgotten in 3 s, 2 Hz, 30 s": "motion={model: constant_velocity, acceleration_std: 1.2, max_speed: 8}",
    "balls in flight, 100 Hz, 0.5 s": "motion={model: constant_velocity, acceleration_std: 300, max_speed: 800}",
}


def figures(title: str, runs: int, folder: Path) -> dict[str, np.ndarray]:
    """Figures (`FIGURES`) of every filter (runs x figures) on a scene."""
    scene, filters = SCENES[title], dict(FILTERS)
    if title in WITHOUT:
        filters["PMB, constant velocity"] = ["filter.kind=pmb", WITHOUT[title]]
    simulate(load_config(CONFIG, scene, seed=20_261_121), folder / "logs", runs=runs, force=True)
    logs = sorted((folder / "logs").iterdir())
    return {
        name: np.array([score([*scene, *settings], log, folder) for log in logs]) for name, settings in filters.items()
    }


def score(settings: list[str], log: Path, folder: Path, cameras: Path | None = None) -> list[float]:
    """Figures of one filter on one log (a folder as `stereophd simulate` writes it)."""
    track(load_config(CONFIG, settings, 1, cameras), log / "detections.parquet", folder / "tracks", force=True)
    report = evaluate(folder / "tracks" / "tracks.parquet", log / "truth.parquet", cutoff=20.0)
    return [
        float(report["ospa"]["mean"]),
        float(report["ospa2"]["mean"]),
        float(report["identity_switches"]),
        float(report["position_error"]["median"]),
    ]


def print_rows(title: str, found: dict[str, np.ndarray]) -> None:
    """Print a row a filter."""
    for name, values in found.items():
        cells = [f"{mean:.2f}" for mean in values.mean(axis=0)]
        if len(values) > 1:
            error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
            cells = [f"{cell} ({e:.2f})" for cell, e in zip(cells, error, strict=True)]
        print(f"| {title} | {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="of each scene (default 10)")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES), metavar="SCENE")
    parser.add_argument("--authors", type=Path, metavar="DIR", help="recorded logs in place of simulated scenes")
    options = parser.parse_args()
    print("| scene | filter | OSPA, cm | OSPA(2), cm | identity switches | median error, cm |")
    print("|---|---|---|---|---|---|")
    if options.authors is not None:
        for log in sorted(path.parent for path in options.authors.glob("*/detections.parquet")):
            with tempfile.TemporaryDirectory() as folder:
                rows = {
                    name: np.array([score(settings, log, Path(folder), log / "cameras.yaml")])
                    for name, settings in FILTERS.items()
                }
            print_rows(log.name, rows)
        return
    for title in options.scenes:
        with tempfile.TemporaryDirectory() as folder:
            print_rows(title, figures(title, options.runs, Path(folder)))


if __name__ == "__main__":
    main()
