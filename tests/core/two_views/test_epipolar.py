"""Epipolar distances: arrays and compiled rows give Sampson's distance, by its definition; where rays meet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose
from stereophd.core.two_views.epipolar import (
    LEAST_SINE,
    distances_in_front,
    essential_matrices,
    nearest_depths,
    ray_distances,
    sampson_distances,
)
from stereophd.core.two_views.track_rays import Rays
from tests.scenes import build_camera

ROWS = 12


@pytest.fixture
def cameras() -> tuple[Camera, ...]:
    """Three cameras with different focal lengths."""
    rng = np.random.default_rng(5)
    return tuple(
        build_camera(
            f"cam{k}", turn=Rotation.from_rotvec(0.2 * rng.standard_normal(3)).as_matrix(),
            center=rng.standard_normal(3), size=(640, 480), focal=(500.0 + 40.0 * k, 520.0 - 30.0 * k),
            middle=(320.0, 240.0),
        )
        for k in range(3)
    )  # fmt: skip


@pytest.fixture
def rays() -> Rays:
    """Rays of each two cameras that do not meet."""
    rng = np.random.default_rng(6)
    slopes = np.concatenate([0.3 * rng.standard_normal((ROWS, 2, 2)), np.ones((ROWS, 2, 1))], axis=2)
    index = np.repeat([[1, 2], [0, 1], [0, 2]], ROWS // 3, axis=0)
    return Rays(slopes, np.arange(ROWS, dtype=np.float64), index, np.arange(ROWS) != 3)


def sampson(one: Camera, other: Camera, ray_a: Array, ray_b: Array) -> float:
    """Numerator over the length of its gradient with respect to the four pixels, by differences."""
    turn = other.pose.rotation @ one.pose.rotation.T
    along = other.pose.rotation @ (one.pose.center - other.pose.center)

    def numerator(pixels: Array) -> float:
        a = ray_a + np.array([pixels[0] / one.fx, pixels[1] / one.fy, 0.0])
        b = ray_b + np.array([pixels[2] / other.fx, pixels[3] / other.fy, 0.0])
        return float(b @ np.cross(along, turn @ a))

    steps = np.eye(4)
    gradient = np.array([(numerator(step) - numerator(-step)) / 2.0 for step in steps])
    return numerator(np.zeros(4)) / float(np.linalg.norm(gradient))


def test_distances_are_those_of_the_definition(cameras: tuple[Camera, ...], rays: Rays) -> None:
    sigma = np.linspace(0.5, 2.0, ROWS)
    expected = np.array([
        sampson(cameras[i], cameras[j], *pair) for (i, j), pair in zip(rays.cameras, rays.rays, strict=True)
    ])  # fmt: skip
    np.testing.assert_allclose(
        ray_distances(cameras, rays, sigma), np.where(rays.seen, expected / sigma, np.nan), rtol=1e-9
    )
    for row in range(ROWS):
        one, other = (cameras[k] for k in rays.cameras[row])
        essential = essential_matrices(one.pose.rotation, one.pose.center, other.pose.rotation, other.pose.center)
        scales = [np.array([camera.fx, camera.fy]) for camera in (one, other)]
        assert sampson_distances(essential, *rays.rays[row], *scales).signed == pytest.approx(expected[row], rel=1e-9)


def test_cameras_that_hardly_move_give_the_same(cameras: tuple[Camera, ...], rays: Rays) -> None:
    moving = replace(cameras[0], pose=Pose(cameras[0].pose.rotation, cameras[0].pose.center, [1e-12, 0.0, 0.0]))
    sigma = np.ones(ROWS)
    expected = ray_distances(cameras, rays, sigma)
    np.testing.assert_allclose(ray_distances((moving, *cameras[1:]), rays, sigma), expected, rtol=1e-9)


def test_rays_to_a_point_meet_at_its_depths(cameras: tuple[Camera, ...]) -> None:
    one, other = cameras[:2]
    points = np.array([[0.3, -0.2, 6.0], [1.0, 0.5, 9.0], [-1.0, 0.1, -7.0]])
    seen = [camera.pose.to_camera(points) for camera in (one, other)]
    directions = [
        (local / local[:, 2:]) @ camera.pose.rotation for local, camera in zip(seen, (one, other), strict=True)
    ]
    depth_a, depth_b, sines = nearest_depths(*directions, other.pose.center - one.pose.center)
    np.testing.assert_allclose(depth_a, seen[0][:, 2], rtol=1e-9)
    np.testing.assert_allclose(depth_b, seen[1][:, 2], rtol=1e-9)
    cosines = np.einsum("ni,ni->n", *(d / np.linalg.norm(d, axis=1)[:, None] for d in directions))
    np.testing.assert_allclose(sines, np.sqrt(1.0 - cosines**2), rtol=1e-6)


@pytest.mark.parametrize("apart", [1.0, -1.0, 0.0])
def test_distances_in_front_are_those_of_arrays(cameras: tuple[Camera, ...], apart: float) -> None:
    """Rays that meet before and behind cameras, that are parallel, or are not known; cameras at one place."""
    one, other = (camera.pose for camera in cameras[:2])
    # it looks across, from either side: rays meet before one camera and behind the other
    across = Rotation.from_rotvec([0.1, 1.4, 0.2]).as_matrix() @ other.rotation
    other = Pose(across, one.center + apart * (other.center - one.center))
    rng = np.random.default_rng(7)
    rays_a, rays_b = rng.normal(0.0, 0.5, (40, 3)), rng.normal(0.0, 0.5, (2, 40, 3, 3))
    rays_a[:, 2], rays_b[..., 2] = 1.0, 1.0
    rays_b[0, :10, 0] = rays_a[:10] @ one.rotation @ other.rotation.T
    rays_b[0, 10, 0], rays_a[11] = np.nan, np.nan
    essential = essential_matrices(one.rotation, one.center, other.rotation, other.center)
    scales = [np.array([500.0, 520.0]), np.array([540.0, 490.0]) / 2.0]
    turn, between = one.rotation @ other.rotation.T, one.rotation @ (other.center - one.center)
    signed = sampson_distances(essential, rays_a[:, None], rays_b, *scales).signed
    depth_a, depth_b, sines = nearest_depths(rays_a[:, None], rays_b @ turn.T, between)
    met = (sines < LEAST_SINE) | ((depth_a > 0.0) & (depth_b > 0.0))
    expected = np.where(met & np.isfinite(signed), signed, np.inf)
    found, depths = distances_in_front(essential, rays_a, rays_b, *scales, turn, between)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    parallel = sines < LEAST_SINE
    np.testing.assert_allclose(np.where(parallel, 0.0, depths), np.where(parallel, 0.0, depth_a), rtol=1e-7)
    assert np.isfinite(found).any() == (apart != 0.0)
    assert (np.isinf(found) & np.isfinite(depths)).any()
