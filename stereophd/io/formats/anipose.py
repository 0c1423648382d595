"""aniposelib: cameras of a ``calibration.toml``.

One table for each camera: ``name``, ``size``, ``matrix``, ``distortions`` (OpenCV's order; four of a fisheye lens
with ``fisheye = true``), ``rotation`` (a rotation vector) and ``translation``.

Conventions: pixels and camera axes are the native ones; ``x_camera = R x_world + t``. Lengths have the unit of the
calibration board, which the file does not name (usually millimetres). Points in space (``pose-3d``, a table with
columns ``nose_x``, ... and ``fnum``) are the truth.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereophd.core.geometry.pose import rotation_to_vector
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.interchange.base import ForeignRecording, Format, ImportOptions
from stereophd.io.interchange.cameras import take_apart, unit
from stereophd.io.interchange.documents.toml_cameras import read_toml, toml_camera
from stereophd.io.interchange.truth import wide_truth


def read(sources: Sequence[Path], options: ImportOptions) -> ForeignRecording:
    """Read cameras."""
    recording = ForeignRecording(files=list(sources))
    for path in sources:
        document = read_toml(path)
        tables = _camera_tables(document)
        if not tables:
            raise InputError(f"{path}: expected tables [cam_N] with a name and a matrix, found none")
        for key, values in tables.items():
            name = options.name(str(values.get("name", key)))
            recording.cameras[name] = toml_camera(name, values, options, str(path))
        stated = document.get("metadata", {}).get("length_unit")
        if recording.length_unit is None:
            is_stated = isinstance(stated, str) and options.length_unit is None
            recording.length_unit = str(stated) if is_stated else unit(options, recording)
    if options.truth is not None:
        recording.truth = wide_truth(options.truth, "fnum")
    return recording


def _camera_tables(document: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {
        key: value
        for key, value in document.items()
        if isinstance(value, dict) and "name" in value and "matrix" in value
    }


def recognises_cameras(path: Path) -> bool:
    """Whether a file is TOML with tables that have a name and a matrix."""
    return path.suffix.lower() == ".toml" and bool(_camera_tables(read_toml(path)))


def write_cameras(cameras: Mapping[str, CameraConfig], length_unit: str, target: Path) -> list[str]:
    """Write cameras as aniposelib reads them."""
    lines = []
    for index, (name, config) in enumerate(cameras.items()):
        parts = take_apart(name, config)
        # aniposelib's usual lens has five coefficients; three more only where they are needed
        count = 4 if parts.fisheye else 8 if parts.coefficients[5:].any() else 5
        lines += [
            f"[cam_{index}]",
            f"name = {json.dumps(name)}",
            f"size = {list(parts.size)}",
            f"matrix = {parts.matrix.tolist()}",
            f"distortions = {parts.coefficients[:count].tolist()}",
            f"rotation = {rotation_to_vector(parts.rotation).tolist()}",
            f"translation = {parts.translation.tolist()}",
            f"fisheye = {'true' if parts.fisheye else 'false'}",
            "",
        ]
    lines += ["[metadata]", "adjusted = false", "error = 0.0", f'length_unit = "{length_unit}"', ""]
    target.write_text("\n".join(lines), encoding="utf-8")
    return []


FORMAT = Format(
    "aniposelib: cameras (TOML)", read=read, recognises_cameras=recognises_cameras, write_cameras=write_cameras
)
