"""Disparity space: eqs. (2) to (4) against camera matrices built by hand, round trips, smoothness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.disparity.space import DisparitySpace, _project
from stereophd.core.geometry.pose import Pose
from tests.core.disparity.cases import LENSES, make_camera, make_space

RECTIFICATIONS = ("horizontal", "vertical")

angles = st.tuples(*[st.floats(-1.5, 1.5)] * 3)
centers = st.tuples(*[st.floats(-100.0, 100.0)] * 3)
spaces = st.builds(
    lambda turn, center, baseline, rectification: make_space(make_camera(turn, center), baseline, rectification),
    angles,
    centers,
    st.floats(0.01, 100.0),
    st.sampled_from(RECTIFICATIONS),
)
# points in the axes of a camera: rays within 60 degrees of its axis, and depths over four decades
rays = st.tuples(*[st.floats(-1.7, 1.7)] * 2)
depths = st.floats(0.0, 4.0).map(lambda exponent: 10.0**exponent)
velocities = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


def world_point(space: DisparitySpace, ray: tuple[float, ...], depth: float) -> np.ndarray:
    return space.camera.pose.to_world([[ray[0] * depth, ray[1] * depth, depth]])


def map_between(source: DisparitySpace, destination: DisparitySpace, states: np.ndarray) -> np.ndarray:
    """The paper's map of states of a point at one time: smooth through d = 0, singular at depth 0 before the other."""
    return _project(destination.projective_matrix @ source.inverse_projective_matrix, states)


def companion(space: DisparitySpace) -> DisparitySpace:
    """The same camera, one baseline away against its own x or y axis (so that disparity is positive)."""
    pose = space.camera.pose
    axis = 0 if space.rectification == "horizontal" else 1
    center = pose.center - space.baseline * pose.rotation[axis]
    return replace(space, camera=replace(space.camera, pose=Pose(pose.rotation, center)))


@pytest.mark.parametrize("rectification", RECTIFICATIONS)
def test_projective_matrix_is_eq_3_of_the_two_camera_matrices(rectification: str) -> None:
    c, s = np.cos(0.3), np.sin(0.3)
    rotation = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    center, baseline = np.array([1.0, -2.0, 3.0]), 0.25
    camera = replace(make_camera(), pose=Pose(rotation, center))
    k = np.array([[898.9, 0.0, 400.0], [0.0, 880.0, 300.0], [0.0, 0.0, 1.0]])
    left = k @ np.column_stack([rotation, -rotation @ center])
    shift = np.array([baseline, 0.0, 0.0]) if rectification == "horizontal" else np.array([0.0, baseline, 0.0])
    right = k @ np.column_stack([rotation, -rotation @ center + shift])
    row = 0 if rectification == "horizontal" else 1
    expected = np.stack([left[0], left[1], right[row] - left[row], left[2]])
    space = make_space(camera, baseline, rectification)
    np.testing.assert_allclose(space.projective_matrix, expected, rtol=1e-13, atol=1e-10)
    # the paper's rectified pair: the other rows of the two cameras are the same
    others = [1 - row, 2]
    np.testing.assert_allclose(left[others], right[others], rtol=0, atol=1e-10)


@settings(max_examples=100)
@given(space=spaces)
def test_inverse_matrix(space: DisparitySpace) -> None:
    expected = np.linalg.inv(space.projective_matrix)
    atol = 1e-10 * np.abs(expected).max()
    np.testing.assert_allclose(space.inverse_projective_matrix, expected, rtol=1e-8, atol=atol)


@settings(max_examples=100)
@given(space=spaces, ray=rays, depth=depths)
def test_disparity_is_focal_length_times_baseline_over_depth(
    space: DisparitySpace, ray: tuple[float, ...], depth: float
) -> None:
    state = space.from_world(world_point(space, ray, depth))[0]
    focal = 898.9 if space.rectification == "horizontal" else 880.0
    # rounding of the world coordinates, relative to the depth
    rtol = 1e-12 * (1.0 + 200.0 / depth)
    np.testing.assert_allclose(state[2], focal * space.baseline / depth, rtol=rtol)
    np.testing.assert_allclose(state[:2], [898.9 * ray[0] + 400.0, 880.0 * ray[1] + 300.0], rtol=0, atol=2000.0 * rtol)


