"""Accuracy of the filters side by side: OSPA, OSPA(2) and identities of PHD, PMB and smoothed PMB on harder scenes.

    python benchmarks/filters.py --runs 5

Every scene is a variation of configs/paper/multi_object.yaml, simulated with seeds of its own; all filters see the
same logs. Prints a Markdown table (docs/filters.md holds one). Means over runs, standard error in brackets.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from stereophd.config_loading import load_config
from stereophd.evaluate import evaluate
from stereophd.simulate import simulate
from stereophd.track import track

CONFIG = Path(__file__).parents[1] / "configs" / "paper" / "multi_object.yaml"
DETECTORS = [f"cameras.{name}.detector" for name in ("left", "right")]
SCENES = {
    "six objects (the paper's)": [],
    "detection probability 0.7": [f"{key}.p_detect=0.7" for key in DETECTORS],
    "clutter 50": [f"{key}.clutter_per_frame=50" for key in DETECTORS],
    "twelve objects": ["simulate.objects.count=12"],
    "10 and 7 Hz, phase 30 ms, 20 s": [
        "cameras.left.frame_rate_hz=10",
        "cameras.right.frame_rate_hz=7",
        "cameras.right.phase_s=0.03",
        "simulate.duration_s=20",
    ],
    "objects leave one camera's view": ["simulate.objects.stay_in_view=any"],
    "births 0.05 /s, mean life 40 s": ["simulate.objects.births_per_s=0.05", "simulate.objects.mean_lifetime_s=40"],
}
BIRTH = "birth: {per_frame: 0.05, disparity: {mean_px: 7.0, std_px: 3.0}, velocity_std: 1.5}"
FILTERS = {
    "PHD": [],
    "PMB": [f"filter={{kind: pmb, {BIRTH}}}"],
    "PMB, smoothed": [f"filter={{kind: pmb, {BIRTH}}}", "report.smooth={}"],
}


def figures(scene: list[str], runs: int, folder: Path) -> dict[str, np.ndarray]:
    """OSPA, OSPA(2) and identity switches (filters x runs x 3)."""
    simulate(load_config(CONFIG, scene, seed=20_261_121), folder / "logs", runs=runs, force=True)
    rows: dict[str, np.ndarray] = {}
    for name, settings in FILTERS.items():
        found = []
        for run in sorted((folder / "logs").iterdir()):
            loaded = load_config(CONFIG, [*scene, *settings], seed=1)
            track(loaded, run / "detections.parquet", folder / "tracks", force=True)
            report = evaluate(folder / "tracks" / "tracks.parquet", run / "truth.parquet", cutoff=20.0)
            found.append([report["ospa"]["mean"], report["ospa2"]["mean"], report["identity_switches"]])
        rows[name] = np.array(found, dtype=float)
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    print("| scene | filter | OSPA, cm | OSPA(2), cm | identity switches |\n|---|---|---|---|---|")
    for title, scene in SCENES.items():
        with tempfile.TemporaryDirectory() as folder:
            for name, values in figures(scene, options.runs, Path(folder)).items():
                mean, error = values.mean(axis=0), values.std(axis=0, ddof=1) / np.sqrt(len(values))
                cells = " | ".join(f"{m:.2f} ({e:.2f})" for m, e in zip(mean, error, strict=True))
                print(f"| {title} | {name} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
