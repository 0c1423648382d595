"""Memory and time of `stereophd track` on a long log, and on one of a tenth of its length.

Simulates both with the command line (objects come and go, so that the scene is as busy at the end as at
the start), tracks both in processes of their own and prints the peak of their memory and their times.
The ratio of the times is also given without the start-up, which is the time of a log of a few frames. With a
short log (under some 100,000 detections) it says little: the filter's mixture is still growing.

    python benchmarks/long_log.py [--detections 2000000] [--json]
"""

from __future__ import annotations

# Nothing heavy is imported here: on Linux the peak memory of a child counts from that of its parent.
import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

DEFAULT_CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "multi_object.yaml"
COMMAND = [sys.executable, "-m", "stereophd"]
TARGET_PEAK_MB = 400.0
TARGET_RATIO = (9.0, 11.0)
# In a shorter log the mixture is still growing: the ratio of the times is printed, but not judged.
LEAST_DETECTIONS = 100_000

# The paper's six objects, made stationary: as many are born as die.
MEAN_LIFETIME_S = 60.0
SCENE = [
    "simulate.objects.births_per_s=0.1",
    f"simulate.objects.mean_lifetime_s={MEAN_LIFETIME_S}",
    "simulate.objects.stay_in_view=none",
]
# Length of the log from which the rate of detections is taken, s.
PILOT_S = 500.0
# Length of the log whose time is the start-up, s.
FEW_FRAMES_S = 2.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 0 if the targets are met, else 1."""
    options = _parse(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pilot = _simulate(options, PILOT_S, folder / "pilot")
        _simulate(options, FEW_FRAMES_S, folder / "few")
        _track(options, folder / "few")  # compiles what is not compiled yet
        start_up = min((_track(options, folder / "few") for _ in range(3)), key=lambda run: run["wall_s"])
        duration_s = options.detections / (pilot["detections"] / PILOT_S)
        runs = []
        for number, part in enumerate((10.0, 1.0)):
            summary = _simulate(options, duration_s / part, folder / f"log{number}")
            runs.append({**summary, **_track(options, folder / f"log{number}")})
            print(_line(runs[-1]), file=sys.stderr, flush=True)
    short, long = runs
    report = {
        "runs": runs,
        "start_up_s": start_up["wall_s"],
        "frames_ratio": long["frames"] / short["frames"],
        "wall_ratio": long["wall_s"] / short["wall_s"],
        "wall_ratio_without_start_up": (long["wall_s"] - start_up["wall_s"]) / (short["wall_s"] - start_up["wall_s"]),
        "cpu_ratio_without_start_up": (long["cpu_s"] - start_up["cpu_s"]) / (short["cpu_s"] - start_up["cpu_s"]),
        "targets": {"peak_mb": TARGET_PEAK_MB, "ratio": TARGET_RATIO},
    }
    print(json.dumps(report, indent=2) if options.json else _table(report))
    # of the processor times: they do not tell how busy the machine was with other things
    judged = short["detections"] >= LEAST_DETECTIONS
    linear = not judged or TARGET_RATIO[0] <= report["cpu_ratio_without_start_up"] <= TARGET_RATIO[1]
    return 0 if linear and all(run["peak_mb"] < TARGET_PEAK_MB for run in runs) else 1


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=DEFAULT_CONFIG, help="with filter, simulate.objects")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of stereophd")
    parser.add_argument("--detections", type=int, default=2_000_000, help="of the long log (default 2000000)")
    parser.add_argument("--json", action="store_true", help="one JSON document in place of the table")
    options = parser.parse_args(arguments)
    options.words = [word for change in [*SCENE, *options.set] for word in ("--set", change)]
    return options


def _simulate(options: argparse.Namespace, duration_s: float, folder: Path) -> dict[str, Any]:
    """Simulate a log of this duration; return its numbers of frames and detections, and the run's figures."""
    words = ["simulate", str(options.config), *options.words, "--set", f"simulate.duration_s={duration_s:.0f}"]
    output, figures = _run([*COMMAND, *words, "--out", str(folder), "--json"])
    summary = json.loads(output)
    return {
        "frames": summary["frames"],
        "detections": summary["detections"],
        "objects": summary["objects"],
        "simulate_s": figures["wall_s"],
        "simulate_peak_mb": figures["peak_mb"],
    }


def _track(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    words = ["track", str(options.config), str(folder / "detections.parquet"), *options.words]
    _, figures = _run([*COMMAND, *words, "--out", str(folder / "tracked"), "--force", "-q"])
    return figures


def _run(command: list[str]) -> tuple[str, dict[str, float]]:
    """Run a command to its end; return its output, and its time (s), processor time (s) and peak memory (MB)."""
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(command, stdout=output)
        # The usage of this child alone; `resource.getrusage` knows only the largest of all children.
        _, status, usage = os.wait4(process.pid, 0)
        wall_s = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode != 0:
            raise SystemExit(f"error: {' '.join(command)} ended with {process.returncode}")
        output.seek(0)
        text = output.read()
    # ru_maxrss is in bytes on macOS, in kilobytes elsewhere
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    figures = {"wall_s": wall_s, "cpu_s": usage.ru_utime + usage.ru_stime, "peak_mb": usage.ru_maxrss * unit / 1e6}
    return text, figures


def _line(run: dict[str, Any]) -> str:
    return (
        f"{run['detections']:>10,} detections, {run['frames']:>8,} frames: track {run['wall_s']:6.1f} s "
        f"(processor {run['cpu_s']:.1f} s), "
        f"peak {run['peak_mb']:4.0f} MB (simulate {run['simulate_s']:.1f} s, {run['simulate_peak_mb']:.0f} MB)"
    )


def _table(report: dict[str, Any]) -> str:
    return "\n".join(
        [
            *map(_line, report["runs"]),
            f"start-up {report['start_up_s']:.2f} s; peak: target below {TARGET_PEAK_MB:g} MB",
            f"times the frames {report['frames_ratio']:.2f}, times the time {report['wall_ratio']:.2f}; without "
            f"start-up {report['wall_ratio_without_start_up']:.2f}, processor time without start-up "
            f"{report['cpu_ratio_without_start_up']:.2f} (target {TARGET_RATIO[0]:g} to {TARGET_RATIO[1]:g})",
        ]
    )


if __name__ == "__main__":
    sys.exit(main())
