"""Cameras against OpenCV, and the compiled in-view test against the plain one."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from stereophd.core.geometry import layout
from stereophd.core.geometry.camera import Camera, Clock, Detector
from stereophd.core.geometry.compiled_lenses import pixel_in_view
from stereophd.core.geometry.lens import Lens
from stereophd.core.geometry.pose import Pose, rotation_from_vector, rotation_to_vector

MakeCamera = Callable[..., Camera]


def world_points(camera: Camera, n: int, seed: int, spread: float = 1.0) -> np.ndarray:
    """World points in front of a camera, in and around its image."""
    generator = np.random.default_rng(seed)
    depth = np.exp(generator.uniform(np.log(0.5), np.log(200.0), n))
    xy = generator.uniform(-spread, spread, (n, 2))
    limit = 0.99 * min(camera.lens.max_radius, 10.0)
    xy *= np.minimum(1.0, limit / np.hypot(*xy.T))[:, None]
    return camera.pose.to_world(np.column_stack([xy * depth[:, None], depth]))


def test_project_agrees_with_opencv(lens: Lens, make_camera: MakeCamera) -> None:
    camera = make_camera(lens)
    x = world_points(camera, 5000, seed=6)
    vector = rotation_to_vector(camera.pose.rotation)
    translation = -camera.pose.rotation @ camera.pose.center
    if lens.model == "fisheye":
        expected, _ = cv2.fisheye.projectPoints(
            x[:, None], vector, translation, camera.intrinsic_matrix, lens.coefficients[:4]
        )
    else:
        expected, _ = cv2.projectPoints(x, vector, translation, camera.intrinsic_matrix, lens.coefficients)
    np.testing.assert_allclose(camera.project(x), expected[:, 0], rtol=0, atol=1e-6)


def test_undistort_pixels_agrees_with_opencv(lens: Lens, make_camera: MakeCamera) -> None:
    camera = make_camera(lens)
    generator = np.random.default_rng(7)
    pixels = generator.uniform([200.0, 100.0], [1100.0, 600.0], (5000, 2))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    k = camera.intrinsic_matrix
    if lens.model == "fisheye":
        expected = cv2.fisheye.undistortPoints(pixels[:, None], k, lens.coefficients[:4], P=k, criteria=criteria)
    else:
        expected = cv2.undistortPoints(pixels[:, None], k, lens.coefficients, P=k, criteria=criteria)
    undistorted, _ = camera.undistort_pixels(pixels)
    np.testing.assert_allclose(undistorted, expected[:, 0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(camera.distort_pixels(undistorted)[0], pixels, rtol=0, atol=1e-9)


def test_projection_matrix_gives_undistorted_pixels(lens: Lens, make_camera: MakeCamera) -> None:
    camera = make_camera(lens)
    x = world_points(camera, 500, seed=8)
    homogeneous = np.column_stack([x, np.ones(len(x))]) @ camera.projection_matrix.T
    pinhole = homogeneous[:, :2] / homogeneous[:, 2:]
    np.testing.assert_allclose(camera.distort_pixels(pinhole)[0], camera.project(x), rtol=0, atol=1e-6)


def test_pixel_jacobians_agree_with_finite_differences(lens: Lens, make_camera: MakeCamera) -> None:
    camera = make_camera(lens)
    pixels = np.random.default_rng(9).uniform([250.0, 150.0], [1000.0, 550.0], (2000, 2))
    step = 1e-2
    for function in (camera.distort_pixels, camera.undistort_pixels):
        jacobian = function(pixels)[1]
        for axis in range(2):
            offset = step * np.eye(2)[axis]
            difference = (function(pixels + offset)[0] - function(pixels - offset)[0]) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, axis], difference, rtol=1e-6, atol=1e-6)


@settings(max_examples=100)
@given(
    u=st.floats(100.0, 1200.0),
    v=st.floats(50.0, 680.0),
    depth=st.floats(0.1, 1e4),
    k1=st.floats(-0.15, 0.4, allow_subnormal=False),
    vector=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
    center=st.tuples(*[st.floats(-50.0, 50.0)] * 3),
)
def test_project_inverts_unproject(
    u: float,
    v: float,
    depth: float,
    k1: float,
    vector: tuple[float, ...],
    center: tuple[float, ...],
) -> None:
    pose = Pose(rotation_from_vector(vector), center)
    camera = Camera("c", 1280, 720, 900.0, 880.0, 640.0, 360.0, pose, Lens("radial", k1=k1), Detector((1, 1), 0.9, 0))
    x = camera.unproject([[u, v]], [depth])
    np.testing.assert_allclose(camera.pose.to_camera(x)[0, 2], depth, rtol=1e-9, atol=1e-12)
    # Subtracting the centre again loses digits of a near point: 50 / 0.1 times 1e-16 times 900 px.
    np.testing.assert_allclose(camera.project(x), [[u, v]], rtol=0, atol=1e-9)
    assert camera.in_view(x).all()


def test_image_border_is_half_a_pixel_outside_the_outer_pixels(make_camera: MakeCamera) -> None:
    camera = make_camera(Lens())
    inside = np.array([[-0.499, -0.499], [1279.499, 719.499], [-0.499, 719.499], [640.0, 360.0]])
    outside = np.array([[-0.501, 10.0], [1279.501, 10.0], [10.0, -0.501], [10.0, 719.501]])
    assert camera.in_view(camera.unproject(inside, np.full(4, 7.0))).all()
    assert not camera.in_view(camera.unproject(outside, np.full(4, 7.0))).any()
    exact = np.array([[-0.5, -0.5], [1279.5, 719.5]])
    assert camera.contains(exact).all()
    assert not camera.contains(np.array([[np.nan, 5.0]])).any()


def test_points_behind_or_beside_the_camera_are_not_in_view(make_camera: MakeCamera) -> None:
    camera = make_camera(Lens("radial", k1=-0.1))
    x = camera.pose.to_world([[0.0, 0.0, -5.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    x[1] = camera.pose.center
    assert camera.in_view(x).tolist() == [False, False, False, True]
    assert np.isnan(camera.project(x)).all(axis=1).tolist() == [True, True, True, False]


def test_points_that_fold_back_into_the_image_are_not_in_view(make_camera: MakeCamera) -> None:
    camera = make_camera(Lens("radial", k1=-0.2))
    folded = np.array([[2.0, 0.0]])  # r_d = 2 (1 - 0.2 * 4) = 0.4, well inside the image
    pixel = camera.distort_pixels(folded * [camera.fx, camera.fy] + [camera.cx, camera.cy])[0]
    assert camera.contains(pixel).all()
    x = camera.pose.to_world(np.array([[20.0, 0.0, 10.0]]))
    assert not camera.in_view(x).any()
    assert np.isnan(camera.project(x)).all()
    undistorted = folded[0] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert not pixel_in_view(camera.packed(), *undistorted)


@njit
def _pixels_in_view(camera: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    result = np.empty(len(pixels), dtype=np.bool_)
    for i in range(len(pixels)):
        result[i] = pixel_in_view(camera, pixels[i, 0], pixels[i, 1])
    return result


def test_compiled_in_view_agrees_with_the_plain_one(lens: Lens, make_camera: MakeCamera) -> None:
    camera = make_camera(lens)
    generator = np.random.default_rng(10)
    depth = generator.uniform(1.0, 50.0, 4000)
    xy = generator.normal(size=(4000, 2))
    plain = camera.in_view(camera.pose.to_world(np.column_stack([xy * depth[:, None], depth])))
    pixels = xy * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert 500 < plain.sum() < 3500
    np.testing.assert_array_equal(_pixels_in_view(camera.packed(), pixels), plain)
    assert not _pixels_in_view(camera.packed(), np.full((1, 2), np.nan)).any()


def test_packed_layout(make_camera: MakeCamera) -> None:
    lens = Lens("brown_conrady", k1=-0.1, k2=0.02, p1=0.003, p2=0.004, k3=0.005, k4=0.006, k5=0.007, k6=0.008)
    camera = make_camera(lens)
    packed = camera.packed()
    assert packed.shape == (layout.PACKED_SIZE,) == (28,)
    assert packed[:6].tolist() == [903.5, 871.25, 655.5, 340.75, 1280, 720]
    assert np.array_equal(packed[6:9], camera.pose.center)
    assert np.array_equal(packed[9:18].reshape(3, 3), camera.pose.rotation)
    assert packed[18] == 2
    assert packed[19:27].tolist() == [-0.1, 0.02, 0.003, 0.004, 0.005, 0.006, 0.007, 0.008]
    assert packed[27] == lens.max_radius
    fisheye = make_camera(Lens("fisheye", k1=1.0, k2=2.0, k3=3.0, k4=4.0)).packed()
    assert fisheye[18:27].tolist() == [3, 1, 2, 3, 4, 0, 0, 0, 0]
    assert make_camera(Lens()).packed()[27] == np.inf


def test_moving_camera_sees_what_passes_by(make_camera: MakeCamera) -> None:
    pose = Pose(np.eye(3), [0.0, 0.0, 0.0], velocity=[2.0, 0.0, 0.0], rotation_rate=[0.0, 0.0, 0.1], time_s=1.0)
    camera = make_camera(Lens("radial", k1=-0.05), pose)
    moved = camera.at(4.0)
    assert moved.pose == pose.at(4.0)
    # Straight ahead of where the camera is by then: at the principal point.
    np.testing.assert_allclose(moved.project([[6.0, 0.0, 9.0]]), [[camera.cx, camera.cy]], atol=1e-9)
    assert moved.at(1.0).pose.center == pytest.approx(pose.center)
    still = make_camera(Lens())
    assert still.at(12.0) is still


def test_clock_round_trip() -> None:
    clock = Clock(offset_s=0.25, rate=1.0001)
    times = np.array([-3.0, 0.0, 1e4])
    np.testing.assert_allclose(clock.to_true(times), 0.25 + 1.0001 * times)
    np.testing.assert_allclose(clock.to_log(clock.to_true(times)), times, atol=1e-11)
    assert Clock().to_true(7.3) == 7.3
    assert Clock().to_log(7.3) == 7.3


def test_cameras_compare_by_value(make_camera: MakeCamera) -> None:
    assert make_camera(Lens("radial", k1=0.1)) == make_camera(Lens("radial", k1=0.1))
    assert make_camera(Lens("radial", k1=0.1)) != make_camera(Lens("radial", k1=0.2))
    assert Detector((1, 2), 0.9, 1) == Detector([1.0, 2.0], 0.9, 1.0)
    assert Detector((1, 2), 0.9, 1) != Detector((1, 3), 0.9, 1)


@pytest.mark.parametrize(
    "arguments",
    [((-1, 1), 0.9, 0), ((1,), 0.9, 0), ((1, 1), 1.1, 0), ((1, 1), 0.9, -1), ((1, np.nan), 0.9, 0)],
)
def test_bad_detector_is_refused(arguments: tuple[tuple[float, ...], float, float]) -> None:
    with pytest.raises(ValueError, match="detector"):
        Detector(*arguments)


def test_bad_camera_is_refused() -> None:
    pose, detector = Pose(np.eye(3), np.zeros(3)), Detector((1, 1), 0.9, 0)
    with pytest.raises(ValueError, match="positive fx"):
        Camera("c", 640, 480, -500.0, 500.0, 320.0, 240.0, pose, Lens(), detector)
    with pytest.raises(ValueError, match="positive width"):
        Camera("c", 0, 480, 500.0, 500.0, 320.0, 240.0, pose, Lens(), detector)


def test_importing_a_camera_does_not_import_the_compiler() -> None:
    code = "import stereophd.core.geometry.camera, sys; sys.exit('numba' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
