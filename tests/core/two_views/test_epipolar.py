"""Epipolar distances of track pairs: the compiled loops give Sampson's distance, by its definition."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereophd.core.arrays import Array
from stereophd.core.calibration.pairing.track_pairs import TrackPairs
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose
from stereophd.core.two_views import epipolar

ROWS = 12


@pytest.fixture
def cameras() -> tuple[Camera, ...]:
    """Three cameras with different focal lengths."""
    rng = np.random.default_rng(5)
    return tuple(
        Camera(
            f"cam{k}", 640, 480, 500.0 + 40.0 * k, 520.0 - 30.0 * k, 320.0, 240.0,
            Pose(Rotation.from_rotvec(0.2 * rng.standard_normal(3)).as_matrix(), rng.standard_normal(3)), Lens(),
            Detector((1.0, 1.0), 0.9, 1.0),
        )
        for k in range(3)
    )  # fmt: skip


@pytest.fixture
def pairs() -> TrackPairs:
    """Three pairs of tracks, one of each two cameras, with rays that do not meet."""
    rng = np.random.default_rng(6)
    nothing = np.empty(0, dtype=np.int64)
    return TrackPairs(
        np.array([[1, 2], [0, 1], [0, 2]]),
        np.array([[0, 1], [2, 3], [4, 5]]),
        np.repeat([0, 1, 2], ROWS // 3),
        np.concatenate([0.3 * rng.standard_normal((ROWS, 2, 2)), np.ones((ROWS, 2, 1))], axis=2),
        rng.uniform(0.5, 2.0, ROWS),
        np.arange(ROWS, dtype=np.float64),
        nothing,
        nothing,
        None,
    )


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


def test_distances_are_those_of_the_definition(cameras: tuple[Camera, ...], pairs: TrackPairs) -> None:
    rows = np.array([11, 0, 5, 6])
    found = epipolar.epipolar_distances(cameras, pairs, rows)
    expected = []
    for row in rows:
        i, j = pairs.cameras[pairs.pair[row]]
        expected.append(sampson(cameras[i], cameras[j], *pairs.rays[row]) / pairs.sigma[row])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_moving_cameras_that_stand_still_give_the_same(cameras: tuple[Camera, ...], pairs: TrackPairs) -> None:
    rows = np.arange(ROWS)
    index = pairs.cameras[pairs.pair]
    rotations = np.stack([camera.pose.rotation for camera in cameras])[index]
    centers = np.stack([camera.pose.center for camera in cameras])[index]
    focal = np.array([[camera.fx, camera.fy] for camera in cameras])
    seen = np.ones(ROWS, dtype=np.bool_)
    seen[3] = False
    found = np.empty(ROWS)
    epipolar._moving_distances(
        rotations, centers, pairs.rays, seen, focal, pairs.cameras, pairs.pair, pairs.sigma, rows, found
    )
    expected = epipolar.epipolar_distances(cameras, pairs, rows)
    expected[3] = np.nan
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_pairs_of_cameras_are_in_order(pairs: TrackPairs) -> None:
    assert pairs.camera_pairs == [(0, 1), (0, 2), (1, 2)]
