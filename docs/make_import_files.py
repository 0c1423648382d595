"""Write the files that docs/start/import.md begins with, as the programs of other laboratories write them.

    python docs/make_import_files.py insects docs/assets/insects   # three cameras, and truth.parquet
    python docs/make_import_files.py dltdv DIR   # flight-xypts.csv and flight-dltCoefs.csv, and truth.parquet

The scenes are simulated. `insects` has false and missed detections, and each camera its own clock offset; `dltdv` has
digitised points without false ones, rows from below, and a left-handed world, as easyWand may leave it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import yaml

from stereophd.commands.simulate import simulate
from stereophd.config.loading import load_config
from stereophd.core.geometry.pose import rotation_to_vector
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.formats.dlt import write_cameras
from stereophd.io.formats.opencv import write_yaml
from stereophd.io.interchange.cameras import take_apart

OFFSETS_S = {"gopro1": 0.0, "gopro2": 0.0042, "gopro3": -0.0031}
RATE_HZ = 60.0


def looking_at(center: list[float], target: list[float]) -> dict[str, Any]:
    """Return the pose of a camera that stands upright and looks at a point; y is down."""
    forward = np.subtract(target, center)
    forward = forward / np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    return {"center": center, "rotation_matrix": rotation.tolist()}


def scene(names: list[str], p_detect: float, clutter: float, lens: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a scene: cameras about a cage of half a metre, five animals in it."""
    centers = ([-0.9, -0.3, -0.9], [0.9, -0.2, -1.0], [0.1, -0.9, -1.2])
    cameras = {}
    for name, center in zip(names, centers, strict=True):
        cameras[name] = {
            "image_size_px": [1920, 1080],
            "intrinsics": {"fx": 1450.0, "fy": 1448.0, "cx": 957.2, "cy": 541.6},
            "pose": looking_at(center, [0.0, 0.0, 0.3]),
            "detector": {"sigma_px": [0.8, 0.8], "p_detect": p_detect, "clutter_per_frame": clutter},
            "distortion": lens,
            "frame_rate_hz": RATE_HZ,
        }
    for name, offset in OFFSETS_S.items():
        if name in cameras:
            cameras[name]["phase_s"] = offset + 0.0031
    box = {"x": [-0.2, 0.2], "y": [-0.15, 0.15], "z": [0.1, 0.5]}
    objects = {"count": 5, "box": box, "velocity_std": 0.05, "stay_in_view": "all"}
    return {
        "units": {"length": "m"},
        "seed": 12,
        "cameras": cameras,
        "simulate": {
            "duration_s": 6.0,
            "acceleration_std": 0.1,
            "truth_rate_hz": RATE_HZ,
            "object_id": True,
            "objects": objects,
        },
    }


def simulated(document: dict[str, Any], folder: Path) -> tuple[dict[str, CameraConfig], list[dict[str, Any]]]:
    """Simulate a scene; returns its cameras and the rows of its log, and keeps the truth."""
    with tempfile.TemporaryDirectory() as name:
        config = Path(name) / "scene.yaml"
        config.write_text(yaml.safe_dump(document))
        loaded = load_config(config)
        simulate(loaded, Path(name) / "out")
        rows = pq.read_table(Path(name) / "out" / "detections.parquet").to_pylist()
        (folder / "truth.parquet").write_bytes((Path(name) / "out" / "truth.parquet").read_bytes())
    return loaded.cameras, rows


def insects(folder: Path) -> None:
    """Write a table of detections, and a calibration as OpenCV's FileStorage writes it."""
    lens = {"model": "brown_conrady", "k1": -0.21, "k2": 0.06, "p1": 0.0004, "p2": -0.0003}
    cameras, rows = simulated(scene(list(OFFSETS_S), 0.93, 1.5, lens), folder)
    lines = ["cam,frame,x,y"]
    lines += [f"{r['camera']},{r['frame']},{r['u_px']:.3f},{r['v_px']:.3f}" for r in rows if r["u_px"] is not None]
    (folder / "points.csv").write_text("\n".join(lines) + "\n")
    document = {}
    for name, config in cameras.items():
        parts = take_apart(name, config)
        document[name] = {
            "image_width": parts.size[0],
            "image_height": parts.size[1],
            "K": parts.matrix,
            "D": parts.coefficients[:5],
            "rvec": rotation_to_vector(parts.rotation),
            "tvec": parts.translation,
        }
    (folder / "calibration.yml").write_text(write_yaml(document))


def dltdv(folder: Path) -> None:
    """Write digitised points and coefficients in a left-handed world."""
    cameras, rows = simulated(scene(["cam1", "cam2", "cam3"], 0.9, 0.0, {"model": "none"}), folder)
    names = list(cameras)
    frames = 1 + max(row["frame"] for row in rows)
    points = 1 + max(row["object_id"] or 0 for row in rows)
    table = np.full((frames, points, len(names), 2), np.nan)
    for row in rows:
        if row["u_px"] is not None:
            # the centre of the first pixel is (1, 1), and rows count from below
            below = cameras[row["camera"]].image_size_px[1] - row["v_px"]
            table[row["frame"], row["object_id"], names.index(row["camera"])] = row["u_px"] + 1, below
    header = [f"pt{p + 1}_cam{c + 1}_{axis}" for p in range(points) for c in range(len(names)) for axis in "XY"]
    lines = [",".join("NaN" if np.isnan(x) else f"{x:.3f}" for x in row) for row in table.reshape(frames, -1)]
    (folder / "flight-xypts.csv").write_text("\n".join([",".join(header), *lines]) + "\n")
    write_cameras(cameras, "m", folder / "flight-dltCoefs.csv")
    coefficients = np.loadtxt(folder / "flight-dltCoefs.csv", delimiter=",")
    coefficients[[2, 6, 10]] *= -1  # z reversed
    np.savetxt(folder / "flight-dltCoefs.csv", coefficients, delimiter=",", fmt="%.12g")


def main(kind: str = "", target: str = "") -> None:
    """Write the files of one kind into a new folder."""
    if kind not in ("insects", "dltdv") or not target:
        raise SystemExit(__doc__)
    folder = Path(target)
    folder.mkdir(parents=True, exist_ok=True)
    {"insects": insects, "dltdv": dltdv}[kind](folder)


if __name__ == "__main__":
    main(*sys.argv[1:])
