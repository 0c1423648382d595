"""Bodies from boxes: the filter and each of its ingredients against the limit with known association.

    python benchmarks/crowds.py --count 20 --scenes 100
    python benchmarks/crowds.py --count 50 --scenes 100 --only base no_occlusion
    python benchmarks/crowds.py --count 15 --scenes 3 --duration 45 --boxes weak --only base

Scenes of `configs/crowd.yaml` with `--count` people, `--duration` seconds each; with `--boxes` scenes of
`benchmarks/room.yaml` whose boxes are worse than the filter assumes (`benchmarks/poor_boxes.py`). *Limit* is the same
extended Kalman filter of every body with the boxes that are its own, known to be so: it has no misses and no ghosts. A
line is the mean over the scenes with the half-width of its 95 % interval: MOTA, OSPA and trajectory GOSPA (order 2,
cutoff 1 m, a switch costs 1 m) in times of the limit of the same scene, misses, false estimates and switches a scene,
NEES per dimension of the position on the ground and of the height (1 is consistent), CPU time of an instant of four
cameras. The first two seconds are left out, and so are estimates farther than `MARGIN` from the rectangle in which all
people walk.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import common  # noqa: F401  # first: sets the number of threads

# isort: split
import numpy as np
from poor_boxes import DETECTORS, poor_frames

from stereophd.config.loading import load_config
from stereophd.core.arrays import Array
from stereophd.core.bodies import filter as body_filter
from stereophd.core.bodies import hypotheses as reduction
from stereophd.core.bodies.births import newborn_bodies
from stereophd.core.bodies.boxes import box_variances, boxes_of
from stereophd.core.bodies.filter import BodyFilter
from stereophd.core.bodies.outline import BOTTOM, LOG_AXES, STATE_SIZE, TOP, outline_boxes
from stereophd.core.bodies.prediction import predict_bodies
from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.distances.tgospa import trajectory_gospa
from stereophd.core.metrics.identities import clear_mot_figures, identity_switches
from stereophd.core.metrics.matching.clear_mot import match_within
from stereophd.core.metrics.scans import PointSets
from stereophd.core.simulation.detections import Scene, simulate_frames, truth_rows
from stereophd.pipeline.build import build_motion
from stereophd.pipeline.simulation import build_scene

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "crowd.yaml"
ROOM = Path(__file__).resolve().parent / "room.yaml"
ORDER, CUTOFF, SETTLED_S, MARGIN = 2.0, 1.0, 2.0, 0.8
# Estimates of an instant: labels, states (k, 6), covariances (k, 6, 6), heights and their standard deviations (k, 2).
Estimates = tuple[Array, Array, Array, Array]


@contextmanager
def patched(module: Any, values: Mapping[str, Any]) -> Iterator[None]:
    """Set values of a module for a while."""
    before = {name: getattr(module, name) for name in values}
    vars(module).update(values)
    try:
        yield
    finally:
        vars(module).update(before)


# Ingredients: what is changed of the shape, of the filter's module, and of the reduction's.
VARIANTS: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "base": ({}, {}, {}),
    "cameras_reversed": ({}, {}, {}),
    "no_occlusion": ({"hidden_loss": 0.0}, {}, {}),
    "no_cut_boxes": ({}, {"CUT_SHARE": 0.0}, {}),
    "no_exclusion": ({}, {}, {"exclusive_existence": lambda existence, *_: existence}),
    "frame_by_frame": ({"instant_s": 0.0}, {}, {}),
    "no_false_objects": ({}, {"STAYING_SHARE": 0.0}, {}),
    "one_gaussian": ({}, {}, {"MOST_HYPOTHESES": 1}),
    "no_ground": ({"ground": None}, {}, {}),
}


def simulated(
    seed: int, count: int, duration_s: float, boxes: str = "model"
) -> tuple[Any, Scene, list[Event], list[Array]]:
    """Return configuration, scene, events and the true objects of the boxes of each event."""
    path = CONFIG if boxes == "model" else ROOM
    loaded = load_config(path, [f"simulate.duration_s={duration_s}", f"simulate.walkers.count={count}"])
    cameras = loaded.build_cameras()
    scene = build_scene(loaded.config, cameras, np.random.SeedSequence(seed))
    events, owners, drawn = [], [], np.random.SeedSequence([seed, 1])
    frames = simulate_frames(scene, drawn) if boxes == "model" else poor_frames(scene, drawn, DETECTORS[boxes])
    for frame in frames:
        camera = cameras[frame.camera]
        event = make_event(camera, frame.camera, frame.log_time_s, frame.pixels, None, frame.frame, frame.sizes)
        events.append(event)
        owners.append(frame.object_id[event.rows])
    return loaded, scene, events, owners


def filtered(estimator: BodyFilter, events: list[Event]) -> tuple[dict[int, Estimates], float]:
    """Return the estimates after the last camera of each instant, and the CPU time of an instant, s."""
    state, out = estimator.init(), {}
    start = time.process_time()
    for event in events:
        state, _, found = estimator.step(state, event)
        assert found.extents is not None
        extents = found.extents[:, [0, 2]]
        out[round(event.time_s * 1e3)] = found.track_ids, found.states, found.covariances, extents
    return out, (time.process_time() - start) / len(out)


def limit(estimator: BodyFilter, events: list[Event], owners: list[Array]) -> dict[int, Estimates]:
    """Return the estimates of the same Kalman filter where every box is known to be of its object, or of none."""
    shape, rig = estimator.shape, estimator.rig
    labels, states, covariances, now = np.empty(0, int), np.empty((0, 8)), np.empty((0, 8, 8)), events[0].time_s
    out = {}
    for event, owner in zip(events, owners, strict=True):
        camera = rig.cameras[event.camera].at(event.time_s)
        states, covariances = predict_bodies(states, covariances, event.time_s - now, estimator.motion, shape)
        now, boxes = event.time_s, boxes_of(event, camera)
        projected, slopes = outline_boxes(states, camera, shape.direction)
        heights = projected[:, BOTTOM] - projected[:, TOP]
        for row, label in enumerate(labels):
            for box in np.flatnonzero((owner == label) & np.isfinite(projected[row]).all()):
                noise = np.diag(box_variances(heights[row], boxes.scales[box], np.array(camera.detector.box_noise)))
                best = (np.inf, None, None)
                for cut in (False, True):
                    keep = ~boxes.hidden[box]
                    if cut:
                        keep = keep & (np.arange(4) != BOTTOM)
                    chosen = boxes.selections[box][keep]
                    observed = chosen @ slopes[row]
                    spread = observed @ covariances[row] @ observed.T + chosen @ noise @ chosen.T
                    residual = chosen @ (boxes.values[box] - projected[row])
                    cost = residual @ np.linalg.solve(spread, residual) + np.linalg.slogdet(2 * np.pi * spread)[1]
                    cost += 2.0 * np.log(max(heights[row], 1.0)) + 2.0 * np.log(10.0) if cut else 0.0
                    if cost < best[0]:
                        best = (cost, covariances[row] @ observed.T @ np.linalg.inv(spread), (residual, observed))
                assert best[1] is not None
                assert best[2] is not None
                states[row] += best[1] @ best[2][0]
                covariances[row] -= best[1] @ best[2][1] @ covariances[row]
        fresh = np.flatnonzero((owner >= 0) & ~np.isin(owner, labels) & ~boxes.hidden.any(axis=1))
        if len(fresh):
            born = newborn_bodies(boxes.take(fresh), camera, shape, estimator.settings.birth.velocity_std, rig.region)
            good = np.isfinite(born.log_densities)
            labels = np.concatenate([labels, owner[fresh[good]]])
            states = np.concatenate([states, born.states[good]])
            covariances = np.concatenate([covariances, born.covariances[good]])
        half = 2.0 * np.exp(states[:, LOG_AXES.start])
        extents = np.column_stack([half, half * np.sqrt(covariances[:, LOG_AXES.start, LOG_AXES.start])])
        out[round(event.time_s * 1e3)] = labels.copy(), states[:, :6].copy(), covariances[:, :6, :6].copy(), extents
    assert states.shape[1] == STATE_SIZE
    return out


def point_sets(rows: list[Estimates]) -> PointSets:
    """Return the estimates of scans as one table."""
    start = np.concatenate([[0], np.cumsum([len(row[0]) for row in rows])])
    labels, states, covariances, _ = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    return PointSets(start, states[:, :3], states[:, 3:6], labels, covariances[:, :3, :3])


def scores(estimates: dict[int, Estimates], scene: Scene) -> dict[str, float]:
    """Return the figures of a run."""
    assert scene.sized is not None
    truth: dict[int, list[tuple[int, Array]]] = {}
    for times, labels, states in truth_rows(scene):
        for time_s, label, row in zip(times, labels, states, strict=True):
            truth.setdefault(round(time_s * 1e3), []).append((int(label), row))
    when = [key for key in sorted(truth) if key in estimates and key >= SETTLED_S * 1e3]
    none = np.empty((0, 6, 6)), np.empty((0, 2))
    true = [(np.array([k for k, _ in truth[key]]), np.array([row[:6] for _, row in truth[key]]), *none) for key in when]
    places = np.concatenate([row for _, row, *_ in true])[:, :2]
    low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    inside = {key: ((estimates[key][1][:, :2] >= low) & (estimates[key][1][:, :2] <= high)).all(axis=1) for key in when}
    chosen = [tuple(part[inside[key]] for part in estimates[key]) for key in when]
    found = point_sets(chosen)
    known = point_sets([(a, b, np.zeros((len(a), 6, 6)), np.zeros((len(a), 2))) for a, b, *_ in true])
    pairs, near = match_within(found, known, score_scans(found, known, ORDER, CUTOFF), ORDER, CUTOFF, CUTOFF)
    x, y = pairs.pairs.estimate, pairs.pairs.truth
    off = found.position[x] - known.position[y]
    switched = identity_switches(pairs.pairs.scan, known.label[y], found.label[x])
    clear = clear_mot_figures(found, known, pairs, switched, np.linalg.norm(off, axis=1))
    assert found.covariance is not None
    level = np.linalg.solve(found.covariance[x][:, :2, :2], off[:, :2, None])[:, :, 0]
    extents = np.concatenate([row[3] for row in chosen])[x]
    heights = 2.0 * np.exp(scene.sized.log_axes[known.label[y], 0])
    return {
        "mota": clear["mota"],
        "ospa": float(pairs.ospa.distance.mean()),
        "tgospa": trajectory_gospa(found, known, near, ORDER, CUTOFF, CUTOFF).mean(ORDER),
        "missed": len(known.label) - len(y),
        "false": len(found.label) - len(x),
        "switches": int(switched.sum()),
        "nees_position": float(np.einsum("ni,ni->n", off[:, :2], level).mean() / 2.0),
        "nees_height": float((((extents[:, 0] - heights) / extents[:, 1]) ** 2).mean()),
        "error_m": float(np.median(np.linalg.norm(off, axis=1))),
    }


HEADS = ("MOTA", "OSPA, limits", "T-GOSPA, limits", "missed", "false", "switches", "NEES, ground", "NEES, height",
         "error, m", "ms")  # fmt: skip
COLUMNS = ("mota", "ospa_ratio", "tgospa_ratio", "missed", "false", "switches", "nees_position", "nees_height",
           "error_m", "ms")  # fmt: skip


def run(name: str, loaded: Any, scene: Scene, events: list[Event], best: dict[str, float]) -> dict[str, float]:
    """Return the figures of the filter, or of one that differs in an ingredient, on a scene."""
    changes, in_filter, in_reduction = VARIANTS[name]
    rig = make_rig(scene.cameras, 1.0, "horizontal")
    shape = replace(loaded.config.object, **changes)
    estimator = BodyFilter(rig, build_motion(loaded.config, loaded.path), shape, loaded.config.filter)
    if name == "cameras_reversed":
        events = sorted(events, key=lambda event: (event.time_s, -event.camera))
    with patched(body_filter, in_filter), patched(reduction, in_reduction):
        estimates, seconds = filtered(estimator, events)
    row = scores(estimates, scene)
    return {**row, "ms": 1e3 * seconds, **{f"{key}_ratio": row[key] / best[key] for key in ("ospa", "tgospa")}}


def table(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of the table of all rows."""
    yield f"| people | boxes | filter | scenes | {' | '.join(HEADS)} |"
    yield "|" + "---|" * 14
    keys = [(row["count"], row["boxes"], row["name"]) for row in rows]
    for count, boxes, name in dict.fromkeys(keys):
        chosen = [row for row, key in zip(rows, keys, strict=True) if key == (count, boxes, name)]
        cells = []
        for key in COLUMNS:
            values = np.array([row[key] for row in chosen if key in row])
            half = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
            cells.append(f"{values.mean():.3f} ± {half:.3f}" if len(values) else "")
        yield f"| {count} | {boxes} | {name} | {len(chosen)} | " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--duration", type=float, default=10.0)
    parser.add_argument("--boxes", choices=["model", *DETECTORS], default="model")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first scene")
    parser.add_argument("--only", nargs="*", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument(
        "--rows", type=Path, help="keep the figures of each scene here, and print the table of them all"
    )
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if args.rows is not None and args.rows.exists():
        rows = [json.loads(line) for line in args.rows.read_text().splitlines()]
    for seed in range(args.first, args.first + args.scenes):
        loaded, scene, events, owners = simulated(seed, args.count, args.duration, args.boxes)
        rig = make_rig(scene.cameras, 1.0, "horizontal")
        known = BodyFilter(rig, build_motion(loaded.config, loaded.path), loaded.config.object, loaded.config.filter)
        best = scores(limit(known, events, owners), scene)
        new = [{"name": "limit", **best}]
        new += [{"name": name, **run(name, loaded, scene, events, best)} for name in args.only]
        rows += [{"count": args.count, "boxes": args.boxes, "seed": seed, **row} for row in new]
        if args.rows is not None:
            args.rows.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
