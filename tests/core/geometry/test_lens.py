"""Lenses against OpenCV, finite differences, and the definition of each model in NumPy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stereophd.core.geometry.lens import Lens


def coefficient(size: float) -> st.SearchStrategy[float]:
    """Coefficients up to a size, without the subnormal numbers in which no lens is measured."""
    return st.floats(-size, size, allow_subnormal=False)


lenses = st.one_of(
    st.builds(Lens, st.just("radial"), k1=coefficient(0.5)),
    st.builds(
        Lens,
        st.just("brown_conrady"),
        k1=coefficient(0.4),
        k2=coefficient(0.2),
        p1=coefficient(0.003),
        p2=coefficient(0.003),
        k3=coefficient(0.1),
        k4=coefficient(0.3),
        k5=coefficient(0.1),
        k6=coefficient(0.05),
    ),
    st.builds(
        Lens,
        st.just("fisheye"),
        k1=coefficient(0.1),
        k2=coefficient(0.05),
        k3=coefficient(0.02),
        k4=coefficient(0.01),
    ),
)


def points_within(radius: float, n: int, seed: int) -> np.ndarray:
    """Points uniform in a disc."""
    generator = np.random.default_rng(seed)
    angle = generator.uniform(0, 2 * np.pi, n)
    return (radius * np.sqrt(generator.uniform(size=n)) * [np.cos(angle), np.sin(angle)]).T


def radial_map(lens: Lens, r: np.ndarray) -> np.ndarray:
    """Distorted radius of an undistorted one, straight from the definition of the models."""
    if lens.model == "fisheye":
        theta = np.arctan(r)
        return theta * (1 + lens.k1 * theta**2 + lens.k2 * theta**4 + lens.k3 * theta**6 + lens.k4 * theta**8)
    numerator = 1 + lens.k1 * r**2 + lens.k2 * r**4 + lens.k3 * r**6
    return r * numerator / (1 + lens.k4 * r**2 + lens.k5 * r**4 + lens.k6 * r**6)


def opencv_distort(lens: Lens, xy: np.ndarray) -> np.ndarray:
    if lens.model == "fisheye":
        return cv2.fisheye.distortPoints(xy[:, None], np.eye(3), lens.coefficients[:4])[:, 0]
    xyz = np.column_stack([xy, np.ones(len(xy))])
    return cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), np.eye(3), lens.coefficients)[0][:, 0]


def test_distort_agrees_with_opencv(lens: Lens) -> None:
    xy = points_within(min(lens.max_radius, 2.0), 5000, seed=1)
    # A focal length of 1000 px turns 1e-9 into 1e-6 px.
    np.testing.assert_allclose(lens.distort(xy)[0], opencv_distort(lens, xy), rtol=0, atol=1e-12)


def test_undistort_agrees_with_opencv(lens: Lens) -> None:
    xy = points_within(min(0.75 * lens.max_radius, 0.8), 5000, seed=2)
    xy_d = opencv_distort(lens, xy)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-14)
    if lens.model == "fisheye":
        expected = cv2.fisheye.undistortPoints(xy_d[:, None], np.eye(3), lens.coefficients[:4], criteria=criteria)
    else:
        expected = cv2.undistortPoints(xy_d[:, None], np.eye(3), lens.coefficients, criteria=criteria)
    result = lens.undistort(xy_d)[0]
    np.testing.assert_allclose(result, expected[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result, xy, rtol=0, atol=1e-12)


def test_jacobians_agree_with_finite_differences(lens: Lens) -> None:
    xy = points_within(min(0.9 * lens.max_radius, 1.5), 2000, seed=3)
    step = 1e-5
    for function, points in ((lens.distort, xy), (lens.undistort, lens.distort(0.95 * xy)[0])):
        jacobian = function(points)[1]
        for axis in range(2):
            offset = step * np.eye(2)[axis]
            difference = (function(points + offset)[0] - function(points - offset)[0]) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, axis], difference, rtol=1e-6, atol=1e-6)


def test_jacobian_near_the_axis_of_a_fisheye_lens() -> None:
    # Either side of where the series takes over from the arc tangent.
    lens = Lens("fisheye", k1=0.05, k2=-0.01)
    radius = 1e-4
    inside, outside = (np.array([[0.6, 0.8]]) * radius * factor for factor in (1 - 1e-9, 1 + 1e-9))
    for low, high in zip(lens.distort(inside), lens.distort(outside), strict=True):
        np.testing.assert_allclose(low, high, rtol=1e-8, atol=1e-15)
    scale = (1 + (0.05 - 1 / 3) * radius**2) * np.array([0.6, 0.8]) * radius
    np.testing.assert_allclose(lens.distort(outside)[0][0], scale, rtol=2e-9)


@settings(max_examples=100)
@given(lens=lenses, seed=st.integers(0, 2**32 - 1))
def test_undistort_inverts_distort(lens: Lens, seed: int) -> None:
    xy = points_within(0.8 * min(lens.max_radius, 2.0), 20, seed)
    xy_d, jacobian = lens.distort(xy)
    # Tangential distortion folds where the radial map alone is nearly flat: not what is promised here.
    sane = np.linalg.det(jacobian) > 0.05
    result, inverse_jacobian = lens.undistort(xy_d[sane])
    np.testing.assert_allclose(result, xy[sane], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        inverse_jacobian @ jacobian[sane], np.broadcast_to(np.eye(2), (sane.sum(), 2, 2)), atol=1e-9
    )


@settings(max_examples=100)
@given(lens=lenses, seed=st.integers(0, 2**32 - 1))
def test_what_undistort_returns_distorts_back(lens: Lens, seed: int) -> None:
    # Any distorted point: NaN, or a point within max_radius that the lens does map there.
    xy_d = points_within(3.0, 20, seed)
    xy, jacobian = lens.undistort(xy_d)
    found = np.isfinite(xy).all(axis=1)
    assert np.array_equal(np.isnan(xy).any(axis=1), ~found)
    assert np.isnan(jacobian[~found]).all()
    assert (np.hypot(*xy[found].T) <= lens.max_radius).all()
    # A large fisheye angle is badly conditioned forwards only: the residual is what is promised.
    np.testing.assert_allclose(lens.distort(xy[found])[0], xy_d[found], rtol=0, atol=1e-11)


@settings(max_examples=100)
@given(lens=lenses)
def test_radial_map_increases_up_to_max_radius_and_no_further(lens: Lens) -> None:
    limit = lens.max_radius
    r = np.linspace(0.0, min(limit, 50.0), 4001)
    assert (np.diff(radial_map(lens, r)) > -1e-12).all()
    if limit < 1e4:  # the definition is off by rounding further out
        r_d = radial_map(lens, limit * np.array([1 - 1e-3, 1.0, 1 + 1e-3]))
        # A pole that the numerator cancels counts as a limit too, and there is nothing to see beyond it.
        s = limit**2
        assume(lens.model == "fisheye" or 1 + s * (lens.k1 + s * (lens.k2 + s * lens.k3)) > 1e-3)
        # Just beyond, the map turns back, stands still (to third order), or has gone through a pole.
        assert r_d[1] >= r_d[0]
        assert r_d[2] <= r_d[1] * (1 + 1e-5)


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (Lens(), np.inf),
        (Lens("radial", k1=0.3), np.inf),
        (Lens("radial", k1=-0.2), 1 / np.sqrt(0.6)),  # 1 + 3 k1 r^2 = 0
        (Lens("brown_conrady", k4=-0.25), 2.0),  # pole of 1 / (1 - r^2 / 4), increasing before
        (Lens("brown_conrady", k4=0.25), 2.0),  # r / (1 + r^2 / 4) turns back at 2
        (Lens("brown_conrady", k1=0.4, k4=0.1), np.inf),
        (Lens("fisheye"), np.inf),
        (Lens("fisheye", k1=-1 / 3), np.tan(1.0)),  # 1 + 3 k1 theta^2 = 0
        (Lens("fisheye", k1=-0.1), np.inf),  # turns back beyond 90 degrees only
    ],
)
def test_max_radius_in_closed_form(lens: Lens, expected: float) -> None:
    assert lens.max_radius == pytest.approx(expected, rel=1e-8)


def test_undistort_is_nan_where_nothing_maps() -> None:
    lens = Lens("radial", k1=-0.2)
    largest = lens.distort([[lens.max_radius, 0.0]])[0][0, 0]
    xy, jacobian = lens.undistort([[1.001 * largest, 0.0], [0.999 * largest, 0.0], [np.nan, 0.0], [np.inf, 0.0]])
    assert np.isnan(xy).any(axis=1).tolist() == [True, False, True, True]
    assert np.isnan(jacobian).any(axis=(1, 2)).tolist() == [True, False, True, True]
    # The fisheye model maps the whole half space in front of it into a disc.
    half_space = Lens("fisheye").undistort([[1.57, 0.0], [1.58, 0.0]])[0]
    assert half_space[0, 0] == pytest.approx(np.tan(1.57))
    assert np.isnan(half_space[1]).all()


def test_centre_and_no_points(lens: Lens) -> None:
    for function in (lens.distort, lens.undistort):
        points, jacobian = function(np.zeros((1, 2)))
        assert np.array_equal(points, np.zeros((1, 2)))
        np.testing.assert_allclose(jacobian, np.eye(2)[None], atol=1e-15)
        points, jacobian = function(np.zeros((0, 2)))
        assert points.shape == (0, 2)
        assert jacobian.shape == (0, 2, 2)


def test_input_is_not_changed_and_may_be_read_only(lens: Lens) -> None:
    xy = points_within(0.3, 10, seed=4)
    xy.setflags(write=False)
    result, _ = lens.distort(xy[::2])
    assert not np.shares_memory(result, xy)
    np.testing.assert_array_equal(result, lens.distort(xy[::2].copy())[0])


@pytest.mark.parametrize(
    "arguments",
    [{"model": "pinhole"}, {"model": "radial", "k1": np.nan}, {"model": "radial", "p1": 0.1}, {"k1": 0.1}],
)
def test_bad_lens_is_refused(arguments: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="lens"):
        Lens(**arguments)  # type: ignore[arg-type]


def test_points_of_a_wrong_shape_are_refused(lens: Lens) -> None:
    with pytest.raises(ValueError, match=r"shape \(n, 2\)"):
        lens.distort(np.zeros((4, 3)))
