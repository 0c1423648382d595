"""Logs larger than any set-up: 100 cameras, also for an hour; 2,000 objects; 10 kHz. Which time and memory has `track`?

    python benchmarks/large_logs.py [--limit 900] [--only WORD]

The logs are simulated from `configs/quickstart.yaml`, those of many objects as in `many_objects.py`. `long_log.py
--detections 5000000` has the longest one. Each run of `track` is a process of its own, with default
settings. Prints a table of processor time and peak memory, start-up included. Exit code 1 if a run did not end within
the limit of processor time, or failed. Needs a Unix system.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from many_objects import room

QUICKSTART = Path(__file__).resolve().parent.parent / "configs" / "quickstart.yaml"

# Centre of the circle on which many cameras stand, where the objects are, and its radius, m.
CENTER, RADIUS = np.array([0.0, -1.5, 7.5]), 9.0


def ring(count: int, rate_hz: float = 20.0, duration_s: float = 2.0) -> dict[str, Any]:
    """Return cameras (phases spread over a frame) on a circle about the objects, which all of them see."""
    document = yaml.safe_load(QUICKSTART.read_text(encoding="utf-8"))
    left = document["cameras"]["left"]
    cameras = {}
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        center = CENTER + RADIUS * np.array([-np.sin(angle), 0.0, -np.cos(angle)])
        # turned about the vertical axis, so that z points at the centre of the circle
        turn_deg = float(np.rad2deg(np.arctan2(-np.sin(angle), np.cos(angle))))
        pose = {"center": center.tolist(), "rotation_vector_deg": [0.0, turn_deg, 0.0]}
        cameras[f"c{k:03d}"] = {**left, "pose": pose, "phase_s": k / count / rate_hz, "frame_rate_hz": rate_hz}
    document["cameras"] = cameras
    document["simulate"]["duration_s"] = duration_s
    # within an hour some lives are long: their accelerations take those objects out of the ring
    document["simulate"]["objects"]["stay_in_view"] = "none"
    return dict(document)


def fast() -> dict[str, Any]:
    """Return the scene of the quickstart for 1 s, two of its cameras at 10 kHz."""
    document = yaml.safe_load(QUICKSTART.read_text(encoding="utf-8"))
    for name in ("left", "right"):
        document["cameras"][name]["frame_rate_hz"] = 10_000.0
    document["simulate"] |= {"duration_s": 1.0, "truth_rate_hz": 100.0}
    return dict(document)


def run(words: list[str], limit_s: float) -> tuple[int, float, float]:
    """Run stereophd; return its exit code, processor time (s) and peak memory (MB)."""
    process = subprocess.Popen(
        [sys.executable, "-m", "stereophd", *words],
        stdout=subprocess.DEVNULL,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5)),
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3


def main() -> int:
    """Run all cases; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit", type=float, default=900.0, help="processor time of a run, s")
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    failed = 0
    scenes = {
        "100 cameras, 2 s": ring(100),
        "100 cameras at 0.2 Hz, 1 h": ring(100, 0.2, 3600.0),
        "two of three cameras at 10 kHz, 1 s": fast(),
        "2,000 objects, four cameras, 2 s": room(2000, 160),
    }
    print("| log | frames | processor time, s | peak memory, MB | estimates | not checked |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        for title, document in scenes.items():
            folder = Path(name, title)
            folder.mkdir()
            config = folder / "config.yaml"
            config.write_text(yaml.safe_dump(document), encoding="utf-8")
            for kind in ("pmb", "phd"):
                case = f"{title}, {kind.upper()}"
                if options.only not in case:
                    continue
                scene, out = folder / "scene", folder / kind
                if not scene.exists():
                    subprocess.run(
                        [sys.executable, "-m", "stereophd", "simulate", str(config), "--out", str(scene), "-q"],
                        check=True,
                    )
                words = ["track", str(config), str(scene / "detections.parquet"), "--out", str(out), "-q"]
                code, time_s, memory_mb = run([*words, "--set", f"filter.kind={kind}"], options.limit)
                if code:
                    failed += 1
                    print(f"| {case} | exit code {code} | {time_s:.1f} | {memory_mb:.0f} | | |", flush=True)
                    continue
                report = json.loads((out / "report.json").read_text(encoding="utf-8"))
                left = "; ".join(one["message"] for one in report["checks"] if one["name"] == "geometry.left_out")
                print(
                    f"| {case} | {report['events']} | {time_s:.1f} | {memory_mb:.0f} | {report['estimates']} | "
                    f"{left or 'nothing'} |",
                    flush=True,
                )
    return int(failed > 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
