"""Rerun recordings (``.rrd``) for its viewer: tracks and cameras in 3-D, over time; written with rerun-sdk.

Its extra is ``rerun``. ``world/tracks/N`` has the positions of a track and its path, ``world/cameras/NAME`` the
pinhole cameras of the configuration that the tracks carry. World axes: right, down, forward, as the native ones.
Positions have single precision.
"""

from pathlib import Path
from typing import Any

import numpy as np

from stereophd.io.cameras.models import CameraConfig
from stereophd.io.documents import need_package
from stereophd.io.interchange.base import ExportOptions, Format
from stereophd.io.interchange.tracks import trajectories
from stereophd.io.outputs.provenance import from_metadata
from stereophd.io.tables.reading import read_metadata

TIMELINE = "time"


def write_tracks(tracks: Path, target: Path, options: ExportOptions) -> list[str]:
    """Write tracks, and the cameras of their provenance."""
    rr = need_package("rerun-sdk", "the format rerun", "rerun")
    found = trajectories(tracks, options)
    stream = rr.RecordingStream("stereophd")
    stream.save(str(target))
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    record = from_metadata(read_metadata(tracks, "table of tracks"))
    cameras = ((record or {}).get("config") or {}).get("cameras") or {}
    for name, values in cameras.items():
        _log_camera(rr, stream, name, CameraConfig.model_validate(values))
    for track, (times, states) in found.items():
        positions = states[:, :3]
        path = f"world/tracks/{track}"
        stream.log(f"{path}/path", rr.LineStrips3D([positions]), static=True)
        columns = rr.Points3D.columns(positions=positions)
        rr.send_columns(path, indexes=[rr.TimeColumn(TIMELINE, duration=times)], columns=columns, recording=stream)
        # after its last time a track is no longer there
        stream.set_time(TIMELINE, duration=float(times[-1]) + 1e-6)
        stream.log(path, rr.Clear(recursive=False))
    stream.flush()
    stream.disconnect()
    return ["positions have single precision"] if cameras else ["the tracks carry no cameras", "single precision"]


def _log_camera(rr: Any, stream: Any, name: str, config: CameraConfig) -> None:
    camera = config.build(name)
    path = f"world/cameras/{name}"
    # the pose of the camera in the world: from camera to world axes
    rotation = np.asarray(camera.pose.rotation.T)
    stream.log(path, rr.Transform3D(translation=camera.pose.center, mat3x3=rotation), static=True)
    pinhole = rr.Pinhole(
        resolution=[camera.width, camera.height],
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx, camera.cy],
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    stream.log(path, pinhole, static=True)


FORMAT = Format("Rerun: tracks and cameras for its viewer (.rrd)", write_tracks=write_tracks)
