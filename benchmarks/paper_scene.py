"""Accuracy on the paper's multi-object scene over many seeds, beside the limit with known association.

    python benchmarks/paper_scene.py --runs 30

Simulates configs/paper/multi_object.yaml, tracks every scene with each filter of `filters.py`, and scores after both
cameras of a second (OSPA p 2, c 20 cm). The limit is that of `stereophd experiment` (`tracker: known_association`):
least squares on all data so far, on the same scenes. Prints a Markdown table; means over scenes, standard error in
brackets.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from common import PAPER_CONFIG  # first: sets the number of threads

# isort: split
import numpy as np
import pyarrow.parquet as pq
from filters import FILTERS
from numpy.typing import NDArray

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.experiments.kinds.multi_object import KIND

Array = NDArray[np.float64]

SETTLED = 20  # frames until the number of objects counts
LAST = 50
LIMIT = (
    "experiment={runs: 1, methods: {limit: {}}, "
    "scenario: {kind: multi_object, tracker: known_association, ospa: [{order: 2, cutoff: 20}]}}"
)
COLUMNS = (
    "OSPA, all",
    f"OSPA, last {LAST}",
    f"frames after {SETTLED} with a wrong number, %",
    "identities",
    "identity switches",
    "NEES (3 degrees of freedom)",
    "scenes with NEES in its interval, %",
)


def score(settings: list[str], seed: int, log: Path, folder: Path) -> list[float]:
    """Figures (`COLUMNS`) of one filter on one scene."""
    track(load_config(PAPER_CONFIG, settings, seed), log / "detections.parquet", folder / "tracks", force=True)
    report = evaluate(
        folder / "tracks" / "tracks.parquet",
        log / "truth.parquet",
        folder / "scores",
        cutoff=20.0,
        force=True,
        plots=False,
    )
    scans = pq.read_table(folder / "scores" / "per_scan.parquet")
    ospa = scans["ospa"].to_numpy()
    wrong = scans["n_truth"].to_numpy() != scans["n_estimates"].to_numpy()
    nees, interval = report["nees"]["position"], report["nees"]["interval_95"]
    return [
        ospa.mean(),
        ospa[-LAST:].mean(),
        100.0 * wrong[SETTLED:].mean(),
        report["tracks"],
        report["identity_switches"],
        nees,
        100.0 * (interval[0] <= nees <= interval[1]),
    ]


def limit(seed: int, run: int) -> list[float]:
    """OSPA over all frames and over the last of a run, the associations known."""
    series = KIND.run(load_config(PAPER_CONFIG, [LIMIT], seed), run)
    ospa = next(one.values for one in series if one.quantity.startswith("ospa"))
    return [ospa.mean(), ospa[-LAST:].mean()]


def row(title: str, values: Array) -> str:
    """Means over scenes (runs, figures), with standard errors, as a row of the table."""
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values))
    cells = [f"{mean:.2f} ({e:.2f})" for mean, e in zip(values.mean(axis=0), error, strict=True)]
    return f"| {title} | {' | '.join(cells + [''] * (len(COLUMNS) - len(cells)))} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=30, help="scenes (default 30)")
    parser.add_argument("--seed", type=int, default=20_261_121, help="of the scenes")
    options = parser.parse_args()
    print(f"| | {' | '.join(COLUMNS)} |\n|{'---|' * (len(COLUMNS) + 1)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate(load_config(PAPER_CONFIG, seed=options.seed), folder / "logs", runs=options.runs)
        logs = sorted((folder / "logs").iterdir())
        limits = np.array([limit(options.seed, run) for run in range(options.runs)])
        print(row("known association, least squares on all data so far", limits), flush=True)
        for title, settings in FILTERS.items():
            print(row(title, np.array([score(settings, options.seed, log, folder) for log in logs])), flush=True)


if __name__ == "__main__":
    main()
