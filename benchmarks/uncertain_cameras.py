"""NEES of tracks from simulated calibrations, with and without what the calibrated cameras leave uncertain.

    python benchmarks/uncertain_cameras.py --config configs/paper/calibration.yaml --runs 20 [--set KEY=VALUE]

Each run simulates a scene with cameras drawn from the priors, calibrates, and scores the tracks that `calibrate` writes
by the truth. Printed are the NEES of each run, their mean and standard error; 3 is consistent. `--cutoff` and
`--match-distance` are in the unit of the configuration: beyond half the distance of two objects that pass each other, a
match may stay with the wrong one of them.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from pathlib import Path

from common import with_measured_distance

# isort: split
import numpy as np
from numpy.typing import NDArray

from stereophd.commands.calibrate import calibrate
from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config


def main() -> None:
    """Run all seeds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--cutoff", type=float, default=20.0)
    parser.add_argument("--match-distance", type=float)
    parser.add_argument("--set", action="append", default=[], dest="changes")
    given = parser.parse_args()
    logging.getLogger("stereophd").setLevel(logging.ERROR)
    figures = list[NDArray[np.float64]]()
    for seed in range(given.first, given.first + given.runs):
        changes = [*with_measured_distance(given.config, given.changes, seed), f"seed={seed}"]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            simulate(load_config(given.config, changes), folder / "scene")
            loaded = load_config(given.config, changes, cameras_path=folder / "scene" / "guess.yaml")
            report = calibrate(loaded, folder / "scene" / "detections.parquet", folder / "out", plots=False)
            if report["status"] == "undetermined":
                print(seed, "undetermined", flush=True)
                continue
            truth = folder / "scene" / "truth.parquet"
            scores = evaluate(
                folder / "out" / "tracks.parquet", truth, cutoff=given.cutoff, match_distance=given.match_distance
            )
            nees = scores["nees"]
        figures.append(np.array([nees["position"], nees["without_cameras"]], dtype=np.float64))
        print(seed, report["status"], *np.round(figures[-1], 2), report["tracking"]["cameras_part"], flush=True)
    mean, error = np.nanmean(figures, axis=0), np.nanstd(figures, axis=0) / np.sqrt(len(figures))
    print(f"with cameras {mean[0]:.2f} +- {error[0]:.2f}, without {mean[1]:.2f} +- {error[1]:.2f}, {len(figures)} runs")


if __name__ == "__main__":
    main()
