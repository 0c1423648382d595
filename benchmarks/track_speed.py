"""Time per event of the multi-object filters, beside their floor and beside plain NumPy, on one thread.

Two filters on one log: PHD with 256 samples, as the paper compares methods with, and PMB with the samples of the
configuration. Three ways through the log each, repeated in turn within one process (processor time, the best counts):

- filter: `DisparityFilter.step` over events that are already in memory;
- floor: as many sample trips as the filter's prediction makes, of the same components, through the bare
  kernels (`moving_trips`, `view_mask`, `weighted_moments`), and nothing else;
- numpy: those trips in plain NumPy, vectorised over all components of an event.

The filter makes more trips than the floor counts (a second look at components of which only a corner is
in view, and the estimates' way to the world), so that the ratio errs on the strict side.

    python benchmarks/track_speed.py                       the paper's scene, simulated
    python benchmarks/track_speed.py --log LOG --cameras CAMERAS.yaml
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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import PAPER_CONFIG, read_events  # first: sets the number of threads

# isort: split
import numba
import numpy as np
from numpy.typing import NDArray

from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.arrays import Array
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import IN_VIEW, Sources
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.disparity.trips import moving_trips, view_mask
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.numerics.moments import weighted_moments
from stereophd.pipeline.build import build_filter


@dataclass(frozen=True)
class Case:
    """A filter, and what it may cost."""

    title: str
    settings: tuple[str, ...]
    ms_per_event: float
    times_floor: float | None


CASES = (
    Case("PHD, 256 samples", ("filter.kind=phd", "moments.method=qmc", "moments.samples=256"), 1.0, 4.0),
    # the paper's scene has two events a second, which may cost 0.5 ms together
    Case("PMB", ("filter.kind=pmb", "filter.prune_weight=1e-3"), 0.25, None),
)
# Largest difference, in standard deviations, of means that NumPy and the kernels may come to.
AGREEMENT_SIGMAS = 1e-6


@dataclass(frozen=True)
class Workload:
    """The components that one event's prediction carries, and what it carries them with."""

    means: Array  # (n, 6)
    covariances: Array  # (n, 6, 6)
    factors: Array  # (n, 6, 6), lower Cholesky
    homes: Array  # (n, 30)
    spaces: tuple[DisparitySpace, ...]  # the distinct homes
    home_of: NDArray[np.int64]  # (n,), index into `spaces`
    dts: Array  # (n,), s
    destination: Array  # (30,)
    destination_space: DisparitySpace
    samples: Array  # (12, s)
    noise: Array  # (6, s), unit motion noise in the destination's axes
    turn: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 0 if the targets are met, else 1."""
    options = _parse(arguments)
    reports = []
    with tempfile.TemporaryDirectory() as folder:
        log = options.log
        if log is None:
            from stereophd.commands.simulate import simulate

            simulate(load_config(options.config, options.set, options.seed), Path(folder) / "simulated")
            log = Path(folder) / "simulated" / "detections.parquet"
        for case in CASES:
            loaded = load_config(options.config, [*case.settings, *options.set], options.seed, options.cameras)
            reports.append(_report(case, loaded, log, options))
    print(json.dumps(reports, indent=2) if options.json else "\n\n".join(_table(report) for report in reports))
    return 0 if all(report["met"] for report in reports) else 1


def _report(case: Case, loaded: LoadedConfig, log: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Measure one filter on a log."""
    multi_filter = build_filter(loaded.config, loaded.build_cameras(), loaded.path)
    if not isinstance(multi_filter.motion, ConstantVelocity):
        raise SystemExit("error: the floor is measured for moving objects; the config's are static")
    events = read_events(loaded, log, options.events)
    workloads, components = _record(multi_filter, events)
    worst = _disagreement(multi_filter, workloads)
    if worst > AGREEMENT_SIGMAS:
        raise SystemExit(f"error: NumPy and the kernels differ by {worst:.2g} standard deviations")
    seconds = _measure(
        {
            "filter": lambda: _run_filter(multi_filter, events),
            "floor": lambda: _run_floor(multi_filter, workloads),
            "numpy": lambda: _run_numpy(multi_filter, workloads),
        },
        options.repetitions,
    )
    trips = sum(w.samples.shape[1] * len(w.means) for w in workloads)
    ms = {name: 1e3 * value / len(events) for name, value in seconds.items()}
    over_floor = seconds["filter"] / seconds["floor"]
    return {
        "filter": case.title,
        "events": len(events),
        "samples": multi_filter.sets.size,
        "components_per_event": trips / multi_filter.sets.size / len(events),
        "components_after_reduction": components,
        "trips": trips,
        "repetitions": options.repetitions,
        "ms_per_event": ms,
        "ns_per_trip": {name: 1e9 * value / trips for name, value in seconds.items()},
        "filter_parts_ms_per_event": _parts(multi_filter, events, options.repetitions),
        "filter_over_floor": over_floor,
        "numpy_over_filter": seconds["numpy"] / seconds["filter"],
        "targets": {"filter_ms_per_event": case.ms_per_event, "filter_over_floor": case.times_floor},
        "met": ms["filter"] <= case.ms_per_event and (case.times_floor is None or over_floor <= case.times_floor),
    }


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=PAPER_CONFIG, help="with a filter section")
    parser.add_argument("--log", type=Path, help="detection log; default: simulate the config's scene")
    parser.add_argument("--cameras", type=Path, help="cameras.yaml in place of the config's cameras")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of stereophd track")
    parser.add_argument("--seed", type=int, help="of the scene and of the samples, in place of the config's")
    parser.add_argument("--events", type=int, default=400, help="at most so many events (default 400)")
    parser.add_argument("--repetitions", type=int, default=7, help="of each way, the best counts (default 7)")
    parser.add_argument("--json", action="store_true", help="one JSON document in place of the table")
    return parser.parse_args(arguments)


