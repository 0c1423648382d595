"""Whether a run that compiles its kernels and one that finds them compiled give the same bytes.

    python benchmarks/cold_cache.py

Tracks and calibrates a short simulated scene twice, each command in a process of its own: first with an empty folder of
compiled kernels, then with what the first left there. Takes some minutes, most of it to compile. Exit code 1 if a
Parquet file differs.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "calibration.yaml"
SHORT = ["--set", "simulate.duration_s=60"]
RUNS = {
    "track phd": ["track", *SHORT, "--set", "filter.kind=phd"],
    "track pmb": ["track", *SHORT],
    "calibrate annealed": ["calibrate", *SHORT],
    "calibrate sequential": ["calibrate", *SHORT, "--set", "calibration.method=sequential"]
    + ["--set", "calibration.sequential={moves: none, particles: 30, samples: 100, likelihood: phd}"],
}


def run(words: list[str], cache: Path) -> None:
    """Run stereophd in a process of its own."""
    command = [sys.executable, "-m", "stereophd", *words]
    subprocess.run(command, check=True, env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, stdout=subprocess.DEVNULL)


def digests(folder: Path) -> dict[str, str]:
    """Name -> SHA-256 of the Parquet files of a folder."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.glob("*.parquet"))}


def main() -> int:
    """Compare; return the exit code."""
    different = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(["simulate", str(CONFIG), "--out", str(folder / "scene"), *SHORT], folder / "cache")
        for title, (command, *words) in RUNS.items():
            found = []
            for state in ("cold", "warm"):
                out = folder / title / state
                cameras = folder / "scene" / ("cameras.yaml" if command == "track" else "guess.yaml")
                log = [str(CONFIG), str(folder / "scene" / "detections.parquet"), "--cameras", str(cameras)]
                run([command, *log, "--out", str(out), *words], folder / title / "cache")
                found.append(digests(out))
            differing = [file for file in found[0] if found[0][file] != found[1].get(file)]
            different += len(differing)
            print(
                f"{title}: {', '.join(differing) + ' differ' if differing else f'{len(found[0])} files, all the same'}"
            )
    return int(different > 0)


if __name__ == "__main__":
    sys.exit(main())