@settings(max_examples=100)
@given(space=spaces, ray=rays, depth=depths)
def test_observation_is_linear_in_both_cameras(space: DisparitySpace, ray: tuple[float, ...], depth: float) -> None:
    point = world_point(space, ray, depth)
    state = space.from_world(point)[0]
    other = companion(space)
    row = 0 if space.rectification == "horizontal" else 1
    seen = space.camera.projection_matrix[row] + space.projective_matrix[2]
    np.testing.assert_allclose(other.camera.projection_matrix[row], seen, rtol=0, atol=1e-8)
    atol = 1e-8 * (1.0 + np.abs(state).max())
    left = right = np.eye(2, 3)  # H_l and H_r of eq. (4)
    right = right + np.outer([1, 0] if space.rectification == "horizontal" else [0, 1], [0, 0, 1])
    np.testing.assert_allclose(left @ state, space.camera.project(point)[0], rtol=0, atol=atol)
    np.testing.assert_allclose(right @ state, other.camera.project(point)[0], rtol=0, atol=atol)


@settings(max_examples=100)
@given(space=spaces, ray=rays, depth=depths, velocity=velocities)
def test_world_to_disparity_and_back(
    space: DisparitySpace, ray: tuple[float, ...], depth: float, velocity: tuple[float, ...]
) -> None:
    point = world_point(space, ray, depth)
    world = np.column_stack([point, [velocity]])
    there = space.from_world(world)
    np.testing.assert_allclose(space.to_world(there[:, :3]), point, rtol=0, atol=1e-11 * (200.0 + 3 * depth))
    back = space.to_world(there)
    np.testing.assert_allclose(back[:, :3], point, rtol=0, atol=1e-11 * (200.0 + 3 * depth))
    # a velocity of 10 is lost by the error of the position, relative to the depth
    np.testing.assert_allclose(back[:, 3:], [velocity], rtol=0, atol=1e-10 * (200.0 + 3 * depth))


disparity_states = st.tuples(
    st.floats(-1000.0, 2000.0),
    st.floats(-1000.0, 2000.0),
    st.one_of(st.floats(0.01, 1000.0), st.floats(-1000.0, -0.01)),
    *[st.floats(-100.0, 100.0)] * 3,
)


@settings(max_examples=100)
@given(space=spaces, state=disparity_states, size=st.sampled_from([3, 6]))
def test_disparity_to_world_and_back(space: DisparitySpace, state: tuple[float, ...], size: int) -> None:
    states = np.array([state[:size]])
    world = space.to_world(states)
    assert np.isfinite(world).all()
    # errors grow with the depth over the distance to the origin: 175 at most, in units of the depth
    depth = abs(space.disparity_focal * space.baseline / state[2])
    relative = 1e-12 * (1.0 + 1000.0 / depth)
    error = np.abs(space.from_world(world) - states)
    scale = 1e4 * (1.0 + np.abs(states).max()) * (1.0 + abs(state[5] / state[2]))
    assert error.max() <= relative * scale


@settings(max_examples=100)
@given(space=spaces, ray=rays, depth=depths, velocity=velocities)
def test_velocity_is_the_rate_of_the_moving_point(
    space: DisparitySpace, ray: tuple[float, ...], depth: float, velocity: tuple[float, ...]
) -> None:
    point = world_point(space, ray, depth)
    rate = space.from_world(np.column_stack([point, [velocity]]))[0, 3:]
    step = 1e-4 * depth / 20.0
    moved = [space.from_world(point + sign * step * np.array([velocity]))[0] for sign in (1.0, -1.0)]
    difference = (moved[0] - moved[1]) / (2.0 * step)
    # central difference: truncation of (step * speed / depth)^2, rounding over the step
    size = np.abs(space.from_world(point)).max() + 2000.0
    atol = size * (20.0 / depth) * (1e-8 + 1e-10 * (1.0 + 200.0 / depth))
    np.testing.assert_allclose(rate, difference, rtol=0, atol=atol)


