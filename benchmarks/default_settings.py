"""Settings that `init` chooses, against the true ones: 60 set-ups with noise of 0.1 to 100 px.

    python benchmarks/default_settings.py --runs 60            one line a set-up, then a summary
    python benchmarks/default_settings.py --first 7 --runs 1 --keep DIR     keep the files of set-up 7
    python benchmarks/default_settings.py --checks-only --runs 200          warnings of `check` on right set-ups

Each set-up draws two to eight cameras in a row or a ring, 1 to 1,000 objects, 3 to 3,000 frames and all else.
The cameras are right, and without a detector section. `init` writes a configuration, `track` runs with it and with the
true one, and `evaluate` scores both. A failure (noise off by more than a factor of 1.5, or OSPA above 1.3 times that of
the true settings) is silent if neither `init` nor `track` warns. `off` lists every value of a detector, detection
probability and clutter too, that is off by more than 1.5: the factor, and the standard error that `init` states. Exit
code 1 if a failure is silent, or if the checks warn of more than one of 100 right set-ups.
"""

from __future__ import annotations

import argparse
import logging
import math
import re
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from common import DrawnScene

# isort: split
import numpy as np
import yaml

from stereophd.commands.evaluate import evaluate
from stereophd.commands.init import init
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.pipeline.checks.check_log import check_log

# Detections and frames of all cameras of a set-up, at most and about.
MOST_DETECTIONS, MOST_FRAMES = 6000, 6000
NOISE_FACTOR, OSPA_FACTOR = 1.5, 1.3
# Share of right set-ups that the checks may warn of.
MOST_FALSE = 0.01


