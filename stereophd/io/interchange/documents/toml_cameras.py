"""Cameras in TOML, as caliscope and aniposelib write them."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.documents import expecting
from stereophd.io.interchange.base import ImportOptions
from stereophd.io.interchange.cameras import Parts, image_size, put_together


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; InputError if it cannot be read, or is not TOML."""
    with expecting("TOML", path):
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))


def toml_camera(name: str, values: Mapping[str, Any], options: ImportOptions, where: str) -> CameraConfig:
    """Return a native camera of a table with ``matrix``, ``distortions``, ``rotation``, ``translation`` and ``size``.

    Raises InputError when a key is missing or has another shape.
    """
    missing = [key for key in ("matrix", "distortions", "rotation", "translation") if key not in values]
    if missing:
        raise InputError(f"{where}: {name}: expected {', '.join(missing)}, found none: is the camera calibrated?")
    with expecting("arrays of numbers", f"{where}: {name}"):
        matrix = np.array(values["matrix"], dtype=np.float64).reshape(3, 3)
        coefficients = np.array(values["distortions"], dtype=np.float64).ravel()
        rotation = np.array(values["rotation"], dtype=np.float64)
        rotation = rotation_from_vector(rotation.ravel()) if rotation.size == 3 else rotation.reshape(3, 3)
        translation = np.array(values["translation"], dtype=np.float64).reshape(3)
    size = image_size(name, values.get("size"), options, where)
    parts = Parts(matrix, coefficients, bool(values.get("fisheye", False)), rotation, -rotation.T @ translation, size)
    return put_together(name, parts, options, where)
