"""Kalibr: cameras of a ``camchain.yaml``.

Each camera has its intrinsics, distortion, resolution, and (from the second on) ``T_cn_cnm1``, which maps the
axes of the previous camera to its own. ``timeshift_cam_imu`` becomes the offset of the camera's clock.

Conventions: the world is the first camera; pixels and camera axes are the native ones; lengths are in metres. Models:
``pinhole`` with ``radtan`` (OpenCV's k1, k2, p1, p2), ``equidistant`` (OpenCV's fisheye) or ``none``.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.arrays import Array
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.documents import expecting, load_yaml, read_bytes
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions
from stereophd.io.interchange.cameras import Parts, image_size, put_together, take_apart

LENSES = {"radtan": False, "equidistant": True, "none": False}


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read the cameras of a chain."""
    if len(sources) != 1:
        raise InputError(f"expected one camchain, found {len(sources)} files")
    path = sources[0]
    document = _document(path)
    if document is None:
        raise InputError(f"{path}: expected a camchain: cam0, cam1, ... with camera_model and intrinsics")
    recording = ForeignRecording(files=[path], length_unit=options.length_unit or "m")
    recording.assumed.append("the world is the first camera of the chain")
    transform = np.eye(4)
    for index, (key, values) in enumerate(document.items()):
        with expecting("a camera of a camchain", where := f"{path}: {key}"):
            if index:
                transform = np.array(values["T_cn_cnm1"], dtype=np.float64) @ transform
            name = options.name(str(key))
            recording.cameras[name] = _camera(name, values, transform, options, where)
    return recording


def _document(path: Path) -> dict[str, dict[str, Any]] | None:
    document = load_yaml(read_bytes(path).decode("utf-8-sig"), str(path))
    if not isinstance(document, dict):
        return None
    cameras = {
        str(k): v for k, v in document.items() if isinstance(v, dict) and {"camera_model", "intrinsics"} <= v.keys()
    }
    return cameras or None


def _camera(name: str, values: Mapping[str, Any], transform: Array, options: ImportOptions, where: str) -> CameraConfig:
    model, lens = str(values["camera_model"]), str(values.get("distortion_model", "none"))
    if model != "pinhole" or lens not in LENSES:
        raise InputError(f"{where}: expected a pinhole camera with {', '.join(LENSES)}, found {model} with {lens}")
    fx, fy, cx, cy = map(float, values["intrinsics"])
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    coefficients = np.array(values.get("distortion_coeffs") or [0.0], dtype=np.float64)
    size = image_size(name, values.get("resolution"), options, where)
    rotation = transform[:3, :3]
    parts = Parts(matrix, coefficients, LENSES[lens], rotation, -rotation.T @ transform[:3, 3], size)
    shift = float(values.get("timeshift_cam_imu", 0.0))
    return put_together(name, parts, options, where, **({"clock": {"offset_s": shift}} if shift else {}))


def recognises_cameras(path: Path) -> bool:
    """Whether a file is YAML of cameras with ``camera_model`` and ``intrinsics``."""
    return path.suffix.lower() in (".yaml", ".yml") and path.is_file() and _document(path) is not None


def write_cameras(cameras: Mapping[str, CameraConfig], length_unit: str, target: Path) -> list[str]:
    """Write a camchain; the first camera becomes the world."""
    import yaml

    document: dict[str, Any] = {}
    losses = ["the world of the chain is its first camera"]
    before = None
    for name, config in cameras.items():
        parts = take_apart(name, config)
        if not parts.fisheye and parts.coefficients[4:].any():
            raise InputError(
                f"cameras.{name}: expected a lens of k1, k2, p1, p2 for this format, found more coefficients"
            )
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = parts.rotation, parts.translation
        values: dict[str, Any] = {
            "camera_model": "pinhole",
            "intrinsics": [float(parts.matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "distortion_model": "equidistant" if parts.fisheye else "radtan",
            "distortion_coeffs": parts.coefficients[:4].tolist(),
            "resolution": list(parts.size),
            "rostopic": f"/{name}/image_raw",
        }
        if before is not None:
            values["T_cn_cnm1"] = (transform @ np.linalg.inv(before)).tolist()
        if config.clock.offset_s:
            values["timeshift_cam_imu"] = config.clock.offset_s
        before = transform
        document[name] = values
    if length_unit != "m":
        losses.append(f"lengths are in {length_unit}, where Kalibr has metres")
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)
    target.write_text(text, encoding="utf-8")
    return losses


FORMAT = Format(
    "Kalibr: cameras of a camchain (YAML)",
    read=read,
    recognises_cameras=recognises_cameras,
    write_cameras=write_cameras,
)
