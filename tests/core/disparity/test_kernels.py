"""Every compiled kernel of disparity space against a few lines of NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.disparity import sample_move, trips
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import IN_VIEW, Sources
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.numerics.linear_algebra import cholesky, condition
from stereophd.core.numerics.moments import weighted_moments
from stereophd.core.numerics.samples import draw_sample_sets
from tests.core.disparity.cases import (
    LENSES,
    limit_speed,
    make_camera,
    make_space,
    oracle_trip,
    random_covariance,
    sampled_noise,
    state_in,
    weighted,
)

ACCELERATION = np.array([0.5, 0.2, 1.1])
WORLD = np.array([3.0, -4.0, 120.0, 1.5, -0.5, 2.0])


def pair(kind: str, lens: str = "none") -> tuple[DisparitySpace, DisparitySpace]:
    """Source and destination, of which one, both or none is rectified vertically."""
    source = make_camera((0.02, -0.26, 0.1), (-20.0, 2.0, 1.0), LENSES[lens])
    destination = make_camera((-0.05, 0.2, 0.3), (22.0, -1.0, -4.0), LENSES[lens], focal=(700.0, 650.0))
    vertical = {"horizontal": (0, 0), "vertical": (1, 1), "mixed": (1, 0)}[kind]
    names = ("horizontal", "vertical")
    return make_space(source, 1.5, names[vertical[0]]), make_space(destination, 0.7, names[vertical[1]])


@pytest.mark.parametrize("kind", ["horizontal", "vertical", "mixed"])
@pytest.mark.parametrize("dt", [0.0, 0.04, 3.0, -1.7])
@pytest.mark.parametrize("max_speed", [np.inf, 2.4])
def test_moving_trips(kind: str, dt: float, max_speed: float) -> None:
    source, destination = pair(kind)
    rng = np.random.default_rng(1)
    mean = state_in(source, WORLD)
    covariance = random_covariance(rng, [4.0, 3.0, 0.3, 8.0, 6.0, 0.2])
    samples = rng.standard_normal((12, 300))
    motion = ConstantVelocity(ACCELERATION, None if max_speed == np.inf else max_speed)
    expected, _ = oracle_trip(mean, covariance, samples, source, destination, dt, motion)
    speeds = np.linalg.norm(source.to_world(mean + samples[:6].T @ np.linalg.cholesky(covariance).T)[:, 3:], axis=1)
    assert 20 < (speeds > 2.4).sum() < 280  # the limit matters, and not everywhere

    noise = destination.camera.pose.rotation @ sampled_noise(samples, motion, dt).T.reshape(2, 3, -1)
    out = np.full((7, 300), np.nan)
    flow = motion.flow(np.array([dt]))
    trips.moving_trips(
        mean, np.linalg.cholesky(covariance), samples, noise.reshape(6, -1), 1.0, 1.0, source.packed(),
        destination.packed(), flow.reach[0], flow.keep[0], flow.drift[0], max_speed, out,
    )  # fmt: skip
    np.testing.assert_allclose(out[:6].T, expected, rtol=1e-9, atol=1e-9)
    # the last row is the depth before the destination, times the inverse depth before the source
    depth = destination.disparity_focal * destination.baseline / expected[:, 2]
    disparity = mean[2] + samples[:3].T @ np.linalg.cholesky(covariance)[2, :3]
    inverse_depth = disparity / (source.disparity_focal * source.baseline)
    np.testing.assert_allclose(out[6], depth * inverse_depth, rtol=1e-9)


def test_speed_limit_holds_for_every_sample() -> None:
    source, destination = pair("horizontal")
    rng = np.random.default_rng(2)
    samples = rng.standard_normal((12, 500))
    mean = state_in(source, WORLD)
    # disparities from near to beyond infinity, and velocities that mean anything there
    factor = np.diag([5.0, 5.0, 3.0 * mean[2], 10.0, 10.0, 5.0])
    out = np.empty((7, 500))
    trips.moving_trips(
        mean, factor, samples, np.zeros((6, 500)), 0.0, 1.0, source.packed(), destination.packed(), 0.5, 1.0,
        np.zeros(6), 4.0, out,
    )  # fmt: skip
    assert np.isfinite(out).all()
    speed = np.linalg.norm(destination.to_world(out[:6].T)[:, 3:], axis=1)
    assert speed.max() <= 4.0 * (1 + 1e-6)


def test_trips_are_continuous_through_infinity() -> None:
    """Samples just before and beyond infinity arrive at the same place, with motion and noise."""
    source, destination = pair("horizontal")
    samples = np.zeros((12, 5))
    samples[2] = [-2.0, -1.0, 0.0, 1.0, 2.0]
    mean = np.array([380.0, 290.0, 0.0, 0.5, -0.5, 0.0])
    out = np.empty((7, 5))
    factor = np.diag([1.0, 1.0, 1e-6, 1.0, 1.0, 1.0])
    trips.moving_trips(
        mean, factor, samples, np.ones((6, 5)), 1.0, 1.0, source.packed(), destination.packed(), 0.5, 1.0,
        np.zeros(6), 5.0, out,
    )  # fmt: skip
    assert np.isfinite(out).all()
    # velocities are capped at max_speed * rho: within 1e-6 px of disparity everything moves by micropixels
    assert np.abs(np.diff(out[:3], axis=1)).max() < 1e-4
    static = np.empty((4, 5))
    trips.static_trips(mean[:3], factor[:3, :3], samples, source.packed(), destination.packed(), static)
    np.testing.assert_allclose(static[:3, 2], out[:3, 2], rtol=1e-12, atol=1e-12)
    # on a straight line: the map is smooth
    assert np.abs(np.diff(static[:3], n=2, axis=1)).max() < 1e-9


@pytest.mark.parametrize("kind", ["horizontal", "vertical", "mixed"])
def test_static_trips(kind: str) -> None:
    source, destination = pair(kind)
    rng = np.random.default_rng(3)
    mean = state_in(source, WORLD[:3])
    covariance = random_covariance(rng, [4.0, 3.0, 0.5])
    samples = rng.standard_normal((3, 300))
    states = mean + samples.T @ np.linalg.cholesky(covariance).T
    out = np.empty((4, 300))
    trips.static_trips(mean, np.linalg.cholesky(covariance), samples, source.packed(), destination.packed(), out)
    np.testing.assert_allclose(out[:3].T, destination.from_world(source.to_world(states)), rtol=1e-9, atol=1e-9)
    depth = destination.camera.pose.to_camera(source.to_world(states))[:, 2]
    scale = source.disparity_focal * source.baseline
    np.testing.assert_allclose(out[3], depth * states[:, 2] / scale, rtol=1e-9)


@pytest.mark.parametrize("lens", list(LENSES))
@pytest.mark.parametrize("size", [3, 6])
def test_view_mask(lens: str, size: int) -> None:
    space = make_space(make_camera((0.2, -0.3, 0.1), (1.0, 2.0, 3.0), LENSES[lens]))
    camera = space.camera
    rng = np.random.default_rng(4)
    # pixels inside, around and far outside the image, before and behind the camera
    spread = rng.choice([1.0, 1.3, 6.0], (4000, 1))
    pixels = [400.0, 300.0] + rng.uniform(-1.0, 1.0, (4000, 2)) * [400.0, 300.0] * spread
    depth = rng.choice([-50.0, 0.5, 50.0, 5000.0], 4000)
    rays = np.column_stack([(pixels - [400.0, 300.0]) / [898.9, 880.0], np.ones(4000)])
    world = camera.pose.to_world(rays * depth[:, None])
    seen = camera.in_view(world)
    assert 200 < seen.sum() < 3000
    points = np.zeros((size + 1, 4000))
    points[:2] = space.from_world(world)[:, :2].T
    points[size] = depth
    mask = np.full(4000, np.nan)
    count = trips.view_mask(points, space.packed(), mask)
    np.testing.assert_array_equal(mask, seen.astype(float))
    assert count == seen.sum()


def test_view_mask_at_the_edges_of_the_image() -> None:
    space = make_space(make_camera())
    inside = [(-0.5, 0.0), (799.5, 0.0), (5.0, -0.5), (5.0, 599.5), (-0.5, -0.5), (799.5, 599.5)]
    e = 1e-9
    outside = [(-0.5 - e, 0.0), (799.5 + e, 0.0), (5.0, -0.5 - e), (5.0, 599.5 + e), (np.nan, 5.0), (5.0, np.inf)]
    points = np.zeros((4, len(inside) + len(outside) + 3))
    points[:2, : len(inside) + len(outside)] = np.array(inside + outside).T
    points[3] = 1.0
    points[:2, -3:] = 300.0
    points[3, -3:] = [0.0, -1.0, np.nan]
    mask = np.empty(points.shape[1])
    assert trips.view_mask(points, space.packed(), mask) == len(inside)
    assert mask.tolist() == [1.0] * len(inside) + [0.0] * (len(outside) + 3)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("count", [1, 24, 257])
def test_weighted_moments(size: int, count: int) -> None:
    rng = np.random.default_rng(count)
    points = rng.standard_normal((size + 1, count)) * 10.0 + 500.0
    weights = rng.uniform(0.1, 1.0, count)
    lost = rng.permutation(count)[: count // 3]
    weights[lost] = 0.0
    kept = weights > 0.0
    mean, covariance = weighted(points[:size, kept].T, weights[kept])
    points[:, lost] = np.resize([np.nan, np.inf, -np.inf], len(lost))
    found_mean, found_covariance = np.empty(size), np.empty((size, size))
    weighted_moments(points, weights, weights.sum(), found_mean, found_covariance)
    np.testing.assert_allclose(found_mean, mean, rtol=1e-13)
    np.testing.assert_allclose(found_covariance, covariance, rtol=1e-10, atol=1e-10)
    assert np.array_equal(found_covariance, found_covariance.T)


@pytest.mark.parametrize("p_detect", [0.4, 0.95, 1.0])
@pytest.mark.parametrize("own_weights", [False, True])
def test_missed_moments(p_detect: float, own_weights: bool) -> None:
    rng = np.random.default_rng(6)
    mean, covariance = rng.standard_normal(6) * 100.0, random_covariance(rng, [5.0, 4.0, 1.0, 2.0, 2.0, 0.1])
    factor = np.linalg.cholesky(covariance)
    samples = rng.standard_normal((12, 400))
    mask = (samples[0] + 0.3 * samples[4] > 0.4).astype(float)
    sample_weights = rng.uniform(0.2, 3.0, 400) if own_weights else np.ones(400)
    expected = weighted(mean + samples[:6].T @ factor.T, sample_weights * (1.0 - p_detect * mask))
    found_mean, found_covariance = np.empty(6), np.empty((6, 6))
    sample_move.missed_moments(mean, factor, samples, sample_weights, mask, p_detect, 50, found_mean, found_covariance)
    np.testing.assert_allclose(found_mean, expected[0], rtol=1e-12)
    np.testing.assert_allclose(found_covariance, expected[1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("seen", "kept"), [(0, False), (376, False), (377, True), (400, True)])
def test_missed_moments_of_too_few_samples_keep_the_whole(seen: int, kept: bool) -> None:
    """With p_detect 1 the 400 - seen samples outside count: from 24 on they are fitted."""
    rng = np.random.default_rng(7)
    mean, covariance = rng.standard_normal(6), random_covariance(rng, np.ones(6))
    samples = rng.standard_normal((12, 400))
    mask = (np.arange(400) < seen).astype(float)
    found_mean, found_covariance = np.empty(6), np.empty((6, 6))
    factor = np.linalg.cholesky(covariance)
    sample_move.missed_moments(mean, factor, samples, np.ones(400), mask, 1.0, 24, found_mean, found_covariance)
    whole = bool(np.allclose(found_mean, mean, rtol=0, atol=1e-12))
    assert whole == kept
    if kept:
        np.testing.assert_allclose(found_covariance, covariance, rtol=1e-12, atol=1e-14)


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32), size=st.integers(1, 6), exponent=st.floats(-8.0, 8.0))
def test_cholesky(seed: int, size: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    matrix = random_covariance(rng, 10.0**exponent * 10.0 ** rng.uniform(-3.0, 3.0, size))
    factor = np.full((size, size), np.nan)
    assert cholesky(matrix, factor)
    expected = np.linalg.cholesky(matrix)
    error = np.abs(factor - expected) / np.sqrt(np.diag(matrix))[:, None]
    # the factor's error grows with the condition of the correlation matrix
    correlation = matrix / np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    assert error.max() <= 1e-14 * np.linalg.cond(correlation)
    before = matrix.copy()
    assert condition(matrix, factor)
    np.testing.assert_array_equal(matrix, before)  # what has full rank is left alone


@pytest.mark.parametrize(
    "matrix",
    [np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 0.0, 1.0]), np.diag([1.0, -1.0, 1.0]), np.full((3, 3), np.nan)],
)
def test_cholesky_refuses_what_has_no_full_rank(matrix: np.ndarray) -> None:
    assert not cholesky(matrix, np.empty((3, 3)))


@settings(max_examples=100, derandomize=True)
@given(seed=st.integers(0, 2**32), rank=st.integers(1, 5))
def test_condition_gives_full_rank(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((6, rank)) * 10.0 ** rng.uniform(-4.0, 4.0, (6, 1))
    matrix = root @ root.T
    before = matrix.copy()
    assert condition(matrix, np.empty((6, 6)))
    np.linalg.cholesky(matrix)
    off = ~np.eye(6, dtype=bool)
    np.testing.assert_array_equal(matrix[off], before[off])
    raised = np.diag(matrix) / np.diag(before)
    assert (raised > 1.0).all()
    assert (raised <= 1.0012).all()


def test_condition_of_nearly_dependent_coordinates() -> None:
    """Singular covariances of which two coordinates are nearly the same: none may pass for full rank.

    After a pivot of 1e-6 the rounding of a later one is 1e-10, of either sign: it says nothing of the rank.
    """
    for seed in range(2000):
        rng = np.random.default_rng(seed)
        rank = rng.integers(2, 6)
        root = rng.standard_normal((6, rank))
        root[rng.integers(1, 6)] = root[0] + 10.0 ** rng.uniform(-6.0, -1.0) * rng.standard_normal(rank)
        root *= 10.0 ** rng.uniform(-4.0, 4.0, (6, 1))
        matrix = root @ root.T
        assert condition(matrix, np.empty((6, 6)))
        np.linalg.cholesky(matrix)


@pytest.mark.parametrize(
    "matrix",
    [np.full((2, 2), np.nan), np.diag([1.0, 0.0]), np.diag([1.0, np.inf]), np.array([[1.0, 2.0], [2.0, 1.0]])],
)
def test_condition_says_what_it_cannot_help(matrix: np.ndarray) -> None:
    assert not condition(matrix, np.empty((2, 2)))


def test_relative_pose_and_disparity_scale() -> None:
    source, destination = pair("mixed")
    pose = np.array(trips.relative_pose(source.packed(), destination.packed()))
    rotation, translation = pose[:9].reshape(3, 3), pose[9:]
    points = np.random.default_rng(8).standard_normal((10, 3)) * 50.0
    expected = destination.camera.pose.to_camera(source.camera.pose.to_world(points))
    np.testing.assert_allclose(points @ rotation.T + translation, expected, rtol=1e-12, atol=1e-12)
    assert trips.disparity_scale(source.packed()) == 880.0 * 1.5
    assert trips.disparity_scale(destination.packed()) == 700.0 * 0.7


@pytest.mark.parametrize("kind", ["horizontal", "vertical", "mixed"])
@pytest.mark.parametrize("dt", [0.0, 0.5, -1.2])
@pytest.mark.parametrize("max_speed", [np.inf, 1.0])
def test_linear_move_is_the_jacobian_of_the_trip(kind: str, dt: float, max_speed: float) -> None:
    source, destination = pair(kind)
    motion = ConstantVelocity(ACCELERATION, None if max_speed == np.inf else max_speed)
    mean = state_in(source, WORLD)
    covariance = random_covariance(np.random.default_rng(9), [4.0, 3.0, 0.3, 2.0, 2.0, 0.05])

    def trip(states: np.ndarray) -> np.ndarray:
        world = limit_speed(source.to_world(states), max_speed)
        return destination.from_world(world @ motion.transition(dt)[0].T)

    steps = 1e-5 * np.sqrt(np.diag(covariance))
    jacobian = (trip(mean + np.diag(steps)) - trip(mean - np.diag(steps))).T / (2.0 * steps)
    moved = limit_speed(source.to_world(mean[None]), max_speed) @ motion.transition(dt)[0].T
    h = 1e-4 * np.eye(6)
    landing = (destination.from_world(moved + h) - destination.from_world(moved - h)).T / 2e-4
    expected = jacobian @ covariance @ jacobian.T + landing @ motion.transition(dt)[1] @ landing.T

    sources = Sources(mean[None], covariance[None], source.packed()[None], motion.arrays(np.array([dt])))
    sets = draw_sample_sets("linear", 64, motion.sample_rows, np.random.SeedSequence(0))
    found = move(sources, destination.packed(), sets, 0)
    assert found.status[0] == IN_VIEW
    off = found.means - destination.from_world(moved)
    np.testing.assert_allclose(off / np.sqrt(np.diag(expected)), np.zeros((1, 6)), rtol=0, atol=1e-7)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariances[0] / scale, expected / scale, rtol=0, atol=1e-6)


def test_limit_speed_oracle() -> None:
    world = np.array([[0.0, 0, 0, 3.0, 0.0, 4.0], [0.0, 0, 0, 0.3, 0.0, 0.4], [1.0, 1, 1, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(limit_speed(world, 1.0)[:, 3:], [[0.6, 0, 0.8], [0.3, 0, 0.4], [0, 0, 0]])