def _record(multi_filter: DisparityFilter, events: list[Event]) -> tuple[list[Workload], float]:
    """Run the filter once (which compiles it) and keep what each prediction works on.

    Returns the workloads, and the mean number of components after reduction.
    """
    state = multi_filter.init()
    workloads = []
    components = 0
    for event in events:
        if state.mixture.size:
            workloads.append(_workload(multi_filter, state.mixture, event, state.n_events))
        state, info, _ = multi_filter.step(state, event)
        components += info.n_components
    return workloads, components / len(events)


def _workload(multi_filter: DisparityFilter, mixture: Any, event: Event, turn: int) -> Workload:
    rig, motion = multi_filter.rig, multi_filter.motion
    keys = list(zip(mixture.cameras.tolist(), mixture.times.tolist(), strict=True))
    distinct = sorted(set(keys)) if rig.moving else sorted({(camera, 0.0) for camera, _ in keys})
    index = {key: number for number, key in enumerate(distinct)}
    samples = multi_filter.sets.turn(turn)
    destination = DisparitySpace(rig.cameras[event.camera].at(event.time_s), rig.baseline, rig.rectification)
    with_velocity, alone = samples[6:9], samples[9:12]
    axes = destination.camera.pose.rotation * motion.noise_std
    return Workload(
        means=mixture.means,
        covariances=mixture.covariances,
        factors=np.linalg.cholesky(mixture.covariances),
        homes=np.ascontiguousarray(rig.spaces(mixture.cameras, mixture.times)),
        spaces=tuple(DisparitySpace(rig.cameras[c].at(t), rig.baseline, rig.rectification) for c, t in distinct),
        home_of=np.array([index[key if rig.moving else (key[0], 0.0)] for key in keys]),
        dts=event.time_s - mixture.times,
        destination=rig.space(event.camera, event.time_s),
        destination_space=destination,
        samples=samples,
        noise=np.concatenate([axes @ (0.5 * with_velocity + alone / math.sqrt(12.0)), axes @ with_velocity]),
        turn=turn,
    )


def _run_filter(multi_filter: DisparityFilter, events: list[Event]) -> None:
    state = multi_filter.init()
    for event in events:
        state, _, _ = multi_filter.step(state, event)


@numba.njit(nogil=True, error_model="numpy")
def _floor(
    means: Array,
    factors: Array,
    homes: Array,
    dts: Array,
    samples: Array,
    noise: Array,
    destination: Array,
    max_speed: float,
    out_means: Array,
    out_covariances: Array,
) -> None:
    """Sample trips, test of the field of view and moments of every component: the kernels and no more."""
    points, still = np.empty((7, samples.shape[1])), np.zeros(6)
    mask = np.empty(samples.shape[1])
    for k in range(means.shape[0]):
        velocity_noise = math.sqrt(abs(dts[k]))
        moving_trips(
            means[k], factors[k], samples, noise, velocity_noise * dts[k], velocity_noise,
            homes[k], destination, dts[k], 1.0, still, max_speed, points,
        )  # fmt: skip
        seen = view_mask(points, destination, mask)
        if seen > 0:
            weighted_moments(points, mask, float(seen), out_means[k], out_covariances[k])


def _run_floor(multi_filter: DisparityFilter, workloads: list[Workload]) -> None:
    limit = multi_filter.motion.speed_limit
    for w in workloads:
        means, covariances = np.empty_like(w.means), np.empty_like(w.covariances)
        _floor(
            w.means, w.factors, w.homes, w.dts, w.samples, w.noise, w.destination, limit, means, covariances
        )  # fmt: skip


def _run_numpy(multi_filter: DisparityFilter, workloads: list[Workload]) -> None:
    for workload in workloads:
        numpy_moments(workload, multi_filter)


