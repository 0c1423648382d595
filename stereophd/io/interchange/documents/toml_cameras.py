"""Cameras in TOML, as caliscope and aniposelib write them."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.interchange.base import ImportOptions
from stereophd.io.interchange.cameras import Parts, image_size, put_together


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; InputError if it cannot be read, or is not TOML."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected TOML, found: {error}") from error


def toml_camera(name: str, values: Mapping[str, Any], options: ImportOptions, where: str) -> CameraConfig:
    """Return a native camera of a table with ``matrix``, ``distortions``, ``rotation``, ``translation`` and ``size``.

    Raises InputError when a key is missing or has another shape.
    """
    missing = [key for key in ("matrix", "distortions", "rotation", "translation") if key not in values]
    if missing:
        raise InputError(f"{where}: {name}: expected {', '.join(missing)}, found none: is the camera calibrated?")
    try:
        matrix = np.array(values["matrix"], dtype=np.float64).reshape(3, 3)
        coefficients = np.array(values["distortions"], dtype=np.float64).ravel()
        rotation = np.array(values["rotation"], dtype=np.float64)
        rotation = rotation_from_vector(rotation.ravel()) if rotation.size == 3 else rotation.reshape(3, 3)
        translation = np.array(values["translation"], dtype=np.float64).reshape(3)
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: {name}: expected arrays of numbers, found: {error}") from error
    stated = values.get("size")
    size = image_size(name, None if stated is None else (int(stated[0]), int(stated[1])), options, where)
    parts = Parts(matrix, coefficients, bool(values.get("fisheye", False)), rotation, -rotation.T @ translation, size)
    return put_together(name, parts, options, where)
