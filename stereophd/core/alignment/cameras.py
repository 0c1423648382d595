"""Cameras in the frame and on the clock of a world."""

from dataclasses import replace

import numpy as np

from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.pose import Pose
from stereophd.core.metrics.truth.registration import Registration


def moved_camera(camera: Camera, registration: Registration) -> Camera:
    """Return a camera in the world; its pose still holds at ``pose.time_s``, now on the world's clock.

    Raises ValueError for a camera on a known trajectory, or whose pose changes from a time on.
    """
    if camera.pose.path is not None:
        raise ValueError(f"camera {camera.name} follows a known trajectory, or changes its pose: its frame stays")
    at = camera.pose.at(float(registration.track_times(np.array(camera.pose.time_s))))
    pose = Pose(
        at.rotation @ registration.rotation.T,
        registration.positions(at.center),
        registration.velocities(at.velocity),
        at.rotation_rate / registration.rate,
        camera.pose.time_s,
    )
    offset = float(registration.times(np.array(camera.clock.offset_s)))
    clock = Clock(offset, registration.rate * camera.clock.rate)
    return replace(camera, pose=pose, clock=clock, readout_s=registration.rate * camera.readout_s)
