"""Calibrate the drone recording with clocks of its own from a wrong guess, and score the trajectory against RTK.

    python benchmarks/drone_recording.py --seed 0 --out out/drone [--wrong 0.1] [--offset 0.3] [--focal 0.05] [--plot F]
    ... --control half                          the first half of RTK is a control track; no length is known
    ... --nothing unknown [--cameras cam0,cam1,cam3]        from nothing; --nothing known: focal lengths to 3 %

Poses are 2 m and 5 degrees off in random directions, clock offsets off by up to --offset, rates taken as 1, lenses as
supplied; --focal also takes all focal lengths off by this part (--set their priors with it), and --wrong replaces that
part of the detections by points anywhere in the image. With --nothing poses and offsets are unknown, the logs are up to
80 s apart besides, and no length is known (the alignment finds the scale); focal lengths are unknown, or 3 % off and
known so, and lenses are as supplied. With --control a part of RTK is given with a clock of its own, 12.5 s late, and
the tracks are compared with all of RTK, and with the second half, as they are: in its frame, on its clock. The
recording is not part of the project: its folder is $STEREOPHD_DATA/drone/1, or that of ../shared/data. Further `--set`
go to `calibrate`.

Distances are taken after alignment as by `evaluate` (rigid, or a similarity without a length; estimates that are far
off hardly count), at the times of RTK between two estimates of a track at most 0.25 s apart:
by the times of the results (the clock of cam0, rate 1); with the rate of that clock taken from the recording's authors;
and after the offset and rate of that clock that bring the tracks nearest to RTK, as `evaluate --align rigid
--align-clock` finds them. Offsets of clocks are compared at the first frame of each camera, and at the middle of its
detections on the clock of cam0.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from numpy.typing import NDArray

from stereophd.commands.calibrate import calibrate
from stereophd.config.loading import load_cameras, load_config
from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Clock
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.metrics.truth.interpolation import Truth
from stereophd.core.metrics.truth.registration import Freedom, Registration, TrackedPlaces, register
from stereophd.io.cameras.writing import write_cameras
from stereophd.pipeline.calibration.configured_unknowns import with_quantities

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "configs" / "drone_own_clocks.yaml"
LONGEST_STEP_S, NEAR_S, CONTROL_LATE_S = 0.25, 0.1, 12.5


def data_folder() -> Path:
    """Folder of the recording."""
    return Path(os.environ.get("STEREOPHD_DATA", ROOT.parent / "shared" / "data")) / "drone" / "1"


def write_guess(folder: Path, path: Path, seed: int, offset: float, focal: float) -> None:
    """Write cameras that are as far off as the head of this file says."""
    rng = np.random.default_rng(seed)
    supplied, clocks = (
        load_cameras(folder / "cameras_as_supplied.yaml").cameras,
        yaml.safe_load((folder / "clocks.yaml").read_text()),
    )
    cameras = []
    for number, (name, config) in enumerate(supplied.items()):
        camera = config.build(name)
        moved, turned, late = rng.standard_normal(3), rng.standard_normal(3), rng.uniform(-offset, offset)
        pose, start = camera.pose, float(clocks[name]["offset_s"])
        if number > 0:
            turn = rotation_from_vector(np.deg2rad(5.0) * turned / np.linalg.norm(turned))
            pose = Pose(turn @ pose.rotation, pose.center + 2.0 * moved / np.linalg.norm(moved))
            start += late
        factor = 1.0 + focal * rng.choice([-1.0, 1.0])
        cameras.append(
            replace(camera, pose=pose, clock=Clock(start, 1.0), fx=camera.fx * factor, fy=camera.fy * factor)
        )
    write_cameras(path, with_quantities(supplied, cameras), "m")


def write_nothing(folder: Path, path: Path, names: list[str], seed: int, is_known: bool) -> None:
    """Write a configuration that knows no pose and no offset, and focal lengths to 3 % or not at all."""
    rng, tree = np.random.default_rng(seed), yaml.safe_load(CONFIG.read_text())
    supplied = yaml.safe_load((folder / "cameras_as_supplied.yaml").read_text())["cameras"]
    start = yaml.safe_load((folder / "clocks.yaml").read_text())[names[0]]["offset_s"]
    tree["cameras"] = {}
    for name in names:
        intrinsics, factor = supplied[name]["intrinsics"], 1.0 + rng.choice([-0.03, 0.03])
        tree["cameras"][name] = {
            **supplied[name], "pose": "unknown",
            "clock": {"offset_s": float(start) if name == names[0] else "unknown"},
            "intrinsics": {**intrinsics, **{key: float(factor * intrinsics[key]) for key in ("fx", "fy")}}
            if is_known else {"focal": "unknown"},
        }  # fmt: skip
    priors = {name: {"focal_std": 0.03} for name in names} if is_known else {}
    tree["calibration"] = {"reference": names[0], "priors": priors, "annealed": tree["calibration"]["annealed"]}
    del tree["simulate"]
    path.write_text(yaml.safe_dump(tree))


def write_control(folder: Path, path: Path, config: Path, part: str) -> None:
    """Write RTK, or its first half, as a control track, and a configuration with it in place of a known distance."""
    truth = pq.read_table(folder / "truth.parquet", columns=["time_s", "x", "y", "z"])
    truth = truth.slice(0, len(truth) // 2) if part == "half" else truth
    late = pa.array(truth["time_s"].to_numpy() + CONTROL_LATE_S)
    pq.write_table(truth.set_column(0, "time_s", late), path)
    tree = yaml.safe_load(CONFIG.read_text())
    del tree["calibration"]["scale"]
    tree["calibration"]["control"] = str(path.absolute())
    config.write_text(yaml.safe_dump(tree))


def against_control(folder: Path, out: Path) -> dict[str, object]:
    """Distances of tracks from RTK, in the frame and on the clock of the control, and the scale that is left."""
    truth = pq.read_table(folder / "truth.parquet").to_pandas()
    times, path = truth["time_s"].to_numpy(), truth[["x", "y", "z"]].to_numpy()
    points, second = tracks_at(out, times + CONTROL_LATE_S), np.arange(len(times)) >= len(times) // 2
    known, result = np.isfinite(points[:, 0]) & seen_by_two(folder, times), {}
    for name, rows in (("all", known), ("second_half", known & second)):
        quantiles = np.quantile(np.linalg.norm(points[rows] - path[rows], axis=1), [0.5, 0.9])
        result[f"control.seen_by_two.{name}"] = [int(rows.sum()), *np.round(quantiles, 4).tolist()]
    return {**result, "scale_percent": round(100.0 * (1.0 / aligned(points[known], path[known], True).scale - 1.0), 3)}


def shifts_of(names: list[str], seed: int) -> dict[str, float]:
    """How much earlier each camera's log is made, s; that of the reference stays."""
    rng = np.random.default_rng([seed, 1])
    return {name: float(rng.uniform(-80.0, 80.0)) if name != names[0] else 0.0 for name in names}


