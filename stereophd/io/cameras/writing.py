"""Write a ``cameras.yaml``: the form that a config takes inline or by path."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from stereophd.core.geometry.camera import BOX_NOISE, Camera
from stereophd.core.geometry.lens import PARAMETERS
from stereophd.core.geometry.pose import Pose
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig, CovarianceRows
from stereophd.io.tables.trajectories import pack_poses

CONVENTIONS = (
    "# Pose: x_camera = rotation_matrix @ (x_world - center); x right, y down, z forward; "
    "pixel (0, 0) is the centre of the top-left pixel.\n"
)


def cameras_text(
    cameras: Mapping[str, CameraConfig],
    length_unit: str,
    provenance: Mapping[str, Any] | None = None,
    covariance: CovarianceRows | None = None,
    note: str = "",
) -> str:
    """Return the text of a ``cameras.yaml``; reading it gives back equal cameras, to the last bit.

    Cameras are by name, in order; centres are in `length_unit`. A comment gives version, command, seed and hash of the
    configuration from the provenance, which is as `stereophd.io.outputs.provenance.provenance` returns it; the
    covariance of what calibrated cameras leave uncertain is in the rows of a lower triangle. `note` is a comment.
    """
    text = CONVENTIONS + (f"# {note}\n" if note else "")
    if provenance is not None:
        version, command, seed = provenance["version"], provenance["command"], provenance["seed"]
        text += f"# Made by stereophd {version} {command}, {'' if seed is None else f'seed {seed}, '}"
        text += f"config sha256 {provenance['config_sha256']}\n"
    document: dict[str, Any] = {"units": {"length": length_unit}, "cameras": plain_cameras(cameras)}
    if covariance:
        document["covariance"] = covariance
    # Flow style for the leaves only: one line for a matrix row or the intrinsics.
    return text + yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=1000)


def write_cameras(
    path: Path | str,
    cameras: Mapping[str, CameraConfig],
    length_unit: str,
    provenance: Mapping[str, Any] | None = None,
    covariance: CovarianceRows | None = None,
    note: str = "",
) -> None:
    """Write a ``cameras.yaml``; parameters as `cameras_text`."""
    Path(path).write_text(cameras_text(cameras, length_unit, provenance, covariance, note), encoding="utf-8")


def plain_cameras(cameras: Mapping[str, CameraConfig]) -> dict[str, Any]:
    """Return cameras as plain values, by name."""
    return {name: _plain(camera) for name, camera in cameras.items()}


def _plain(camera: CameraConfig) -> dict[str, Any]:
    """Return a camera as plain values, without defaults and absent values."""
    values = camera.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    if camera.distortion.model != "none":
        values["distortion"] = asdict(camera.distortion)
    return values


def camera_config(camera: Camera) -> CameraConfig:
    """Return the configuration that builds a camera; InputError if a value lies outside what a configuration allows."""
    lens = {name: getattr(camera.lens, name) for name in PARAMETERS[camera.lens.model]}
    values = {
        "image_size_px": [camera.width, camera.height],
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "pose": _pose_values(camera.pose),
        "detector": {
            "sigma_px": camera.detector.sigma.tolist(),
            "p_detect": camera.detector.p_detect,
            "clutter_per_frame": camera.detector.clutter_per_frame,
            "box_noise": None if camera.detector.box_noise == BOX_NOISE else camera.detector.box_noise,
        },
        "distortion": {"model": camera.lens.model, **lens},
        "frame_rate_hz": camera.frame_rate_hz,
        "phase_s": camera.phase_s,
        "clock": {"offset_s": camera.clock.offset_s, "rate": camera.clock.rate},
        "readout_s": camera.readout_s,
    }
    try:
        return CameraConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"camera {camera.name}: {where}: {first['msg']}") from None


def _pose_values(pose: Pose) -> dict[str, Any]:
    if pose.path is not None:
        mount = {"center": pose.path.center.tolist(), "rotation_matrix": pose.path.rotation.tolist()}
        return {"trajectory": {"file": "memory", "poses": pack_poses(pose.path.trajectory)}, "mount": mount}
    return {
        "center": pose.center.tolist(),
        "rotation_matrix": pose.rotation.tolist(),
        "velocity": pose.velocity.tolist(),
        "rotation_rate_deg_s": np.degrees(pose.rotation_rate).tolist(),
        "time_s": pose.time_s,
    }
