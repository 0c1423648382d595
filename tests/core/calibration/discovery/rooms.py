"""Objects that move in a room before cameras of which nothing is known, as one-camera tracks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from stereophd.core.arrays import Array
from stereophd.core.calibration.discovery.rig import View
from stereophd.core.geometry.camera import Camera, Clock
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.two_views.track_rays import RawTracks
from tests import scenes

NOISE, RATE, SECONDS = 0.5, 15.0, 30.0
Path = Callable[[Array], Array]


def camera(name: str, center: list[float], turn: list[float], offset: float = 0.0, k1: float = 0.0) -> Camera:
    lens = Lens("radial", k1=k1) if k1 else Lens()
    same = {"size": (1280, 720), "focal": 1000.0, "noise": NOISE, "p_detect": 0.95, "clutter": 0.1}
    return scenes.build_camera(name, center, turn, **same, lens=lens, clock=Clock(offset))


def cameras(offsets: tuple[float, ...] = (0.0, 0.0, 0.0)) -> tuple[Camera, ...]:
    """Three cameras around a room, 10 m from its middle."""
    return (
        camera("cam0", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], offsets[0]),
        camera("cam1", [6.0, -0.5, 1.5], [0.0, 0.62, 0.0], offsets[1]),
        camera("cam2", [-5.0, -1.0, 2.0], [0.1, -0.55, 0.0], offsets[2]),
    )


def curved(rng: np.random.Generator) -> Path:
    """An object that turns and speeds up."""
    phases, paces = rng.uniform(0.0, 6.0, (2, 3)), rng.uniform(0.2, 0.9, (2, 3))
    size = np.array([1.6, 0.9, 1.6])

    def path(times: Array) -> Array:
        waves = np.sin(paces[:, None] * times[None, :, None] + phases[:, None]).sum(axis=0)
        return np.asarray(size * waves + [0.0, 0.0, 10.0])

    return path


def straight(rng: np.random.Generator) -> Path:
    """An object of constant velocity that crosses the room."""
    middle = rng.uniform([-1.0, -0.7, 9.0], [1.0, 0.7, 11.0])
    velocity = rng.uniform(-1.0, 1.0, 3) * [0.12, 0.06, 0.12]
    return lambda times: middle + (times[:, None] - 0.5 * SECONDS) * velocity


def still(rng: np.random.Generator) -> Path:
    place = rng.uniform([-2.0, -1.0, 8.0], [2.0, 1.0, 12.0])
    return lambda times: np.repeat(place[None], len(times), axis=0)


def tracks_of(true: tuple[Camera, ...], paths: list[Path], rng: np.random.Generator) -> RawTracks:
    """Tracks of all objects before all cameras, on the clocks of the cameras, without detections outside the image."""
    owners, first, times, pixels = [], [0], [], []
    for number, one in enumerate(true):
        log_times = np.arange(0.01 * number, SECONDS, 1.0 / RATE)
        for path in paths:
            seen = one.project(path(one.clock.to_true(log_times))) + NOISE * rng.standard_normal((len(log_times), 2))
            usable = one.contains(seen) & (rng.random(len(seen)) < 0.95)
            if usable.sum() >= 6:
                owners.append(number)
                first.append(first[-1] + int(usable.sum()))
                times.append(log_times[usable])
                pixels.append(seen[usable])
    joined = np.concatenate(pixels)
    return RawTracks(np.array(owners), np.array(first), np.concatenate(times), joined, joined[:, 1] / 720.0)


def views_of(
    true: tuple[Camera, ...], focal: float = 1.02, focal_std: float = 0.05, clocks: bool = False
) -> list[View]:
    """What is known of the cameras: focal lengths that are off by a factor, no pose, and perhaps no clock."""
    return [
        View(
            replace(one, pose=Pose(np.eye(3), np.zeros(3)), clock=Clock(), fx=focal * one.fx, fy=focal * one.fy),
            focal_std, False, np.inf if clocks and number else 0.0, 0.0,
        )
        for number, one in enumerate(true)
    ]  # fmt: skip
