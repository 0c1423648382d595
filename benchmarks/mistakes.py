"""Which mistakes in a set-up are diagnosed, and whether correct set-ups stay without a warning.

    python benchmarks/mistakes.py [--seed 11] [--correct 30] [--only NAME ...] [--checks-only]

Makes each of 41 mistakes in a simulated scene of three cameras (`configs/quickstart.yaml` with another seed), runs
`track` with its checks and scores the tracks. Prints a table: the outcome (error, warning, silent), the cause that was
named, OSPA beside that of the correct set-up, and the verdict. Then checks that many correct set-ups, and reports the
warnings on them, which are false. Exit code 1 if a damaging mistake is silent.
With --checks-only nothing is tracked: only the checks that need no filter run, and no OSPA tells damage.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import logging
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.errors import InputError
from stereophd.pipeline.checks.check_log import check_log
from stereophd.pipeline.tracking.tracking_run import build_tracking

ROOT = Path(__file__).resolve().parent.parent
QUICKSTART = ROOT / "configs" / "quickstart.yaml"
CORRECT = ("configs/quickstart.yaml", "configs/paper/multi_object.yaml", "sample_data/hall.yaml")
CUTOFF = 1.0
# OSPA above this multiple of that of the correct set-up (and above this value) is damage.
DAMAGE, LEAST_DAMAGE = 1.5, 0.05
# Set-ups are cut to this duration.
DURATION_S = 12


@dataclass
class Setup:
    """A configuration, cameras and a log that a mistake changes in place."""

    config: dict[str, Any]
    cameras: dict[str, Any]
    log: pd.DataFrame

    def each(self, change: Callable[[dict[str, Any]], None]) -> None:
        """Change every camera."""
        for camera in self.cameras["cameras"].values():
            change(camera)


def rotation(camera: dict[str, Any]) -> np.ndarray[Any, Any]:
    """Rotation matrix of a camera entry."""
    pose = camera["pose"]
    if "rotation_matrix" in pose:
        return np.array(pose["rotation_matrix"])
    from stereophd.core.geometry.pose import rotation_from_vector

    return rotation_from_vector(np.deg2rad(pose.get("rotation_vector_deg", (0, 0, 0))))


def set_rotation(camera: dict[str, Any], matrix: np.ndarray[Any, Any]) -> None:
    """Give a camera entry a rotation matrix."""
    camera["pose"].pop("rotation_vector_deg", None)
    camera["pose"]["rotation_matrix"] = matrix.tolist()


def _transposed(camera: dict[str, Any]) -> None:
    set_rotation(camera, rotation(camera).T)


def _translation(camera: dict[str, Any]) -> None:
    camera["pose"]["center"] = (-rotation(camera) @ np.array(camera["pose"]["center"])).tolist()


def _both(camera: dict[str, Any]) -> None:
    _translation(camera)
    _transposed(camera)


def _radians(camera: dict[str, Any]) -> None:
    from stereophd.core.geometry.pose import rotation_to_vector

    vector = rotation_to_vector(rotation(camera))
    camera["pose"].pop("rotation_matrix", None)
    camera["pose"]["rotation_vector_deg"] = vector.tolist()


def _center(factor: float) -> Callable[[dict[str, Any]], None]:
    def change(camera: dict[str, Any]) -> None:
        camera["pose"]["center"] = [factor * x for x in camera["pose"]["center"]]

    return change


def _size(camera: dict[str, Any], factor: tuple[float, float]) -> None:
    camera["image_size_px"] = [round(s * f) for s, f in zip(camera["image_size_px"], factor, strict=True)]


def _intrinsics(focal: float, point: float) -> Callable[[dict[str, Any]], None]:
    def change(camera: dict[str, Any]) -> None:
        for name in ("fx", "fy"):
            camera["intrinsics"][name] *= focal
        for name in ("cx", "cy"):
            camera["intrinsics"][name] *= point

    return change


def _lens(factor: float) -> Callable[[dict[str, Any]], None]:
    def change(camera: dict[str, Any]) -> None:
        if camera.get("distortion", {}).get("model", "none") != "none":
            camera["distortion"]["k1"] *= factor

    return change


def _log(change: Callable[[pd.DataFrame], None]) -> Callable[[Setup], None]:
    return lambda setup: change(setup.log)


def _times(select: str | None, change: Callable[[pd.Series[float]], pd.Series[float]]) -> Callable[[Setup], None]:
    def apply(setup: Setup) -> None:
        rows = slice(None) if select is None else setup.log["camera"] == select
        setup.log.loc[rows, "time_s"] = change(setup.log.loc[rows, "time_s"])

    return apply


def _frames_as_times(setup: Setup) -> None:
    setup.log["time_s"] = setup.log["frame"].astype(float)


def _swap_entries(setup: Setup) -> None:
    cameras = setup.cameras["cameras"]
    cameras["left"], cameras["right"] = cameras["right"], cameras["left"]


def _from_below(setup: Setup) -> None:
    heights = {name: camera["image_size_px"][1] for name, camera in setup.cameras["cameras"].items()}
    setup.log["v_px"] = setup.log["camera"].map(heights) - 1.0 - setup.log["v_px"]


def _normalised(setup: Setup) -> None:
    for axis, column in enumerate(("u_px", "v_px")):
        sizes = {name: camera["image_size_px"][axis] for name, camera in setup.cameras["cameras"].items()}
        setup.log[column] = setup.log[column] / setup.log["camera"].map(sizes)


def _swap_columns(setup: Setup) -> None:
    setup.log[["u_px", "v_px"]] = setup.log[["v_px", "u_px"]].to_numpy()


def _detector(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda camera: camera["detector"].__setitem__(key, value)


def _set(path: str, change: Callable[[Any], Any]) -> Callable[[Setup], None]:
    def apply(setup: Setup) -> None:
        *folders, key = path.split(".")
        place = setup.config
        for folder in folders:
            place = place.setdefault(folder, {})
        place[key] = change(place.get(key))

    return apply


def _scaled(value: Any) -> Any:
    return [100.0 * x for x in value] if isinstance(value, list) else 100.0 * value


def _all(*changes: Callable[[Setup], None]) -> Callable[[Setup], None]:
    def apply(setup: Setup) -> None:
        for change in changes:
            change(setup)

    return apply


def _each(change: Callable[[dict[str, Any]], None]) -> Callable[[Setup], None]:
    return lambda setup: setup.each(change)


def _one(name: str, change: Callable[[dict[str, Any]], None]) -> Callable[[Setup], None]:
    return lambda setup: change(setup.cameras["cameras"][name])


LENS = ("lens_missing", "lens_inaccurate")
# Mistake -> how it is made, and the causes that name it rightly.
MISTAKES: dict[str, tuple[Callable[[Setup], None], tuple[str, ...]]] = {
    "rotation transposed": (_each(_transposed), ("rotation_transposed",)),
    "centre given as t": (_each(_translation), ("center_is_translation",)),
    "camera-to-world (both)": (_each(_both), ("camera_to_world", "rotation_transposed")),
    "OpenGL axes": (_each(lambda c: set_rotation(c, np.diag([1.0, -1, -1]) @ rotation(c))), ("opengl_axes",)),
    "det R = -1": (_each(lambda c: set_rotation(c, np.diag([1.0, 1, -1]) @ rotation(c))), ("error",)),
    "R not orthonormal": (_each(lambda c: set_rotation(c, 1.01 * rotation(c))), ("error",)),
    "rotation vector in radians": (_each(_radians), ("rotation_radians",)),
    "two cameras swapped": (_swap_entries, ("cameras_exchanged",)),
    "centres in another unit": (_each(_center(100.0)), ("depth_range", "center_unit")),
    "image size too small": (_each(lambda c: _size(c, (0.5, 0.5))), ("error", "image_size")),
    "image size too large": (_each(lambda c: _size(c, (2.0, 2.0))), ("image_size",)),
    "width and height swapped": (
        _each(lambda c: c["image_size_px"].reverse()), ("error", "outside_image", "width_height_exchanged"),
    ),
    "u and v swapped": (_swap_columns, ("u_v_swapped", "outside_image", "error")),
    "v from the bottom": (_from_below, ("v_from_below",)),
    "pixels normalised": (_normalised, ("pixels_normalised",)),
    "focal length in mm": (_each(_intrinsics(1 / 120.0, 1.0)), ("focal_length_millimetres",)),
    "principal point of another resolution": (_each(_intrinsics(1.0, 2.0)), ("principal_point_resolution",)),
    "intrinsics of another resolution": (_each(_intrinsics(0.5, 0.5)), ("intrinsics_resolution",)),
    "lens left out": (_each(lambda c: c.__setitem__("distortion", {"model": "none"})), LENS),
    "sign of the lens reversed": (_each(_lens(-1.0)), LENS),
    "times in milliseconds": (_times(None, lambda t: 1000.0 * t), ("milliseconds",)),
    "frame number as time": (_frames_as_times, ("frame_number_as_time",)),
    "wrong frame rate of one camera": (_times("right", lambda t: t * 25.0 / 30.0), ("frame_rate", "clock_rate")),
    "one camera 0.05 s off": (_times("right", lambda t: t + 0.05), ("clock_offset",)),
    "one camera 0.5 s off": (_times("right", lambda t: t + 0.5), ("clock_offset",)),
    "one camera an epoch off": (_times("right", lambda t: t + 1.7e9), ("clock_offset",)),
    "names in another case": (_log(lambda t: t.__setitem__("camera", t["camera"].str.upper())), ("error",)),
    "pD in per cent": (_each(_detector("p_detect", 98.0)), ("error",)),
    "survival in per cent": (_set("filter.survival_per_s", lambda _: 95.0), ("error",)),
    "clutter 0": (_each(_detector("clutter_per_frame", 0.0)), ("clutter",)),
    "noise far too small": (_each(_detector("sigma_px", [0.02, 0.02])), ("sigma",)),
    "depth range in another unit": (_set("filter.birth.depth_range", _scaled), ("depth_range",)),
    "velocity in another unit": (_set("filter.birth.velocity_std", _scaled), ("velocity_std",)),
    "acceleration in another unit": (_set("motion.acceleration_std", _scaled), ("acceleration_std",)),
    "depth, velocity, acceleration": (
        _all(_set("filter.birth.depth_range", _scaled), _set("filter.birth.velocity_std", _scaled),
             _set("motion.acceleration_std", _scaled)), ("depth_range", "velocity_std", "acceleration_std"),
    ),
    "speed limit in another unit": (_set("motion.max_speed", lambda v: v / 100.0), ("max_speed", "error")),
    "region in another unit": (_set("region", lambda _: {"depth": [200.0, 3000.0]}), ("region", "error")),
    "no acceleration stated": (_set("motion.acceleration_std", lambda _: 0.0), ("acceleration_std", "error")),
    "misspelt key": (_set("filter.birth.per_frme", lambda _: 0.1), ("error",)),
    "misspelt section": (_set("filtre", lambda _: {"kind": "pmb"}), ("error",)),
    "another unit name everywhere": (
        _all(_set("units.length", lambda _: "cm"), lambda s: s.cameras["units"].__setitem__("length", "cm")), (),
    ),
}  # fmt: skip


def run(setup: Setup, truth: Path, folder: Path, tracked: bool = True) -> tuple[str, list[str], float]:
    """Track a set-up; return the outcome (error, warning, silent), the causes named, and OSPA (NaN if not tracked)."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(setup.config, sort_keys=False))
    (folder / "cameras.yaml").write_text(yaml.safe_dump(setup.cameras, sort_keys=False))
    order = setup.log.sort_values(["time_s", "camera", "frame"], kind="stable")
    order.to_parquet(folder / "log.parquet", index=False)
    try:
        loaded = load_config(folder / "config.yaml", (), None, folder / "cameras.yaml")
        if tracked:
            checks = track(loaded, folder / "log.parquet", folder / "out")["checks"]
        else:
            build_tracking(loaded)
            checks = [one.as_dict() for one in check_log(loaded, folder / "log.parquet", of_rows=False)]
    except InputError:
        return "error", ["error"], float("nan")
    causes = [found["cause"] for found in checks if found["status"] == "warning"]
    if not tracked:
        return ("warning" if causes else "silent"), causes, float("nan")
    try:
        score = evaluate(folder / "out" / "tracks.parquet", truth, None, cutoff=CUTOFF)["ospa"]["mean"]
    except InputError:
        score = CUTOFF
    return ("warning" if causes else "silent"), causes, float(score)


