"""Accuracy of the filters side by side: OSPA, OSPA(2), identities and consistency of PHD, PMB and smoothed PMB.

    python benchmarks/filters.py --runs 100
    python benchmarks/filters.py --authors DIR

Every scene is a variation of configs/paper/multi_object.yaml, simulated with seeds of its own; all filters see the
same logs. Prints a Markdown table (docs/results/filters.md holds one): means over runs with the half-width of their
95 % intervals, a median, and the number of failures. Everything runs in memory, as `stereophd experiment` does.
With --authors the logs are those in the folders of DIR (cameras.yaml, detections.parquet, truth.parquet, in cm), one
run each.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereophd.commands.evaluate import evaluate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.core.arrays import Array
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.matching.clear_mot import match_within
from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.summary import figures as figures_of_run
from stereophd.core.metrics.summary import pair_errors, track_ospa
from stereophd.core.metrics.truth.interpolation import DEFAULT_GAP_STEPS, align_truth, last_event_of_each_time
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_OBJECTS
from stereophd.core.simulation.detections import simulate_frames
from stereophd.experiments.engine.base import frames_in_order
from stereophd.experiments.kinds.multi_object import KIND, points_of_estimates, scene_truth
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.simulation import build_scene
from stereophd.pipeline.stream import EventStream
from stereophd.pipeline.tracking.tracking_run import reported_records

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
    "births 0.05 /s, mean life 40 s": [
        "simulate.objects.births_per_s=0.05",
        "simulate.objects.mean_lifetime_s=40",
        "filter.survival_per_s=0.975",
    ],
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
# Weights of the PHD filter fall faster than existence: only the PMB filter can release an object at 0.1.
# `filter.prune_weight` of the configuration is one of intensities.
PMB = ("filter.kind=pmb", "filter.prune_weight=1e-3", "filter.extraction.release=0.1")
FILTERS = {
    "PHD": [],
    "PMB": [*PMB],
    "PMB, smoothed": [*PMB, "report.smooth={}"],
}
CONSTANT = "PMB, constant velocity"
# What a scene's motion is worth: the same logs tracked with constant velocity and as much white acceleration.
WITHOUT = {
    "velocity forgotten in 3 s, 2 Hz, 30 s": "motion={model: constant_velocity, acceleration_std: 1.2, max_speed: 8}",
    "balls in flight, 100 Hz, 0.5 s": "motion={model: constant_velocity, acceleration_std: 300, max_speed: 800}",
}


ORDER, CUTOFF, WINDOW = 2.0, 20.0, 10
# Objects come nearer to each other than the cutoff: see docs/results/filters.md, NEES.
MATCH_DISTANCE = 10.0
# The limit of a filter, on scenes without noise of motion.
KNOWN = "known association"
LIMIT = (
    "experiment={runs: 1, methods: {limit: {}}, "
    "scenario: {kind: multi_object, tracker: known_association, ospa: [{order: 2, cutoff: 20}]}}"
)
# A failure has this many times the median OSPA of its row over the last half.
FAILURE = 2.0
COLUMNS = (
    "OSPA, cm",
    "with tentative",
    "last half",
    "its median",
    "OSPA(2), cm",
    "identity switches",
    "wrong number, %",
    "median error, cm",
    "NEES",
    "NEES, median",
)
MEDIANS = ("its median", "NEES, median")
LAST_HALF = 2


@dataclass(frozen=True)
class Run:
    """A simulated scene: its frames, the events after which it is scored, and the true objects then."""

    frames: Sequence[Frame]
    last: NDArray[np.int64]
    time_s: Array
    truth: PointSets


def simulated(scene: Sequence[str], number: int, seed: int = 20_261_121) -> Run:
    """Return a run of a scene: that of ``stereophd simulate`` with as many runs."""
    loaded = load_config(CONFIG, scene, seed)
    cameras = loaded.build_cameras()
    objects = build_scene(loaded.config, cameras, RUN_OBJECTS.seed(seed, number))
    frames = frames_in_order(cameras, simulate_frames(objects, RUN_FRAMES.seed(seed, number)))
    times = np.array([frame.time_s for frame in frames])
    last = last_event_of_each_time(times)
    truth = scene_truth(objects)
    aligned = align_truth(truth, times[last], DEFAULT_GAP_STEPS * truth.step_s)
    usable = ~(aligned.outside | aligned.gap)
    return Run(frames, last[usable], times[last][usable], aligned.points.keep_scans(usable))


def tracked(run: Run, settings: Sequence[str]) -> list[Estimates]:
    """Return what a filter reports after the scored events."""
    loaded = load_config(CONFIG, settings, 1)
    cameras = loaded.build_cameras()
    multi_filter = build_filter(loaded.config, cameras, loaded.path)
    stream = EventStream(cameras, run.frames)
    records = list(reported_records(multi_filter, multi_filter.motion, stream, loaded.config.report, reach_back=True))
    return [records[event].estimates for event in run.last.tolist()]


def score(run: Run, settings: Sequence[str]) -> list[float]:
    """Figures (`COLUMNS`) of one filter on one run."""
    estimates = tracked(run, settings)
    found = points_of_estimates(estimates)
    scores = score_scans(found, run.truth, ORDER, CUTOFF)
    scores, near = match_within(found, run.truth, scores, ORDER, CUTOFF, MATCH_DISTANCE)
    ospa2 = track_ospa(found, run.truth, scores.near, WINDOW, ORDER, CUTOFF)
    errors = pair_errors(found, run.truth, scores)
    report = figures_of_run(found, run.truth, scores, near, ospa2, errors, {})
    both = points_of_estimates([one.with_tentative() for one in estimates])
    late = run.time_s >= 0.5 * (run.time_s[0] + run.time_s[-1])
    last_half = float(scores.ospa.distance[late].mean())
    return [
        float(report["ospa"]["mean"]),
        float(score_scans(both, run.truth, ORDER, CUTOFF).ospa.distance.mean()),
        last_half,
        last_half,
        float(report["ospa2"]["mean"]),
        float(report["identity_switches"]),
        100.0 * float((found.counts != run.truth.counts)[late].mean()),
        float(report["position_error"]["median"]),
        *2 * (float(report["nees"]["position"]),),
    ]


def limit(scene: Sequence[str], run: Run, number: int, seed: int = 20_261_121) -> list[float]:
    """Figures of least squares on all data so far with the true association: OSPA only, NaN otherwise."""
    series = KIND.run(load_config(CONFIG, [*scene, LIMIT], seed), number)
    ospa = next(one.values for one in series if one.quantity.startswith("ospa"))
    late = float(ospa[run.time_s >= 0.5 * (run.time_s[0] + run.time_s[-1])].mean())
    values = {"OSPA, cm": float(ospa.mean()), "last half": late, "its median": late}
    return [values.get(name, np.nan) for name in COLUMNS]


def figures(title: str, runs: int, wanted: Sequence[str]) -> dict[str, Array]:
    """Figures (`COLUMNS`) of the wanted rows (runs x figures) on a scene."""
    scene = SCENES[title]
    settings = {**FILTERS, CONSTANT: [*PMB, WITHOUT.get(title, "")]}
    names = [name for name in wanted if name not in ((KNOWN,) if title in WITHOUT else (CONSTANT,))]
    found: dict[str, list[list[float]]] = {name: [] for name in names}
    for number in range(runs):
        run = simulated(scene, number)
        for name in names:
            values = limit(scene, run, number) if name == KNOWN else score(run, [*scene, *settings[name]])
            found[name].append(values)
    return {name: np.array(values) for name, values in found.items()}


def row(values: Array) -> str:
    """Means over runs (runs x figures) with the half-width of their 95 % intervals, as cells of the table."""
    cells = []
    for column, name in enumerate(COLUMNS):
        known = values[np.isfinite(values[:, column]), column]
        if not len(known) or name in MEDIANS:
            cells.append(f"{np.median(known):.2f}" if len(known) else "")
            continue
        half = 1.96 * known.std(ddof=1) / np.sqrt(len(known)) if len(known) > 1 else np.nan
        cells.append(f"{known.mean():.2f} ± {half:.2f}")
    late = values[:, LAST_HALF]
    failures = int(np.count_nonzero(late > FAILURE * np.median(late)))
    return " | ".join([*cells, f"{failures} of {len(late)}"])


def score_log(settings: Sequence[str], log: Path) -> list[float]:
    """Figures of one filter on one log (a folder with cameras.yaml, detections.parquet and truth.parquet)."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loaded = load_config(CONFIG, settings, 1, log / "cameras.yaml")
        track(loaded, log / "detections.parquet", folder / "tracks")
        report = evaluate(folder / "tracks" / "tracks.parquet", log / "truth.parquet", cutoff=CUTOFF)
    return [
        float(report["ospa"]["mean"]),
        float(report["ospa2"]["mean"]),
        float(report["identity_switches"]),
        float(report["position_error"]["median"]),
    ]


def print_authors(folder: Path) -> None:
    """Print the table of recorded logs."""
    print("| log | filter | OSPA, cm | OSPA(2), cm | identity switches | median error, cm |\n|---|---|---|---|---|---|")
    for log in sorted(path.parent for path in folder.glob("*/detections.parquet")):
        for name, settings in FILTERS.items():
            cells = " | ".join(f"{value:.2f}" for value in score_log(settings, log))
            print(f"| {log.name} | {name} | {cells} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100, help="of each scene (default 100)")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES), metavar="SCENE")
    rows = [KNOWN, *FILTERS, CONSTANT]
    parser.add_argument("--rows", nargs="*", default=rows, choices=rows, metavar="ROW")
    parser.add_argument("--authors", type=Path, metavar="DIR", help="recorded logs in place of simulated scenes")
    options = parser.parse_args()
    if options.authors is not None:
        print_authors(options.authors)
        return
    print(f"| scene | filter | {' | '.join(COLUMNS)} | failures |\n|{'---|' * (len(COLUMNS) + 3)}")
    for title in options.scenes:
        for name, values in figures(title, options.runs, options.rows).items():
            print(f"| {title} | {name} | {row(values)} |", flush=True)


if __name__ == "__main__":
    main()
