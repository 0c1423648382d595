"""Time per event of the PMB filter against the number of objects: 4 cameras, clutter 50 a frame, 1000 frames.

    python benchmarks/many_objects.py
    python benchmarks/many_objects.py --objects 25 200 --frames 200 --plot docs/figures/many_objects.png
    python benchmarks/many_objects.py --objects 2000 --frames 200 --threads 2
    python benchmarks/many_objects.py --objects 10000 --frames 48 --cameras 8

A room of 8 x 8 x 2.5 m full of objects (0.3 m/s), seen whole by four 1920x1080 cameras 13 m from its middle, each at
20 Hz; probability of detection 0.95. The "local detections" of an object are those within `RADIUS` of it in the image
(another object's, or clutter): what any filter with a gate has to look at. Processor time of the filter's steps alone,
on one thread (wall-clock time on several); the log is in memory. Of several repetitions the best counts. An object is
found, in the second half of the log, if a reported track is within `FOUND_WITHIN`; tracks beyond that are ghosts.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from common import read_events  # first: sets the number of threads

# isort: split
import numpy as np
import pyarrow.parquet as pq

from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.multi.base import DisparityFilter
from stereophd.pipeline.build import build_filter

TARGET_MS_PER_EVENT = 15.0
TARGET_OBJECTS = 200
# With thousands of objects: on one thread and on more, and the slowest tenth of the events against the median.
MANY_OBJECTS = 2000
TARGET_MS_MANY, TARGET_MS_MANY_THREADS = 25.0, 15.0
TARGET_SLOWEST = 3.0
TARGET_FOUND, TARGET_GHOSTS = 0.98, 0.01
# The cost may grow like this power of (objects x local detections), from one row to the next: 1, and some noise.
TARGET_POWER = 1.05
RADIUS = 50.0  # px
RATE_HZ = 20.0
FOUND_WITHIN = 0.1  # m
CAMERAS = {
    "north": (9.0, 9.0),
    "east": (9.0, -9.0),
    "south": (-9.0, -9.0),
    "west": (-9.0, 9.0),
    "north_wall": (12.7, 0.0),
    "east_wall": (0.0, -12.7),
    "south_wall": (-12.7, 0.0),
    "west_wall": (0.0, 12.7),
}
CAMERA_HEIGHT, AIM_HEIGHT = 4.0, 1.5


@dataclass(frozen=True)
class Measured:
    """Figures of one number of objects."""

    objects: int
    events: int
    detections_per_event: float
    local_detections: float
    components: float
    objects_reported: float
    found: float
    ghosts: float
    ms_per_event: float
    ms_median: float
    ms_worst_tenth: float

    @property
    def work(self) -> float:
        """Objects times local detections."""
        return self.objects * self.local_detections


def room(objects: int, frames: int, cameras: int = 4) -> dict[str, Any]:
    """Return the configuration: world axes x, y on the floor, z down (0 is the floor)."""
    duration_s = frames / (cameras * RATE_HZ)
    return {
        "units": {"length": "m"},
        "seed": 20_261_121,
        "cameras": {name: _camera(*place) for name, place in list(CAMERAS.items())[:cameras]},
        "disparity": {"baseline": 0.1},
        "motion": {"model": "constant_velocity", "acceleration_std": 0.05, "max_speed": 3.0},
        "moments": {"method": "qmc", "samples": 64},
        "filter": {
            "kind": "pmb",
            "survival_per_s": 0.99,
            "birth": {"per_s": 0.5, "depth_range": [6.0, 21.0], "velocity_std": 0.5},
        },
        "simulate": {
            "duration_s": duration_s,
            "frame_rate_hz": RATE_HZ,
            "object_id": True,
            "acceleration_std": 0.02,
            "objects": {
                "count": objects,
                "box": {"x": [-4.0, 4.0], "y": [-4.0, 4.0], "z": [-2.5, 0.0]},
                "velocity_std": 0.3,
                "stay_in_view": "all",
            },
        },
    }


def _camera(x: float, y: float) -> dict[str, Any]:
    """A camera in a corner, under the ceiling, looking at the middle of the room."""
    center = np.array([x, y, -CAMERA_HEIGHT])
    forward = np.array([0.0, 0.0, -AIM_HEIGHT]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 0.0, 1.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return {
        "image_size_px": [1920, 1080],
        "intrinsics": {"fx": 1200.0, "fy": 1200.0, "cx": 959.5, "cy": 539.5},
        "pose": {"center": center.tolist(), "rotation_matrix": rotation.tolist()},
        "detector": {"sigma_px": [1.0, 1.0], "p_detect": 0.95, "clutter_per_frame": 50.0},
    }


def measure(objects: int, frames: int, repetitions: int, cameras: int = 4, threads: int = 1) -> Measured:
    """Simulate the room with so many objects, and time the filter on it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "room.yaml").write_text(json.dumps(room(objects, frames, cameras)), encoding="utf-8")
        loaded = load_config(folder / "room.yaml")
        simulate(loaded, folder / "log")
        events = read_events(loaded, folder / "log" / "detections.parquet")
        truth = pq.read_table(folder / "log" / "truth.parquet", columns=["time_s", "x", "y", "z"])
    multi_filter = build_filter(loaded.config, loaded.build_cameras(), loaded.path, threads)
    places = np.stack([truth[name].to_numpy() for name in ("time_s", "x", "y", "z")], axis=1)
    components, reported, found, ghosts = _run(multi_filter, events, places)
    best = np.full(len(events), np.inf)
    gc.disable()
    for _ in range(repetitions):
        best = np.minimum(best, _times(multi_filter, events, time.process_time if threads == 1 else time.perf_counter))
    gc.enable()
    ms = 1e3 * best
    return Measured(
        objects,
        len(events),
        float(np.mean([len(event.points) for event in events])),
        float(np.mean([_local(event.points) for event in events])),
        components,
        reported,
        found,
        ghosts,
        float(ms.mean()),
        float(np.median(ms)),
        float(np.sort(ms)[-max(len(ms) // 10, 1) :].mean()),
    )


def _run(multi_filter: DisparityFilter, events: list[Event], truth: Array) -> tuple[float, float, float, float]:
    """Components an event; in the second half objects reported, and shares of objects found and of ghosts.

    `truth` holds rows of time and place. The first run compiles the filter.
    """
    state = multi_filter.init()
    components, reported, found, ghosts = [], [], [], []
    for k, event in enumerate(events):
        state, info, estimates = multi_filter.step(state, event)
        components.append(info.n_components)
        if k < len(events) // 2:
            continue
        reported.append(len(estimates.track_ids))
        places = truth[np.abs(truth[:, 0] - event.time_s) < 1e-6, 1:]
        matched = _matched(estimates.states[:, :3], places)
        found.append(matched / len(places))
        ghosts.append((len(estimates.states) - matched) / len(places))
    return float(np.mean(components)), float(np.mean(reported)), float(np.mean(found)), float(np.mean(ghosts))


def _matched(reported: Array, places: Array) -> int:
    """Places (n, 3) to which a reported one (m, 3) is near, each reported one counted for its nearest place."""
    found = set()
    for one in reported:
        squared = ((places - one) ** 2).sum(axis=1)
        if squared.min() <= FOUND_WITHIN**2:
            found.add(int(squared.argmin()))
    return len(found)


def _times(multi_filter: DisparityFilter, events: list[Event], clock: Callable[[], float]) -> Array:
    """Time (s) of each event."""
    state = multi_filter.init()
    spent = np.empty(len(events))
    for k, event in enumerate(events):
        start = clock()
        state, _, _ = multi_filter.step(state, event)
        spent[k] = clock() - start
    return spent


def _local(points: Array) -> float:
    """Detections within `RADIUS` of a detection, itself included, on average."""
    near = 0
    for point in points:
        near += int((((points - point) ** 2).sum(axis=1) <= RADIUS**2).sum())
    return near / max(len(points), 1)


def steepest(found: Sequence[Measured]) -> float:
    """Largest power of objects x local detections that the cost follows from one row to the next; NaN of one row."""
    powers = [math.log(b.ms_per_event / a.ms_per_event) / math.log(b.work / a.work) for a, b in pairwise(found)]
    return max(powers, default=math.nan)


def plot(found: Sequence[Measured], path: Path) -> None:
    """Draw the cost against objects, and against objects x local detections."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    ms = np.array([m.ms_per_event for m in found])
    figure, panels = pyplot.subplots(1, 2, figsize=(8.0, 3.4), sharey=True, layout="constrained")
    for panel, values, label in (
        (panels[0], np.array([m.objects for m in found]), "objects"),
        (panels[1], np.array([m.work for m in found]), "objects x local detections"),
    ):
        panel.loglog(values, ms, "o-", color="tab:blue", label="PMB filter")
        panel.loglog(values, ms[0] * values / values[0], "--", color="0.5", label="proportional")
        panel.set_xticks(values, [f"{value:.3g}" if value < 1000 else f"{value / 1000:.2g} k" for value in values])
        panel.minorticks_off()
        panel.set(xlabel=label)
        panel.grid(True, alpha=0.25)
    marks = [tick for tick in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if ms.min() / 2.5 <= tick <= 50.0 * ms.max()]
    panels[0].set_yticks(marks, [f"{mark:g}" for mark in marks])
    panels[0].set(ylabel="ms per event")
    panels[0].axhline(TARGET_MS_PER_EVENT, color="tab:red", linewidth=0.8, label="target at 200 objects")
    panels[0].legend(frameon=False)
    figure.savefig(path, dpi=150, metadata={"Software": None} if path.suffix == ".png" else {"Date": None})


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 0 if the targets are met, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", type=int, nargs="+", default=[25, 50, 100, 200, 400])
    parser.add_argument("--frames", type=int, default=1000, help="of all cameras together (default 1000)")
    parser.add_argument("--cameras", type=int, choices=range(2, len(CAMERAS) + 1), default=4, help="(default 4)")
    parser.add_argument("--threads", type=int, default=1, help="of the filter (default 1)")
    parser.add_argument("--repetitions", type=int, default=3, help="the best of each event counts (default 3)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a figure (needs matplotlib)")
    parser.add_argument("--json", action="store_true", help="one JSON document in place of the table")
    options = parser.parse_args(arguments)
    found = [
        measure(count, options.frames, options.repetitions, options.cameras, options.threads)
        for count in sorted(options.objects)
    ]
    exponent = steepest(found)
    fast = all(m.ms_per_event <= TARGET_MS_PER_EVENT for m in found if m.objects == TARGET_OBJECTS)
    most_ms = TARGET_MS_MANY if options.threads == 1 else TARGET_MS_MANY_THREADS
    fast = fast and all(
        m.ms_per_event <= most_ms and m.ms_worst_tenth <= TARGET_SLOWEST * m.ms_median
        for m in found
        if m.objects == MANY_OBJECTS
    )
    complete = all(m.found >= TARGET_FOUND and m.ghosts <= TARGET_GHOSTS for m in found if m.objects >= MANY_OBJECTS)
    met = fast and complete and not exponent > TARGET_POWER
    if options.json:
        report = {"rows": [asdict(m) for m in found], "steepest_power": exponent if len(found) > 1 else None}
        print(json.dumps(report, indent=2))
    else:
        _print(found, exponent)
    if options.plot is not None:
        plot(found, options.plot)
    return 0 if met else 1


def _print(found: Sequence[Measured], exponent: float) -> None:
    print("| objects | detections an event | local detections | components | reported | found | ghosts | ms/event | "
          "median | slowest tenth | us/(object x local) |\n|---|---|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    for m in found:
        print(
            f"| {m.objects} | {m.detections_per_event:.0f} | {m.local_detections:.2f} | {m.components:.0f} | "
            f"{m.objects_reported:.1f} | {100.0 * m.found:.1f} % | {100.0 * m.ghosts:.1f} % | {m.ms_per_event:.2f} | "
            f"{m.ms_median:.2f} | {m.ms_worst_tenth:.2f} | "
            f"{1e3 * m.ms_per_event / m.work:.1f} |"
        )
    print(
        f"steepest growth: (objects x local detections)^{exponent:.2f} (target at most {TARGET_POWER:g}); "
        f"target at {TARGET_OBJECTS} objects: at most {TARGET_MS_PER_EVENT:g} ms an event"
    )


if __name__ == "__main__":
    sys.exit(main())
