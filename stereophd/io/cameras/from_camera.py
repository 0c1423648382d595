"""Build the configuration of a camera from the camera: the inverse of `CameraConfig.build`."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import ValidationError

from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import PARAMETERS
from stereophd.core.geometry.pose import Pose
from stereophd.errors import InputError
from stereophd.io.cameras.models import CameraConfig
from stereophd.io.tables.trajectories import pack_poses


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
