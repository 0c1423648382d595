"""Cameras and lenses that the geometry tests share."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector

LENSES = {
    "none": Lens(),
    "radial_barrel": Lens("radial", k1=-0.15),
    "radial_pincushion": Lens("radial", k1=0.12),
    "polynomial": Lens("brown_conrady", k1=0.0375, k2=0.229, p1=0.0008, p2=-0.0006, k3=-0.789),
    "rational": Lens("brown_conrady", k1=0.11, k2=-0.05, p1=-0.002, p2=0.003, k3=0.01, k4=0.14, k5=-0.02, k6=0.004),
    "fisheye": Lens("fisheye", k1=-0.012, k2=0.004, k3=-0.003, k4=0.0004),
}


@pytest.fixture(params=list(LENSES))
def lens(request: pytest.FixtureRequest) -> Lens:
    """Each lens in turn."""
    return LENSES[request.param]


@pytest.fixture
def make_camera() -> Callable[[Lens], Camera]:
    """Make a camera with a pose and intrinsics that have no symmetry, and a given lens."""

    def make(lens: Lens, pose: Pose | None = None) -> Camera:
        if pose is None:
            pose = Pose(rotation_from_vector([0.3, -0.5, 0.2]), [1.5, -2.0, 0.7])
        return Camera("left", 1280, 720, 903.5, 871.25, 655.5, 340.75, pose, lens, Detector((1.5, 0.8), 0.9, 3.0))

    return make
