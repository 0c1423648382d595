"""Small scenes that the tests of the simulation share."""

from __future__ import annotations

import numpy as np

from stereophd.core.geometry.camera import Camera, Clock, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.simulation.detections import Scene, SimulatedFrame, simulate_frames
from stereophd.core.simulation.objects import MovingObject
from stereophd.core.simulation.timing import Schedule, TimeGrid

NO_NOISE = ConstantVelocity()


def camera(
    name: str = "camera",
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    sigma: float = 1.0,
    p_detect: float = 1.0,
    clutter: float = 0.0,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rotation_rate: tuple[float, float, float] = (0.0, 0.0, 0.0),
    clock: Clock | None = None,
    lens: Lens | None = None,
) -> Camera:
    """A 640x480 camera that looks along the world's z axis."""
    pose = Pose(
        rotation=np.eye(3),
        center=np.array(center),
        velocity=np.array(velocity),
        rotation_rate=np.array(rotation_rate),
    )
    return Camera(
        name=name,
        width=640,
        height=480,
        fx=500.0,
        fy=510.0,
        cx=319.5,
        cy=239.5,
        pose=pose,
        lens=lens or Lens("none"),
        detector=Detector((sigma, sigma), p_detect, clutter),
        clock=clock or Clock(),
    )


def moving_object(
    position: tuple[float, float, float] = (0.0, 0.0, 10.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    birth_s: float = 0.0,
    death_s: float = np.inf,
    object_id: int = 0,
    noise_seed: int = 5,
) -> MovingObject:
    """An object; by default at rest in front of `camera`."""
    return MovingObject(object_id, birth_s, death_s, np.array(position), np.array(velocity), noise_seed)


def scene(
    cameras: list[Camera],
    objects: list[MovingObject],
    duration_s: float = 10.0,
    rates_hz: list[float] | None = None,
    phases_s: list[float] | None = None,
    acceleration_std: float = 0.0,
) -> Scene:
    """A scene from time 0, cameras of 10 Hz unless said otherwise."""
    rates_hz = rates_hz or [10.0] * len(cameras)
    phases_s = phases_s or [0.0] * len(cameras)
    schedules = [Schedule(rate, 0.0, duration_s, phase) for rate, phase in zip(rates_hz, phases_s, strict=True)]
    return Scene(tuple(cameras), TimeGrid(tuple(schedules)), tuple(objects), ConstantVelocity(acceleration_std))


def frames_of(made: Scene, seed: int = 1) -> list[SimulatedFrame]:
    """All frames of a scene."""
    return list(simulate_frames(made, np.random.SeedSequence(seed)))
