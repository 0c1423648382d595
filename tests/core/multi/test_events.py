"""Events: undistorted detections with their noise, in an order of their own; the cameras at any time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.disparity.events import make_event, make_rig
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.pose import Pose
from tests.core.disparity.cases import LENSES, make_camera


@pytest.mark.parametrize("lens", list(LENSES))
@pytest.mark.parametrize("own_sigma", [False, True])
def test_undistortion_carries_the_noise(lens: str, own_sigma: bool) -> None:
    camera = make_camera(lens=LENSES[lens], sigma=(1.4, 0.7))
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0.0, 0.0], [799.0, 599.0], (40, 2))
    sigma = rng.uniform(0.5, 2.0, (40, 2)) if own_sigma else np.tile([1.4, 0.7], (40, 1))
    event = make_event(camera, 3, 12.5, pixels, sigma if own_sigma else None)
    assert (event.camera, event.time_s) == (3, 12.5)
    assert (np.diff(event.points[:, 0]) >= 0.0).all()
    # back into the image
    distorted = camera.distort_pixels(event.points)[0]
    for point, covariance, area, back in zip(event.points, event.covariances, event.areas, distorted, strict=True):
        k = int(np.argmin(np.abs(pixels - back).sum(axis=1)))
        np.testing.assert_allclose(pixels[k], back, atol=1e-8)
        steps = 1e-3 * np.eye(2)
        jacobian = (
            camera.undistort_pixels(pixels[k] + steps)[0] - camera.undistort_pixels(pixels[k] - steps)[0]
        ).T / 2e-3
        np.testing.assert_allclose(covariance, jacobian @ np.diag(sigma[k] ** 2) @ jacobian.T, rtol=1e-5, atol=1e-6)
        assert area == pytest.approx(abs(np.linalg.det(jacobian)), rel=1e-5)
        assert np.isfinite(point).all()


@pytest.mark.parametrize("lens", ["none", "radial"])
def test_order_of_the_rows_does_not_matter(lens: str) -> None:
    camera = make_camera(lens=LENSES[lens])
    rng = np.random.default_rng(2)
    pixels = rng.uniform(0.0, 599.0, (30, 2))
    pixels[10:15, 0] = pixels[10, 0]  # ties in u
    sigma = rng.uniform(0.5, 2.0, (30, 2))
    first = make_event(camera, 0, 0.0, pixels, sigma)
    shuffled = rng.permutation(30)
    second = make_event(camera, 0, 0.0, pixels[shuffled], sigma[shuffled])
    for name in ("points", "covariances", "areas"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_detections_that_no_point_can_make_are_left_out() -> None:
    camera = make_camera(lens=LENSES["radial"])
    # r (1 - 0.15 r^2) never exceeds 0.994: no ray ends at r_d = 1.5
    far = [400.0 + 1.5 * 898.9, 300.0]
    event = make_event(camera, 0, 0.0, np.array([[300.0, 200.0], far]))
    assert len(event.points) == len(event.covariances) == len(event.areas) == 1
    np.testing.assert_allclose(camera.distort_pixels(event.points)[0], [[300.0, 200.0]], atol=1e-9)


def test_no_detections() -> None:
    for lens in LENSES.values():
        event = make_event(make_camera(lens=lens), 0, 0.0, np.empty((0, 2)))
        assert event.points.shape == (0, 2)
        assert event.covariances.shape == (0, 2, 2)
        assert event.areas.shape == (0,)


def test_rig_at_rest_and_moving() -> None:
    still = make_camera((0.1, 0.2, 0.3), (1.0, 2.0, 3.0))
    pose = Pose(still.pose.rotation, still.pose.center, (0.5, 0.0, -1.0), (0.0, 0.1, 0.0), time_s=2.0)
    moving = replace(still, pose=pose)
    at_rest = make_rig([still, still], 1.5, "vertical")
    assert not at_rest.moving
    expected = DisparitySpace(still, 1.5, "vertical").packed()
    np.testing.assert_array_equal(at_rest.space(1, 7.0), expected)
    np.testing.assert_array_equal(at_rest.spaces(np.array([0, 1, 0]), np.array([0.0, 1.0, 2.0])), [expected] * 3)

    rig = make_rig([still, moving], 1.5, "vertical")
    assert rig.moving
    cameras, times = np.array([1, 0, 1, 1]), np.array([0.0, 5.0, 5.0, 0.0])
    found = rig.spaces(cameras, times)
    for camera, time_s, packed in zip(cameras, times, found, strict=True):
        frozen = (still, moving)[camera].at(time_s)
        np.testing.assert_array_equal(packed, DisparitySpace(frozen, 1.5, "vertical").packed())
        np.testing.assert_array_equal(packed, rig.space(int(camera), float(time_s)))
    assert not np.array_equal(found[0], found[2])
    # the centre has moved by its velocity since its time
    np.testing.assert_allclose(rig.space(1, 4.0)[6:9], [2.0, 2.0, 1.0], rtol=1e-14)