def write_log(folder: Path, path: Path, seed: int, wrong: float, shifts: dict[str, float] | None = None) -> None:
    """Write the log, a part of its detections anywhere in the image; of some cameras, their times shifted."""
    table = pq.read_table(folder / "detections_own_clocks.parquet")
    if shifts is not None:
        frame = table.to_pandas()
        frame = frame[frame["camera"].isin(list(shifts))]
        frame["time_s"] -= frame["camera"].map(shifts)
        table = pa.Table.from_pandas(frame.sort_values(["time_s", "camera"], kind="stable"), preserve_index=False)
    u, v = (table[name].to_numpy(zero_copy_only=False).copy() for name in ("u_px", "v_px"))
    rng, seen = np.random.default_rng(seed), np.flatnonzero(np.isfinite(u))
    bad = rng.choice(seen, int(wrong * len(seen)), replace=False)
    u[bad], v[bad] = rng.uniform(0.0, 1919.0, len(bad)), rng.uniform(0.0, 1079.0, len(bad))
    for name, values in (("u_px", u), ("v_px", v)):
        column = pa.array(values, mask=~np.isfinite(values))
        table = table.set_column(table.schema.get_field_index(name), table.schema.field(name), column)
    pq.write_table(table, path)


def clock_of_tracks(out: Path, times: Array, path: Array, scale: bool) -> Registration:
    """How the frame, its scale and the clock of the tracks compare with RTK (positions (n, 3) at times (n,))."""
    table = pq.read_table(out / "tracks.parquet").to_pandas().sort_values("time_s", kind="stable")
    covariances = np.stack(table["covariance"].to_list()).reshape(-1, 6, 6)[:, :3, :3]
    points = table[["x", "y", "z"]].to_numpy()
    estimates = TrackedPlaces(table["time_s"].to_numpy(), points, covariances, table["track_id"].to_numpy())
    start, freedom = aligned(tracks_at(out, times), path, scale), Freedom(clock=True, scale=scale)
    return register(estimates, of_rtk(times, path), LONGEST_STEP_S, freedom, start).registration