@settings(max_examples=100)
@given(source=spaces, destination=spaces, state=disparity_states, size=st.sampled_from([3, 6]))
def test_map_between_cameras_is_the_way_through_the_world(
    source: DisparitySpace, destination: DisparitySpace, state: tuple[float, ...], size: int
) -> None:
    states = np.array([state[:size]])
    world = source.to_world(states)
    depth = destination.camera.pose.to_camera(world[:, :3])[0, 2]
    distance = np.linalg.norm(world[0, :3] - destination.camera.pose.center)
    if abs(depth) < 1e-3 * (distance + 400.0):
        return  # near the singular plane: tested on its own
    through_world = destination.from_world(world)
    mapped = map_between(source, destination, states)
    scale = np.maximum(np.abs(through_world), 1.0).max() * (1.0 + 1000.0 * abs(state[2]) / source.baseline)
    np.testing.assert_allclose(mapped, through_world, rtol=0, atol=1e-9 * scale)


def test_map_is_smooth_through_infinity() -> None:
    source = make_space(make_camera((0.1, -0.3, 0.05), (-20.0, 1.0, 2.0)))
    destination = make_space(make_camera((0.0, 0.25, 0.0), (25.0, -3.0, 1.0)), 2.0, "vertical")
    pixels = np.array([[100.0, 50.0], [400.0, 300.0], [700.0, 550.0]])
    h = 1e-3
    for u, v in pixels:
        line = np.array([[u, v, d, 3.0, -2.0, 0.4] for d in (-2 * h, -h, 0.0, h, 2 * h)])
        for states in (line[:, :3], line):
            mapped = map_between(source, destination, states)
            assert np.isfinite(mapped).all()
            first = np.diff(mapped, axis=0) / h
            second = np.diff(first, axis=0) / h
            # a kink of the slope at d = 0 would show as a second difference that grows with 1 / h
            bound = 1e-3 * (1.0 + np.abs(first).max(axis=0)) / h
            assert (np.abs(second) < bound).all()
            np.testing.assert_allclose(second[0], second[2], rtol=0.02, atol=1e-2)
        # a point at infinity in one camera is at infinity in the other, whatever their places
        at_infinity = map_between(source, destination, line[2:3, :3])[0]
        assert abs(at_infinity[2]) < 1e-12
        direction = source.camera.pose.rotation.T @ [(u - 400.0) / 898.9, (v - 300.0) / 880.0, 1.0]
        ray = destination.camera.pose.rotation @ direction
        expected = [898.9 * ray[0] / ray[2] + 400.0, 880.0 * ray[1] / ray[2] + 300.0]
        np.testing.assert_allclose(at_infinity[:2], expected, rtol=1e-12)


def test_map_is_singular_only_at_new_depth_zero() -> None:
    source = make_space(make_camera(), 1.0)
    destination = make_space(make_camera(center=(0.0, 0.0, 8.0)), 1.0)
    singular = 898.9 / 8.0  # disparity of a point at depth 8, level with the destination
    disparity = np.append(np.linspace(-300.0, 300.0, 2401), [0.0, singular * (1 - 1e-9), singular * (1 + 1e-9)])
    states = np.column_stack([np.full_like(disparity, 450.0), np.full_like(disparity, 310.0), disparity])
    mapped = map_between(source, destination, states)
    assert np.isfinite(mapped).all()
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 898.9 / disparity - 8.0
        expected = 898.9 / depth
    regular = disparity != 0.0
    np.testing.assert_allclose(mapped[regular, 2], expected[regular], rtol=1e-6)
    level = map_between(source, destination, np.array([[450.0, 310.0, singular]]))
    assert not np.isfinite(level[0, 2]) or abs(level[0, 2]) > 1e12


def test_a_point_at_infinity_has_no_place_in_the_world() -> None:
    world = make_space(make_camera((0.1, 0.2, 0.3))).to_world(np.array([[450.0, 310.0, 0.0]]))
    assert not np.isfinite(world).any()


@pytest.mark.parametrize("lens", list(LENSES))
def test_packed_space_is_the_packed_camera_and_two_numbers(lens: str) -> None:
    camera = make_camera((0.1, 0.2, 0.3), (1.0, 2.0, 3.0), LENSES[lens])
    for rectification in RECTIFICATIONS:
        packed = make_space(camera, 0.5, rectification).packed()
        np.testing.assert_array_equal(packed[:28], camera.packed())
        assert packed[28:].tolist() == [0.5, float(rectification == "vertical")]
