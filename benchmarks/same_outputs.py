"""Compare the outputs of two versions of the code, column by column and figure by figure.

    python benchmarks/same_outputs.py record OUT_BEFORE     # in the old checkout
    python benchmarks/same_outputs.py record OUT_AFTER      # in the new checkout
    python benchmarks/same_outputs.py compare OUT_BEFORE OUT_AFTER

`record` runs every command on the sample data and, where `STEREOPHD_DATA` names the shared data, on its two scenes and
on 20 s of its drone recording. `compare` reports each Parquet column and each figure of a report that differs, with
the largest difference; provenance is left out. Exit code 1 if anything differs.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

ROOT = Path.cwd()
HALL = ["sample_data/hall.yaml", "sample_data/hall/detections.parquet", "--cameras", "sample_data/hall/cameras.yaml"]
MULTI, SINGLE = "configs/paper/multi_object.yaml", "configs/paper/single_object.yaml"
CALIBRATION = "configs/paper/calibration.yaml"
SMALL_SEQUENTIAL = (
    "calibration.sequential={moves: none, particles: 60, samples: 100, likelihood: phd, resample_below: 0.75}"
)
TRACK_VARIANTS = {
    "phd": ["--set", "filter.kind=phd"],
    "pmb": ["--set", "filter.kind=pmb"],
    "phd_smooth": ["--set", "filter.kind=phd", "--smooth"],
    "pmb_smooth": ["--set", "filter.kind=pmb", "--smooth"],
    "detectors": ["--set", "filter.kind=pmb", "--set", "detector=estimate"],
    "grid": ["--set", "filter.kind=pmb", "--set", "report.times=grid 0.5"],
    "pseudo": ["--set", "moments.method=particle"],
    "adaptive": ["--set", "moments.method=adaptive"],
}
IGNORED_KEYS = {"provenance", "out", "seconds", "elapsed_s", "processor_s"}


def commands(out: Path, data: Path | None) -> dict[str, list[str]]:
    """Return name -> words of each run; later runs read the outputs of earlier ones."""
    runs: dict[str, list[str]] = {
        "simulate_quickstart": ["simulate", "configs/quickstart.yaml"],
        "simulate_multi": ["simulate", MULTI, "--set", "simulate.duration_s=60"],
        "simulate_single": ["simulate", SINGLE],
        "simulate_calibration": ["simulate", CALIBRATION],
        "simulate_drone": ["simulate", "configs/drone.yaml", "--set", "simulate.duration_s=5"],
    }
    for name, words in TRACK_VARIANTS.items():
        runs[f"track_hall_{name}"] = ["track", *HALL, *words]
    runs["evaluate_hall"] = [
        "evaluate", str(out / "track_hall_pmb/tracks.parquet"), "sample_data/hall/truth.parquet", "--cutoff", "1",
        "--cameras", "sample_data/hall/cameras.yaml",
    ]  # fmt: skip
    single = out / "simulate_single"
    for kind in ("disparity", "inverse_depth", "particle", "cartesian"):
        runs[f"track_single_{kind}"] = [
            "track", SINGLE, str(single / "detections.parquet"), "--set", f"filter.estimator={{kind: {kind}}}",
        ]  # fmt: skip
    scene = out / "simulate_calibration"
    for name, words in {
        "annealed": [],
        "sequential": ["--set", "calibration.method=sequential", "--set", SMALL_SEQUENTIAL],
        "smc": ["--set", "calibration.posterior=smc"],
    }.items():
        runs[f"calibrate_{name}"] = [
            "calibrate", CALIBRATION, str(scene / "detections.parquet"),
            "--cameras", str(scene / "guess.yaml"), *words,
        ]  # fmt: skip
    runs["evaluate_calibration"] = [
        "evaluate-cameras", str(out / "calibrate_annealed/cameras.yaml"), str(scene / "cameras.yaml"),
    ]  # fmt: skip
    for name, count in {"table2": 20, "figure11": 4, "figure12": 2, "figure7": 1}.items():
        runs[f"experiment_{name}"] = ["experiment", f"configs/paper/{name}.yaml", "--set", f"experiment.runs={count}"]
    if data is not None:
        for number in ("1", "2"):
            folder = data / "scene" / number
            for name in ("phd", "pmb", "pmb_smooth", "detectors"):
                runs[f"track_scene{number}_{name}"] = [
                    "track", MULTI, str(folder / "detections.parquet"), "--cameras", str(folder / "cameras.yaml"),
                    *TRACK_VARIANTS[name],
                ]  # fmt: skip
            runs[f"evaluate_scene{number}"] = [
                "evaluate", str(out / f"track_scene{number}_pmb/tracks.parquet"), str(folder / "truth.parquet"),
                "--cutoff", "20",
            ]  # fmt: skip
        drone = data / "drone" / "1"
        for name in ("phd", "pmb", "pmb_smooth"):
            runs[f"track_drone_{name}"] = [
                "track", "configs/drone.yaml", str(out / "drone.parquet"), "--cameras", str(drone / "cameras.yaml"),
                *TRACK_VARIANTS[name],
            ]  # fmt: skip
    return runs


def record(out: Path) -> int:
    """Run all commands of the checkout that is the current folder; return the number that failed."""
    out.mkdir(parents=True, exist_ok=True)
    data = Path(os.environ["STEREOPHD_DATA"]) if "STEREOPHD_DATA" in os.environ else None
    if data is not None:
        cut_drone(data / "drone" / "1" / "detections.parquet", out / "drone.parquet")
    failed = 0
    for name, words in commands(out, data).items():
        folder = out / name
        if folder.exists():
            continue
        done = subprocess.run(
            [sys.executable, "-m", "stereophd", *words, "--out", str(folder), "-q"],
            cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode != 0:
            failed += 1
            print(f"{name}: exit code {done.returncode}: {done.stderr.strip().splitlines()[-1:]}", flush=True)
        else:
            print(name, flush=True)
    return failed


def cut_drone(source: Path, target: Path) -> None:
    """Write the first 20 s from 5 s after the start of a log."""
    if not target.exists():
        table = pq.read_table(source)
        start = pc.min(table["time_s"]).as_py() + 5.0
        kept = pc.and_(pc.greater_equal(table["time_s"], start), pc.less(table["time_s"], start + 20.0))
        pq.write_table(table.filter(kept), target)


def compare(before: Path, after: Path) -> int:
    """Print every difference; return how many files differ."""
    different = 0
    names = sorted(p.relative_to(before) for p in before.rglob("*") if p.suffix in (".parquet", ".json"))
    files = 0
    for name in names:
        if any(part.startswith(".") for part in name.parts) or name.name == "timing.json":
            continue
        files += 1
        if not (after / name).exists():
            found = ["missing"]
        elif name.suffix == ".parquet":
            found = parquet_differences(before / name, after / name)
        else:
            found = json_differences(json.loads((before / name).read_text()), json.loads((after / name).read_text()))
        if found:
            different += 1
            print(f"{name}: {len(found)} differences: {'; '.join(found[:6])}")
    print(f"{files} files compared, {different} differ")
    return different


def parquet_differences(before: Path, after: Path) -> list[str]:
    """Return a text for each column that differs."""
    first, second = pq.read_table(before), pq.read_table(after)
    found = [f"column {name} missing" for name in first.column_names if name not in second.column_names]
    found += [f"column {name} new" for name in second.column_names if name not in first.column_names]
    if first.num_rows != second.num_rows:
        return [*found, f"{first.num_rows} and {second.num_rows} rows"]
    for name in first.column_names:
        if name in second.column_names and not first[name].equals(second[name]):
            a, b = first[name].combine_chunks(), second[name].combine_chunks()
            while hasattr(a, "flatten") and hasattr(a.type, "value_type"):
                a, b = a.flatten(), b.flatten()
            try:
                x, y = np.asarray(a.to_numpy(False), dtype=float), np.asarray(b.to_numpy(False), dtype=float)
                same = (x == y) | (np.isnan(x) & np.isnan(y))
                if not same.all():
                    found.append(f"{name} by at most {np.nanmax(np.abs(x - y)):.2g} ({(~same).sum()} of {len(x)})")
            except (TypeError, ValueError):
                found.append(f"{name} differs")
    return found


def json_differences(first: Any, second: Any, place: str = "") -> list[str]:
    """Return a text for each value that differs, provenance left out."""
    if isinstance(first, dict) and isinstance(second, dict):
        found = []
        for key in sorted(set(first) | set(second)):
            if key in IGNORED_KEYS:
                continue
            where = f"{place}.{key}" if place else key
            if key not in second:
                found.append(f"{where} missing")
            elif key not in first:
                found.append(f"{where} new")
            else:
                found += json_differences(first[key], second[key], where)
        return found
    if isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        return [text for i, (a, b) in enumerate(zip(first, second, strict=True))
                for text in json_differences(a, b, f"{place}.{i}")]  # fmt: skip
    same = first == second or (
        isinstance(first, float) and isinstance(second, float) and math.isnan(first) and math.isnan(second)
    )
    return [] if same else [f"{place}: {first!r} and {second!r}"]


def main() -> int:
    """Record or compare; return the exit code."""
    match sys.argv[1:]:
        case ["record", out]:
            return int(record(Path(out).resolve()) > 0)
        case ["compare", before, after]:
            return int(compare(Path(before), Path(after)) > 0)
    print(__doc__)
    return 2


if __name__ == "__main__":
    sys.exit(main())