def of_rtk(times: Array, path: Array) -> Truth:
    """Return positions (n, 3) at times as the truth of one object."""
    return Truth(times, np.zeros(len(times), dtype=np.int64), path)


def tracks_at(out: Path, times: Array) -> Array:
    """Positions (n, 3) of the tracks at times; NaN where no track has estimates around."""
    table = pq.read_table(out / "tracks.parquet").to_pandas()
    points = np.full((len(times), 3), np.nan)
    for _, track in table.groupby("track_id"):
        track = track.sort_values("time_s", kind="stable").drop_duplicates("time_s", keep="last")
        at = track["time_s"].to_numpy()
        if len(at) < 2:
            continue
        right = np.searchsorted(at, times).clip(1, len(at) - 1)
        near = (times >= at[0]) & (times <= at[-1]) & (at[right] - at[right - 1] <= LONGEST_STEP_S)
        for axis, name in enumerate("xyz"):
            points[near, axis] = np.interp(times[near], at, track[name].to_numpy())
    return points


def aligned(points: Array, truth: Array, scale: bool) -> Registration:
    """Return the rigid motion, or similarity, that brings points (n, 3) nearest to the truth, where they are known."""
    known = np.isfinite(points[:, 0])
    a, b = points[known].mean(axis=0), truth[known].mean(axis=0)
    u, sizes, vt = np.linalg.svd((points[known] - a).T @ (truth[known] - b))
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    factor = float((sizes * signs).sum() / ((points[known] - a) ** 2).sum()) if scale else 1.0
    turn = ((u * signs) @ vt).T
    return Registration(turn, b - factor * turn @ a, factor, 0.0, 0.0, 1.0, int(known.sum()))


def seen_by_two(folder: Path, times: Array) -> NDArray[np.bool_]:
    """Whether two cameras have a detection within 0.1 s of each time."""
    table = pq.read_table(folder / "detections.parquet").to_pandas().dropna(subset=["u_px"])
    count = np.zeros(len(times), dtype=int)
    for _, camera in table.groupby("camera"):
        at = np.sort(camera["time_s"].to_numpy())
        right = np.searchsorted(at, times).clip(1, len(at) - 1)
        count += np.minimum(np.abs(at[right] - times), np.abs(at[right - 1] - times)) < NEAR_S
    return count >= 2


def scores(folder: Path, out: Path, shifts: dict[str, float], scale: bool) -> dict[str, object]:
    """Distances from RTK, and errors of clocks and focal lengths against the recording's authors.

    The first camera of `shifts` has the clock of the tracks; `scale` says that their unit is unknown.
    """
    truth, clocks = (
        pq.read_table(folder / "truth.parquet").to_pandas(),
        yaml.safe_load((folder / "clocks.yaml").read_text()),
    )
    times, path = truth["time_s"].to_numpy(), truth[["x", "y", "z"]].to_numpy()
    for name, shift in shifts.items():
        clocks[name]["offset_s"] += clocks[name]["rate"] * shift
    reference = next(iter(shifts))
    start, rate = float(clocks[reference]["offset_s"]), float(clocks[reference]["rate"])
    two = seen_by_two(folder, times)
    result: dict[str, object] = {}
    found = clock_of_tracks(out, times, path, scale)
    result["clock"] = {"shift_s": round(found.shift_s, 4), "rate": round(found.rate, 6)}
    for name, at in (
        ("times_of_results", times),
        (f"rate_of_{reference}_known", start + (times - start) / rate),
        ("clock_aligned", found.track_times(times)),
    ):
        points = tracks_at(out, at)
        known = np.isfinite(points[:, 0])
        start_from, only = aligned(points, path, scale), Freedom(scale=scale)
        alike, one = np.tile(np.eye(3), (len(times), 1, 1)), np.zeros(len(times), dtype=np.int64)
        estimates = TrackedPlaces(times, points, alike, one).take(known)
        best = register(estimates, of_rtk(times, path), LONGEST_STEP_S, only, start_from).registration
        distance = np.linalg.norm(best.positions(points) - path, axis=1)
        for part, rows in (("all", known), ("seen_by_two", known & two)):
            quantiles = np.quantile(distance[rows], [0.5, 0.9])
            result[f"{name}.{part}"] = [int(rows.sum()), *np.round(quantiles, 4).tolist()]
    refined = load_cameras(folder / "cameras.yaml").cameras
    log = pq.read_table(folder / "detections_own_clocks.parquet").to_pandas().dropna(subset=["u_px"])
    for name, config in load_cameras(out / "cameras.yaml").cameras.items():
        camera, other = config.build(name), refined[name].build(name)
        middle = float(log.loc[log["camera"] == name, "time_s"].median()) - shifts[name]
        # the same moment by the authors' clocks, on the clock of the reference
        moment = float(clocks[name]["offset_s"]) + float(clocks[name]["rate"]) * middle
        of_reference = start + (moment - start) / rate
        result[name] = {
            "clock_offset_ms": round(1e3 * (camera.clock.offset_s - float(clocks[name]["offset_s"])), 1),
            "middle_ms": round(1e3 * (camera.clock.offset_s + camera.clock.rate * middle - of_reference), 1),
            "clock_rate": round(camera.clock.rate - float(clocks[name]["rate"]), 6),
            "focal_percent": round(100.0 * (camera.fx / other.fx - 1.0), 2),
        }
    return result