def numpy_moments(w: Workload, multi_filter: DisparityFilter) -> tuple[Array, Array, NDArray[np.int64]]:
    """Means (n, 6), covariances (n, 6, 6) and numbers of samples (n,) in view, in plain NumPy.

    The text of paper IV-B a-e: sample, to the world, move, to the other disparity space, moments.
    """
    count, size = len(w.means), w.samples.shape[1]
    states = w.means[:, None, :] + w.samples[:6].T @ np.swapaxes(w.factors, 1, 2)
    world = np.empty_like(states)
    for number, space in enumerate(w.spaces):
        here = w.home_of == number
        world[here] = space.to_world(states[here].reshape(-1, 6)).reshape(-1, size, 6)
    position, velocity = world[:, :, :3], world[:, :, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = np.sqrt((velocity**2).sum(axis=2, keepdims=True))
        velocity *= np.minimum(1.0, multi_filter.motion.speed_limit / speed)
        dts = w.dts[:, None, None]
        # the noise of the workload lies in the destination's axes
        rotation = w.destination_space.camera.pose.rotation
        position += dts * velocity + np.sqrt(abs(dts)) * dts * (w.noise[:3].T @ rotation)
        velocity += np.sqrt(abs(dts)) * (w.noise[3:].T @ rotation)
        moved = w.destination_space.from_world(world.reshape(-1, 6)).reshape(count, size, 6)
        # a disparity below 0 lies beyond infinity: seen where the depth, too, has turned
        depth = (position - w.destination_space.camera.pose.center) @ rotation[2] * states[:, :, 2]
        camera = w.destination_space.camera
        pixels = moved[:, :, :2].reshape(-1, 2)
        if camera.lens.code != 0:
            pixels = camera.distort_pixels(pixels)[0]
        edge = np.array([camera.width - 0.5, camera.height - 0.5])
        inside = ((pixels >= -0.5) & (pixels <= edge)).all(axis=1).reshape(count, size)
    seen = inside & (depth > 0.0)
    weights = seen / np.maximum(seen.sum(axis=1), 1)[:, None]
    moved[~seen] = 0.0
    means = (weights[:, None, :] @ moved)[:, 0]
    deviations = moved - means[:, None, :]
    covariances = np.swapaxes(deviations * weights[:, :, None], 1, 2) @ deviations
    return means, covariances, seen.sum(axis=1)


def _disagreement(multi_filter: DisparityFilter, workloads: list[Workload]) -> float:
    """Largest difference between the means by NumPy and by the package, in standard deviations.

    Over the components that lie wholly in view: only those does `move` take from these samples alone.
    """
    worst = 0.0
    for w in workloads:
        sources = Sources(w.means, w.covariances, w.homes, multi_filter.motion.arrays(w.dts))
        moved = move(sources, w.destination, multi_filter.sets, w.turn)
        means, _, _ = numpy_moments(w, multi_filter)
        whole = moved.status == IN_VIEW
        std = np.sqrt(np.diagonal(moved.covariances[whole], axis1=1, axis2=2))
        worst = max(worst, float((abs(means[whole] - moved.means[whole]) / std).max(initial=0.0)))
    return worst


def _measure(ways: dict[str, Callable[[], None]], repetitions: int) -> dict[str, float]:
    """Best time (s) of each way, the ways taking turns."""
    best = dict.fromkeys(ways, math.inf)
    for way in ways.values():
        way()  # compiles, fills caches
    gc.disable()
    for _ in range(repetitions):
        for name, way in ways.items():
            start = time.process_time()
            way()
            best[name] = min(best[name], time.process_time() - start)
    gc.enable()
    return best


def _parts(multi_filter: DisparityFilter, events: list[Event], repetitions: int) -> dict[str, float]:
    """Best time (ms per event) of the filter's three stages, each a call; `step` of the PMB filter is one for all."""
    best = {"predict": math.inf, "update": math.inf, "extract": math.inf}
    for _ in range(repetitions):
        spent = dict.fromkeys(best, 0.0)
        state = multi_filter.init()
        for event in events:
            t0 = time.process_time()
            prediction = multi_filter.predict(state, event)
            t1 = time.process_time()
            state, _ = multi_filter.update(state, prediction, event)
            t2 = time.process_time()
            state, _ = multi_filter.extract(state)
            t3 = time.process_time()
            spent["predict"] += t1 - t0
            spent["update"] += t2 - t1
            spent["extract"] += t3 - t2
        best = {name: min(value, spent[name]) for name, value in best.items()}
    return {name: 1e3 * value / len(events) for name, value in best.items()}


def _table(report: dict[str, Any]) -> str:
    names = {"filter": "filter step", "floor": "floor: bare kernels", "numpy": "NumPy, trips only"}
    lines = [
        f"{report['filter']}: {report['events']} events, {report['samples']} samples, "
        f"{report['components_per_event']:.0f} components an event, one thread, "
        f"best of {report['repetitions']}",
        f"{'':22}{'ms/event':>10}{'ns/trip':>10}",
    ]
    for name, title in names.items():
        lines.append(f"{title:22}{report['ms_per_event'][name]:10.3f}{report['ns_per_trip'][name]:10.1f}")
    lines.extend(f"  {name:20}{value:10.3f}" for name, value in report["filter_parts_ms_per_event"].items())
    most, targets = report["targets"]["filter_over_floor"], report["targets"]
    lines.append(
        f"filter {report['ms_per_event']['filter']:.3f} ms (target at most {targets['filter_ms_per_event']:g}), "
        f"filter / floor {report['filter_over_floor']:.2f}{'' if most is None else f' (target at most {most:g})'}, "
        f"NumPy / filter {report['numpy_over_filter']:.1f}"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
