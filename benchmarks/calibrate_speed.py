"""Speed of the single-cluster PHD filter (`calibrate` with method sequential), beside its floor.

The paper's calibration scene: two cameras of which the right one is unknown, six objects, 100 frames each, 1500
camera particles with 100 samples a Gaussian. Before every event the floor is timed on the very components that the
event is about to carry over, with the same samples, shared out over the same threads: the bare kernels of a
sample's trip (`moving_trips`, `view_mask`, `weighted_moments`) and nothing else. So both make the same number of
trips; the filter's second looks at corners of the view are not counted, which errs on the strict side.

    python benchmarks/calibrate_speed.py                          1500 particles: a few minutes
    python benchmarks/calibrate_speed.py --particles 100 --events 60
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numba
import numpy as np
from numpy.typing import NDArray

from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.core.arrays import Array
from stereophd.core.calibration.sampling.likelihood import hypothesis_spaces
from stereophd.core.calibration.sampling.runs import run
from stereophd.core.calibration.sampling.sequential import SequentialSampler
from stereophd.core.calibration.settings import SequentialSettings
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.trips import motion_noise, moving_trips, view_mask
from stereophd.core.geometry.layout import ROTATION
from stereophd.core.motion.constant_velocity import POSITION_ALONE, POSITION_WITH_VELOCITY
from stereophd.core.multi.camera_hypotheses.batch import CHUNK, BatchState, FilterBatch
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.numerics.linear_algebra import cholesky
from stereophd.core.numerics.moments import weighted_moments
from stereophd.pipeline.calibration.problem import phd_filter, read_problem

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "calibration.yaml"
TARGET_TIMES_FLOOR = 4.0
TARGET_SECONDS = 90.0
FULL_PARTICLES, FULL_EVENTS = 1500, 200


@dataclass
class Spent:
    """Processor and wall-clock time, s."""

    processor: float = 0.0
    wall: float = 0.0

    def add(self, since: tuple[float, float]) -> None:
        """Add the time since `now()`."""
        self.processor += time.process_time() - since[0]
        self.wall += time.perf_counter() - since[1]


def now() -> tuple[float, float]:
    """Processor and wall clock."""
    return time.process_time(), time.perf_counter()


@numba.njit(nogil=True, error_model="numpy")
def bare_trips(
    means: Array,
    covariances: Array,
    cameras: NDArray[np.int64],
    dts: Array,
    spaces: Array,
    camera: int,
    acceleration: Array,
    samples: Array,
    max_speed: float,
) -> float:
    """Sample trips, test of the field of view and moments of every component of a hypothesis."""
    points = np.empty((7, samples.shape[1]))
    mask = np.empty(samples.shape[1])
    factor, mean, covariance = np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    noise, still = np.empty((6, samples.shape[1])), np.zeros(6)
    axes = spaces[camera, ROTATION : ROTATION + 9].copy().reshape(3, 3) * acceleration
    motion_noise(samples, axes, POSITION_WITH_VELOCITY, POSITION_ALONE, noise)
    for k in range(len(means)):
        cholesky(covariances[k], factor)
        scale = math.sqrt(abs(dts[k]))
        moving_trips(
            means[k], factor, samples, noise, scale * dts[k], scale, spaces[cameras[k]], spaces[camera], dts[k],
            1.0, still, max_speed, points,
        )  # fmt: skip
        seen = view_mask(points, spaces[camera], mask)
        if seen > 0:
            weighted_moments(points, mask, float(seen), mean, covariance)
    return float(covariance[0, 0])


def floor(phd: PhdFilter, state: BatchState, event: Event, spaces: Array, pool: ThreadPoolExecutor) -> int:
    """Make the trips of an event, bare; return how many."""
    samples = phd.sets.turn(state.n_events)
    limit, acceleration = phd.motion.speed_limit, phd.motion.noise_std
    mixture = state.mixture

    def run(first: int) -> None:
        for h in range(first, min(first + CHUNK, state.size)):
            part = slice(state.begins[h], state.ends[h])
            bare_trips(
                mixture.means[part], mixture.covariances[part], mixture.cameras[part],
                event.time_s - mixture.times[part], spaces[h], event.camera, acceleration, samples, limit,
            )  # fmt: skip

    list(pool.map(run, range(0, state.size, CHUNK)))
    return int(state.counts.sum()) * samples.shape[1]


def scene(options: argparse.Namespace, folder: Path) -> tuple[ParameterSet, PhdFilter, list[Event]]:
    """Simulate the scene, with the right camera's prior mean off by a draw from the prior."""
    simulate(load_config(CONFIG, seed=options.seed), folder / "simulated")
    loaded = load_config(CONFIG, seed=options.seed, cameras_path=folder / "simulated" / "guess.yaml")
    problem = read_problem(loaded, folder / "simulated" / "detections.parquet")
    phd = phd_filter(loaded, problem.parameters.cameras, options.samples)
    return problem.parameters, phd, list(problem.scans().events[: options.events])


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Run filter and floor event by event."""
    with tempfile.TemporaryDirectory() as folder:
        parameters, phd, events = scene(options, Path(folder))
    batch = FilterBatch(phd, options.threads)
    seed = np.random.SeedSequence(options.seed)
    settings = SequentialSettings(particles=options.particles, roughening=options.roughening)
    with ThreadPoolExecutor(options.threads) as pool:
        small = SequentialSettings(particles=8)
        state, _ = run(SequentialSampler(parameters, events[:10], batch, small, seed))  # compiles
        floor(phd, state.filters, events[0], hypothesis_spaces(parameters, state.values, phd.rig), pool)
        sampler = SequentialSampler(parameters, events, batch, settings, seed)
        state = sampler.init()
        filter_time, floor_time = Spent(), Spent()
        trips, components = 0, 0
        for event in events:
            spaces = hypothesis_spaces(parameters, state.values, phd.rig)
            since = now()
            trips += floor(phd, state.filters, event, spaces, pool)
            floor_time.add(since)
            components += int(state.filters.counts.sum())
            since = now()
            state, _ = sampler.step(state)
            filter_time.add(since)
    work = options.particles * len(events)
    return {
        "particles": options.particles,
        "events": len(events),
        "samples": options.samples,
        "threads": options.threads,
        "components_per_hypothesis": components / work,
        "trips": trips,
        "wall_s": {"filter": filter_time.wall, "floor": floor_time.wall},
        "processor_s": {"filter": filter_time.processor, "floor": floor_time.processor},
        "hypotheses_times_events_per_s": {"filter": work / filter_time.wall, "floor": work / floor_time.wall},
        "processor_ns_per_trip": {
            "filter": 1e9 * filter_time.processor / trips,
            "floor": 1e9 * floor_time.processor / trips,
        },
        "filter_over_floor": filter_time.processor / floor_time.processor,
        "targets": {"filter_over_floor": TARGET_TIMES_FLOOR, "wall_s": TARGET_SECONDS},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 0 if the targets are met, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=FULL_PARTICLES)
    parser.add_argument("--events", type=int, default=FULL_EVENTS, help="at most so many events (default 200)")
    parser.add_argument("--samples", type=int, default=100, help="samples a component (default 100)")
    parser.add_argument("--roughening", type=float, default=0.2)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON document in place of the table")
    options = parser.parse_args(arguments)
    report = measure(options)
    print(json.dumps(report, indent=2) if options.json else table(report))
    full = options.particles >= FULL_PARTICLES and options.events >= FULL_EVENTS
    slow = full and report["wall_s"]["filter"] > TARGET_SECONDS  # type: ignore[index]
    return 1 if slow or report["filter_over_floor"] > TARGET_TIMES_FLOOR else 0  # type: ignore[operator]


def table(report: dict[str, object]) -> str:
    """Return the report as text."""
    lines = [
        f"{report['particles']} particles, {report['events']} events, {report['samples']} samples, "
        f"{report['components_per_hypothesis']:.0f} components a particle, {report['threads']} threads",
        f"{'':28}{'filter':>12}{'floor':>12}",
    ]
    rows = {"wall_s": "wall clock, s", "processor_s": "processor, s"}
    rows |= {
        "hypotheses_times_events_per_s": "hypotheses x events / s",
        "processor_ns_per_trip": "processor, ns a trip",
    }
    for key, title in rows.items():
        values = report[key]
        lines.append(f"{title:28}{values['filter']:12.1f}{values['floor']:12.1f}")  # type: ignore[index]
    lines.append(f"filter / floor {report['filter_over_floor']:.2f} (target at most {TARGET_TIMES_FLOOR:g})")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
