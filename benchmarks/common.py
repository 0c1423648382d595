"""What the benchmarks share: one thread, a log's events in memory, and drawn set-ups. Import it before NumPy."""

from __future__ import annotations

import os

# One thread, whatever NumPy was built with.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_name] = "1"

import json  # noqa: E402
import math  # noqa: E402
import tempfile  # noqa: E402
from collections.abc import Callable, Iterable, Sequence  # noqa: E402
from itertools import islice  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import pyarrow as pa  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402

from stereophd.config.calibration import BaselineScale  # noqa: E402
from stereophd.config.loading import LoadedConfig, load_config  # noqa: E402
from stereophd.core.disparity.events import Event  # noqa: E402
from stereophd.pipeline.stream import open_stream  # noqa: E402

PAPER_CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "multi_object.yaml"


def read_events(loaded: LoadedConfig, log: Path, most: int | None = None) -> list[Event]:
    """Return the events of a log, undistorted; at most so many."""
    return list(islice(open_stream(loaded.config, loaded.build_cameras(), log), most))


def measured_distance(distance: float, std: float, seed: int) -> float:
    """Return a distance as it is measured, with the error that is stated: a posterior counts on it."""
    return distance + std * float(np.random.default_rng([seed, 20261126]).standard_normal())


def with_measured_distance(path: Path, changes: Sequence[str], seed: int) -> list[str]:
    """Return changes of a configuration, in which a distance that is stated as known has its error."""
    section = load_config(path, changes).config.calibration
    if section is None or not isinstance(scale := section.scale, BaselineScale):
        return list(changes)
    return [*changes, f"calibration.scale.distance={measured_distance(scale.distance, scale.std, seed)!r}"]


def write_log(folder: Path, rows: list[tuple[Any, ...]]) -> None:
    """Write ``log.parquet`` of rows of time, s, camera, frame, u and v, px; a frame without detections has NaN."""
    rows.sort(key=lambda row: (row[0], row[1]))
    times, cameras, frames, u, v = (list(column) for column in zip(*rows, strict=True))
    pixels = {
        name: pa.array(np.array(values), mask=~np.isfinite(values)) for name, values in (("u_px", u), ("v_px", v))
    }
    pq.write_table(pa.table({"time_s": times, "camera": cameras, "frame": frames, **pixels}), folder / "log.parquet")


def rows_of_seeds(
    seeds: Iterable[int], keep: Path | None, one_run: Callable[[int, Path], dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return a row for each seed, printed at once; a run has a folder of its own, in `keep` if it is to stay."""
    rows = []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as temporary:
            folder = keep / str(seed) if keep else Path(temporary)
            folder.mkdir(parents=True, exist_ok=True)
            rows.append(one_run(seed, folder))
        print(json.dumps(rows[-1]), flush=True)
    return rows


# Sizes of the images of drawn cameras.
IMAGES = ((640, 480), (800, 600), (1280, 720), (1920, 1080))


def facing(center: np.ndarray[Any, Any], target: np.ndarray[Any, Any]) -> list[list[float]]:
    """Rotation (3, 3) from world to camera of a camera at `center` that looks at `target`, y down."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]).tolist()


class DrawnScene:
    """Cameras in a row before a cube, or in a ring around it, that look at its middle.

    The cube has the half side `size` and is `distance` before the origin.
    """

    def __init__(self, rng: np.random.Generator, count: int, size: float, distance: float, layout: str) -> None:
        self.rng, self.count, self.size, self.distance, self.layout = rng, count, size, distance, layout
        self.middle = np.array([0.0, 0.0, distance])

    def place(self, number: int, start: float) -> tuple[tuple[int, int], np.ndarray[Any, Any], float]:
        """Image size, centre and focal length of a camera; a ring begins at the angle `start`."""
        image, rng, distance = IMAGES[self.rng.integers(len(IMAGES))], self.rng, self.distance
        if self.layout == "row":
            spread = distance * rng.uniform(0.15, 0.5)
            center = np.array([spread * (number - (self.count - 1) / 2.0), *(rng.normal(0.0, 0.1 * distance, 2))])
        else:
            angle = start + 2.0 * math.pi * (number + rng.uniform(-0.3, 0.3)) / self.count
            center = self.middle + distance * np.array([math.sin(angle), -rng.uniform(0.0, 0.5), math.cos(angle)])
        return image, center, float(0.35 * image[1] * distance / self.size * rng.uniform(0.8, 1.4))

    def camera(self, image: tuple[int, int], center: np.ndarray[Any, Any], focal: float) -> dict[str, Any]:
        """Image, intrinsics and pose of a camera, as a configuration has them."""
        target = self.middle + self.rng.normal(0.0, 0.1 * self.size, 3)
        return {
            "image_size_px": list(image),
            "intrinsics": {"fx": focal, "fy": focal, "cx": (image[0] - 1) / 2.0, "cy": (image[1] - 1) / 2.0},
            "pose": {"center": center.tolist(), "rotation_matrix": facing(center, target)},
        }

    def tree(
        self, seed: int, cameras: dict[str, Any], objects: int, speed: float, time_constant: float, duration_s: float
    ) -> dict[str, Any]:
        """Configuration of the simulation of objects that keep to a speed, and of a filter that knows it."""
        motion = {
            "model": "damped_velocity",
            "time_constant_s": time_constant,
            "acceleration_std": speed / math.sqrt(time_constant),
        }
        depths = [0.4 * self.distance, 2.0 * self.distance]
        box = {axis: [float(m - self.size), float(m + self.size)] for axis, m in zip("xyz", self.middle, strict=True)}
        return {
            "units": {"length": "m"},
            "seed": seed,
            "cameras": cameras,
            "disparity": {"baseline": 0.1 * self.distance},
            "motion": {**motion, "max_speed": 8.0 * speed},
            "filter": {"kind": "pmb", "birth": {"per_s": 0.1, "depth_range": depths, "velocity_std": speed}},
            "simulate": {
                "duration_s": duration_s,
                "object_id": True,
                "motion": motion,
                "objects": {"count": objects, "box": box, "velocity_std": speed, "stay_in_view": "any"},
            },
        }