def draw(number: int, most: int = MOST_DETECTIONS) -> tuple[dict[str, Any], dict[str, Any]]:
    """Configuration of a simulation, and what was drawn."""
    rng = np.random.default_rng([number, 25])
    count = int(rng.integers(2, 9))
    size = 10.0 ** rng.uniform(-1.0, 1.5)  # half the side of the scene, m
    layout = str(rng.choice(["row", "ring"]))
    scene = DrawnScene(rng, count, size, size * rng.uniform(2.0, 4.0), layout)
    noise = 10.0 ** rng.uniform(-1.0, 2.0)
    objects = round(10.0 ** rng.uniform(0.0, 3.0))
    frames = round(10.0 ** rng.uniform(math.log10(3.0), math.log10(3000.0)))
    frames = max(3, min(frames, most // (objects * count), MOST_FRAMES // count))
    rate = float(rng.choice([5.0, 10.0, 25.0, 30.0, 100.0]))
    speed, time_constant = size * rng.uniform(0.05, 0.5), float(rng.uniform(1.0, 4.0))
    start = rng.uniform(-math.pi, math.pi)
    cameras = {}
    for k in range(count):
        place = scene.place(k, start)
        sigma = min(max(noise * math.exp(rng.normal(0.0, 0.3)), 0.1), 100.0)
        cameras[f"cam{k}"] = {
            **scene.camera(*place),
            "distortion": {"model": "radial", "k1": float(rng.uniform(-0.1, 0.05))},
            "detector": {
                "sigma_px": [float(sigma)] * 2,
                "p_detect": float(rng.uniform(0.7, 0.99)),
                "clutter_per_frame": float(objects * rng.choice([0.01, 0.1, 0.5])),
            },
            "frame_rate_hz": rate,
            "phase_s": float(rng.uniform(0.0, 1.0 / rate)) if rng.random() < 0.3 else 0.0,
        }
    tree = scene.tree(number, cameras, objects, speed, time_constant, frames / rate)
    row = {"number": number, "cameras": count, "layout": layout, "objects": objects, "frames": frames}
    return tree, {**row, "rate_hz": rate, "noise_px": round(noise, 3), "distance": scene.distance}


def simulated(number: int, folder: Path, most: int = MOST_DETECTIONS) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write ``true.yaml`` and ``scene/`` of a set-up; return its configuration and what was drawn."""
    tree, row = draw(number, most)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "true.yaml").write_text(yaml.safe_dump(tree))
    if not (folder / "scene").exists():
        simulate(load_config(folder / "true.yaml"), folder / "scene")
    return tree, row


def score(folder: Path, name: str, cutoff: float) -> tuple[float, set[str]]:
    """OSPA of a configuration of a set-up, and the causes that `track` warns of."""
    loaded, log = load_config(folder / f"{name}.yaml"), folder / "scene" / "detections.parquet"
    report = track(loaded, log, folder / f"tracks-{name}", force=True)
    causes = {str(check["cause"]) for check in report["checks"] if check["status"] == "warning"}
    try:
        tracks = folder / f"tracks-{name}" / "tracks.parquet"
        result = evaluate(tracks, folder / "scene" / "truth.parquet", cutoff=cutoff, plots=False)
    except InputError:  # no tracks
        return cutoff, causes
    return float(result["ospa"]["mean"]), causes


def one_run(number: int, folder: Path, most: int) -> dict[str, Any]:
    """Figures of one set-up."""
    tree, row = simulated(number, folder, most)
    described = yaml.safe_load((folder / "scene" / "cameras.yaml").read_text())
    for camera in described["cameras"].values():
        for key in ("detector", "frame_rate_hz", "phase_s"):
            camera.pop(key, None)
    (folder / "cameras.yaml").write_text(yaml.safe_dump(described))
    since = time.process_time()
    report = init(folder / "init", folder / "scene" / "detections.parquet", folder / "cameras.yaml", force=True)
    (folder / "chosen.yaml").write_text((folder / "init" / "config.yaml").read_text())
    row["init_s"] = round(time.process_time() - since, 1)
    chosen = load_config(folder / "chosen.yaml")
    truth = {name: camera["detector"] for name, camera in tree["cameras"].items()}
    ratios = [
        math.sqrt(math.prod(camera.detector.sigma_px)) / truth[name]["sigma_px"][0]
        for name, camera in chosen.cameras.items()
    ]
    cutoff = 0.1 * row["distance"]
    causes = {str(check["cause"]) for check in report["checks"] if check["status"] == "warning"}
    mine, warned = score(folder, "chosen", cutoff)
    best, _ = score(folder, "true", cutoff)
    row |= {
        "noise_ratio": round(float(np.exp(np.mean(np.log(ratios)))), 2),
        "noise_worst": round(float(np.exp(np.abs(np.log(ratios)).max())), 2),
        "ospa": round(mine / cutoff, 4), "ospa_true": round(best / cutoff, 4),
        "warned": sorted(causes | warned),
        "off": [text for name, entry in report["detectors"].items() for text in _off(name, entry, truth[name])],
    }  # fmt: skip
    row["noise_right"] = row["noise_worst"] <= NOISE_FACTOR
    row["tracks_right"] = mine <= OSPA_FACTOR * best + 1e-3 * cutoff
    row["silent"] = not (row["noise_right"] and row["tracks_right"]) and not row["warned"]
    return row


def _off(name: str, entry: dict[str, Any], truth: dict[str, Any]) -> Iterator[str]:
    """Yield each value of an estimated detector that is off by more than a factor of 1.5, and its stated error."""
    errors = dict(re.findall(r"(noise|p_detect|clutter)\S* ([\d.e+-]+)", entry["source"].partition("errors:")[2]))
    noise, share = math.sqrt(math.prod(entry["sigma_px"])), float(errors.get("noise", math.nan)) / 100.0
    values = {"noise": (noise, truth["sigma_px"][0], noise * share)}
    for key in ("p_detect", "clutter_per_frame"):
        values[key] = (entry[key], truth[key], float(errors.get(key.split("_per")[0], math.nan)))
    for key, (value, true, error) in values.items():
        if abs(math.log(value / true)) > math.log(NOISE_FACTOR):
            yield f"{name} {key} {value:.3g} for {true:.3g}, error {error:.2g}"


def main() -> int:
    """Run and print; return the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--checks-only", action="store_true")
    parser.add_argument("--most", type=int, default=MOST_DETECTIONS, help="detections of a set-up")
    parser.add_argument("--limit", type=float, default=math.inf, help="CPU seconds of a set-up")
    options = parser.parse_args()
    logging.getLogger("stereophd").setLevel(logging.CRITICAL)
    signal.signal(signal.SIGPROF, _stop)
    rows = []
    for number in range(options.first, options.first + options.runs):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) if options.keep is None else options.keep / str(number)
            signal.setitimer(signal.ITIMER_PROF, min(options.limit, 1e8))
            try:
                row = (checked if options.checks_only else one_run)(number, folder, options.most)
            except (InputError, TimeoutError, SystemError) as error:  # the last: within compiled code
                row = {**draw(number, options.most)[1], "error": str(error)[:120]}
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            rows.append(row)
            print(yaml.safe_dump(row, default_flow_style=True, width=1000, sort_keys=False).strip(), flush=True)
    done = [row for row in rows if "error" not in row]
    if options.checks_only:
        false = sum(bool(row["warned"]) for row in done)
        print(f"{len(done)} right set-ups, {false} with warnings")
        return int(false > MOST_FALSE * len(done))
    for key in ("noise_right", "tracks_right", "silent"):
        print(f"{key}: {sum(row[key] for row in done)} of {len(done)}")
    return int(any(row["silent"] for row in done))


def _stop(*_: object) -> None:
    raise TimeoutError("took longer than --limit")


def checked(number: int, folder: Path, most: int) -> dict[str, Any]:
    """Warnings of the checks on a right set-up."""
    row = simulated(number, folder, most)[1]
    findings = check_log(load_config(folder / "true.yaml"), folder / "scene" / "detections.parquet", of_rows=False)
    return {**row, "warned": sorted(str(found.cause) for found in findings if found.status == "warning")}


if __name__ == "__main__":
    raise SystemExit(main())
