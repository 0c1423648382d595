"""Write a ``cameras.yaml``: the form that a config takes inline or by path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from stereophd.io.cameras.models import CameraConfig

CONVENTIONS = (
    "# Pose: x_camera = rotation_matrix @ (x_world - center); x right, y down, z forward; "
    "pixel (0, 0) is the centre of the top-left pixel.\n"
)


def cameras_text(
    cameras: Mapping[str, CameraConfig], length_unit: str, provenance: Mapping[str, Any] | None = None
) -> str:
    """Return the text of a ``cameras.yaml``; reading it gives back equal cameras, to the last bit.

    Cameras are by name, in order; centres are in `length_unit`. A comment gives version, command, seed and hash of the
    configuration from the provenance, which is as `stereophd.io.outputs.provenance.provenance` returns it.
    """
    text = CONVENTIONS
    if provenance is not None:
        version, command, seed = provenance["version"], provenance["command"], provenance["seed"]
        text += f"# Made by stereophd {version} {command}, {'' if seed is None else f'seed {seed}, '}"
        text += f"config sha256 {provenance['config_sha256']}\n"
    document = {"units": {"length": length_unit}, "cameras": plain_cameras(cameras)}
    # Flow style for the leaves only: one line for a matrix row or the intrinsics.
    return text + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)


def write_cameras(
    path: Path | str,
    cameras: Mapping[str, CameraConfig],
    length_unit: str,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a ``cameras.yaml``; parameters as `cameras_text`."""
    Path(path).write_text(cameras_text(cameras, length_unit, provenance), encoding="utf-8")


def plain_cameras(cameras: Mapping[str, CameraConfig]) -> dict[str, Any]:
    """Return cameras as plain values, by name."""
    return {name: _plain(camera) for name, camera in cameras.items()}


def _plain(camera: CameraConfig) -> dict[str, Any]:
    """Return a camera as plain values, without defaults and absent values."""
    values = camera.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    if camera.distortion.model != "none":
        values["distortion"] = asdict(camera.distortion)
    return values