def main() -> int:
    """Run all mistakes and correct set-ups; return the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--correct", type=int, default=30)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--checks-only", action="store_true")
    options = parser.parse_args()
    logging.getLogger("stereophd").setLevel(logging.CRITICAL)
    silent = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loaded = load_config(QUICKSTART, [f"seed={options.seed}", f"simulate.duration_s={DURATION_S}"])
        simulate(loaded, folder / "scene")
        base = Setup(
            yaml.safe_load(QUICKSTART.read_text()),
            yaml.safe_load((folder / "scene" / "cameras.yaml").read_text()),
            pd.read_parquet(folder / "scene" / "detections.parquet").drop(columns="object_id"),
        )
        base.config.pop("cameras")
        # without metadata: the name of the unit is one of the mistakes
        truth = folder / "truth.parquet"
        pd.read_parquet(folder / "scene" / "truth.parquet").to_parquet(truth, index=False)
        tracked = not options.checks_only
        _, _, best = run(copy.deepcopy(base), truth, folder / "correct", tracked)
        print(
            f"correct set-up: OSPA {best:.4f}\n\n| mistake | outcome | causes named | OSPA | verdict |\n|" + 5 * "---|"
        )
        counts: dict[str, int] = {}
        for number, (title, (change, right)) in enumerate(MISTAKES.items()):
            if options.only and title not in options.only:
                continue
            setup = copy.deepcopy(base)
            change(setup)
            outcome, causes, score = run(setup, truth, folder / str(number), tracked)
            named = any(cause in right for cause in causes)
            damaging = score > max(DAMAGE * best, LEAST_DAMAGE)
            quiet = "SILENT" if damaging else "harmless" if tracked else "silent"
            verdict = "named" if named else "warned" if outcome != "silent" else quiet
            silent += verdict == "SILENT"
            counts[verdict] = counts.get(verdict, 0) + 1
            print(f"| {title} | {outcome} | {', '.join(map(str, causes))} | {score:.4f} | {verdict} |", flush=True)
        print(f"\n{counts}\n")
        false = sum(_false_warnings(k, folder / f"correct-{k}", tracked) for k in range(options.correct))
        if options.correct:
            print(f"false warnings on {options.correct} correct set-ups: {false}")
    return int(silent > 0)


def _false_warnings(k: int, folder: Path, tracked: bool) -> int:
    """Return the number of warnings on a correct set-up, and print them."""
    config = ROOT / CORRECT[k % len(CORRECT)]
    loaded = load_config(config, [f"seed={1000 + k}"])
    with contextlib.redirect_stdout(sys.stderr):
        simulate(loaded, folder / "scene")
    log = folder / "scene" / "detections.parquet"
    if tracked:
        checks = track(loaded, log, folder / "out")["checks"]
    else:
        checks = [one.as_dict() for one in check_log(loaded, log, of_rows=False)]
    found = [one for one in checks if one["status"] == "warning"]
    for one in found:
        print(f"false: {config.name} seed {1000 + k}: {one['name']}: {one['message']}", flush=True)
    return len(found)


if __name__ == "__main__":
    sys.exit(main())
