"""Cameras around a floor, z up, for the tests of bodies."""

from __future__ import annotations

import numpy as np

from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings, Extent, Ground
from stereophd.core.geometry.camera import Camera
from tests.scenes import build_camera


def camera_at(center: list[float], target: list[float], name: str = "a", p_detect: float = 0.95) -> Camera:
    """Return a camera at a place that looks at another, z being up."""
    forward = np.subtract(target, center) / np.linalg.norm(np.subtract(target, center))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    detector = {"noise": 20.0, "p_detect": p_detect, "clutter": 0.5}
    return build_camera(name, center, rotation, size=(1920, 1080), focal=(1100.0, 1050.0), **detector)


def people(**changes: object) -> EllipsoidSettings:
    """Return the shape of people on the floor."""
    values: dict[str, object] = {
        "height": Extent(mean=1.7, std=0.1),
        "width": Extent(mean=0.5, std=0.06),
        "up": (0.0, 0.0, 1.0),
        "ground": Ground(point=(0.0, 0.0, 0.0), std=0.05),
    }
    return EllipsoidSettings(**{**values, **changes})  # type: ignore[arg-type]


def standing(x: float, y: float, height: float = 1.7, width: float = 0.5) -> np.ndarray:
    """Return the state (8,) of a body that stands still."""
    return np.array([x, y, height / 2, 0.0, 0.0, 0.0, np.log(height / 2), np.log(width / 2)])