def draw(folder: Path, out: Path, path: Path) -> None:
    """Draw the trajectory from above and its height over time, with RTK."""
    import matplotlib.pyplot as plt

    truth = pq.read_table(folder / "truth.parquet").to_pandas()
    times, true = truth["time_s"].to_numpy(), truth[["x", "y", "z"]].to_numpy()
    found = tracks_at(out, times)
    found = aligned(found, true, scale=True).positions(found)
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.0, 4.0), layout="constrained")
    left.plot(true[:, 0], true[:, 1], color="0.7", lw=3.0, label="RTK")
    left.plot(found[:, 0], found[:, 1], color="C0", lw=1.0, label="tracks of the calibration")
    left.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    left.legend()
    right.plot(times - times[0], np.linalg.norm(found - true, axis=1), ".", ms=3.0)
    right.set(xlabel="time, s", ylabel="distance from RTK, m", ylim=(0.0, None))
    figure.savefig(path, dpi=100)


def main() -> None:
    """Run one guess."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--offset", type=float, default=0.3)
    parser.add_argument("--focal", type=float, default=0.0)
    parser.add_argument("--wrong", type=float, default=0.0)
    parser.add_argument("--nothing", choices=("known", "unknown"), help="no guess; whether focal lengths are known")
    parser.add_argument("--cameras", default="cam0,cam1,cam2,cam3", help="of --nothing; the first is the reference")
    parser.add_argument("--control", choices=("all", "half"), help="how much of RTK is a control track")
    parser.add_argument("--set", action="append", default=[], dest="changes")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--score-only", action="store_true", help="score an earlier run in --out")
    given = parser.parse_args()
    folder, out, names = data_folder(), given.out, given.cameras.split(",")
    shifts = shifts_of(names, given.seed) if given.nothing else dict.fromkeys(load_config(CONFIG).cameras, 0.0)
    if not given.score_only:
        out.parent.mkdir(parents=True, exist_ok=True)
        guess, log = out.with_name(f"{out.name}_guess.yaml"), out.with_name(f"{out.name}_log.parquet")
        write_log(folder, log, given.seed, given.wrong, shifts if given.nothing else None)
        if given.nothing:
            write_nothing(folder, guess, names, given.seed, given.nothing == "known")
            loaded = load_config(guess, given.changes)
        else:
            write_guess(folder, guess, given.seed, given.offset, given.focal)
            refined = load_cameras(folder / "cameras.yaml").cameras
            ends = [refined[name].build(name).pose.center for name in ("cam0", "cam1")]
            distance = float(np.linalg.norm(ends[0] - ends[1]))
            config, known = CONFIG, [f"calibration.scale.distance={distance}"]
            if given.control is not None:
                config, known = out.with_name(f"{out.name}.yaml"), []
                write_control(folder, out.with_name(f"{out.name}_control.parquet"), config, given.control)
            loaded = load_config(config, [*known, *given.changes], cameras_path=guess)
        begin = time.process_time()
        report = calibrate(loaded, log, out, force=True, plots=False)
        spent = round(time.process_time() - begin, 1)
        print(json.dumps({"status": report["status"], "reason": report["reason"], "processor_s": spent}))
    if (out / "cameras.yaml").exists():
        print(json.dumps(scores(folder, out, shifts, given.nothing is not None), indent=1))
        if given.control is not None:
            print(json.dumps(against_control(folder, out), indent=1))
    if given.plot is not None:
        draw(folder, out, given.plot)


if __name__ == "__main__":
    main()
