"""Cramer-Rao bounds: Jacobians by finite differences, closed forms, a Kalman filter, published numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stereophd.core.bounds import cramer_rao as bounds
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.projection import projective
from stereophd.core.motion.constant_velocity import ConstantVelocity
from tests.core.single import scenes

POINT = np.array([3.0, -5.0, 120.0])
STATE = np.array([3.0, -5.0, 120.0, 1.0, -2.0, 4.0])


def differences(function, at: np.ndarray, step: float = 1e-4) -> np.ndarray:  # type: ignore[no-untyped-def]
    columns = [(function(at + step * e) - function(at - step * e)) / (2.0 * step) for e in np.eye(len(at))]
    return np.stack(columns, axis=1)


def to_disparity(covariance: np.ndarray, space: DisparitySpace) -> np.ndarray:
    jacobian = bounds.disparity_jacobian(space, POINT)
    return np.asarray(jacobian @ covariance @ jacobian.T)


def test_jacobians_agree_with_differences() -> None:
    camera = scenes.camera("right", 30.0, 0.3)
    space = DisparitySpace(camera, 2.0)
    expected = differences(lambda x: camera.project(x[None])[0], POINT)
    slope = projective(camera.projection_matrix, POINT[None])[1][0]
    np.testing.assert_allclose(slope, expected, rtol=1e-6, atol=1e-8)
    disparity = space.from_world(POINT[None])[0]
    expected = np.linalg.inv(differences(lambda y: space.to_world(y[None])[0], disparity))
    np.testing.assert_allclose(bounds.disparity_jacobian(space, POINT), expected, rtol=1e-6, atol=1e-6)
    expected = differences(lambda x: space.from_world(x[None])[0], STATE)
    np.testing.assert_allclose(bounds.state_jacobian(space, STATE), expected, rtol=1e-5, atol=1e-7)


def test_rectified_pair_in_closed_form() -> None:
    """In disparity space two rectified cameras give H_l^T R^-1 H_l + H_r^T R^-1 H_r, whatever the point."""
    baseline = 30.0
    left, right = scenes.camera("left", 0.0, 0.0), scenes.camera("right", -baseline, 0.0)
    space = DisparitySpace(left, baseline)
    # H_l and H_r of eq. (4)
    matrices = [np.eye(2, 3), np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])]
    in_disparity = np.linalg.inv(sum(h.T @ h for h in matrices) / 2.0)
    information = [bounds.detection_information(camera, POINT[None])[0] for camera in (left, right)]
    in_world = bounds.localisation_bounds(information)[-1]
    np.testing.assert_allclose(to_disparity(in_world, space), in_disparity, rtol=1e-9, atol=1e-9)


def test_prior_counts_along_the_ray_only() -> None:
    left = scenes.camera("left", 0.0, 0.0)
    space = DisparitySpace(left)
    one = [bounds.detection_information(left, POINT[None])[0]]
    assert np.isinf(bounds.localisation_bounds(one)).all()
    prior = bounds.prior_information(space, POINT, 0.5)
    covariance = to_disparity(bounds.localisation_bounds(one, prior)[0], space)
    np.testing.assert_allclose(covariance, np.diag([2.0, 2.0, 0.25]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("depth", "rms", "norm"), [(50, 0.232, 0.200), (100, 0.799, 0.660), (150, 1.723, 1.399)])
def test_table_two(depth: float, rms: float, norm: float) -> None:
    """Values of an independent computation, of which the mean norm is by sampling (to 0.3 %)."""
    scenario = scenes.table_two(depth, 6.0, 4.0)
    information = [bounds.detection_information(c, scenario.start[None, :3])[0] for c in scenario.rig.cameras]
    bound = bounds.localisation_bounds(information)[-1]
    assert math.sqrt(np.trace(bound)) == pytest.approx(rms, abs=0.002)
    assert bounds.mean_error_norm(bound) == pytest.approx(norm, rel=0.003)


def test_mean_error_norm() -> None:
    assert bounds.mean_error_norm(4.0 * np.eye(3)) == pytest.approx(2.0 * math.sqrt(8.0 / math.pi), rel=1e-9)
    assert bounds.mean_error_norm(np.diag([9.0, 0.0])) == pytest.approx(3.0 * math.sqrt(2.0 / math.pi), rel=1e-9)
    assert bounds.mean_error_norm(np.full((3, 3), np.inf)) == math.inf
    assert bounds.mean_error_norm(np.zeros((3, 3))) == 0.0
    covariance = np.array([[4.0, 1.0], [1.0, 0.5]])
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(2), covariance, 200_000)
    norms = np.linalg.norm(draws, axis=1)
    assert abs(norms.mean() - bounds.mean_error_norm(covariance)) < 5.0 * norms.std() / math.sqrt(len(norms))


def test_posterior_bound_is_the_covariance_of_a_kalman_filter() -> None:
    """In the linear case, with a singular Q (events at one time) and detections of position only."""
    motion = ConstantVelocity([0.3, 0.2, 0.1])
    steps = [motion.transition(dt) for dt in (0.0, 0.5, 0.0, 1.0)]
    matrix = np.eye(2, 6)
    gained = matrix.T @ matrix / 2.0
    covariance = np.diag([4.0, 4.0, 9.0, 1.0, 1.0, 1.0])
    found = bounds.posterior_bounds(
        np.linalg.inv(covariance), np.array([step.matrix for step in steps]), np.array([step.noise for step in steps]),
        np.tile(gained, (4, 1, 1)),
    )  # fmt: skip
    for (transition, noise, _), bound in zip(steps, found[1:], strict=True):
        covariance = transition @ covariance @ transition.T + noise
        gain = covariance @ matrix.T @ np.linalg.inv(matrix @ covariance @ matrix.T + 2.0 * np.eye(2))
        covariance = covariance - gain @ matrix @ covariance
        np.testing.assert_allclose(bound, covariance, rtol=1e-9, atol=1e-12)


def test_posterior_bound_without_a_prior() -> None:
    """Infinite until position and velocity are determined; then that of least squares, without process noise."""
    motion = ConstantVelocity([0.0, 0.0, 0.0])
    transition, noise, _ = motion.transition(2.0)
    gained = np.zeros((6, 6))
    gained[:3, :3] = np.eye(3)
    found = bounds.posterior_bounds(gained, transition[None], noise[None], gained[None])
    assert np.isinf(found[0]).all()
    # two positions of unit variance 2 s apart
    np.testing.assert_allclose(found[1][:3, :3], np.eye(3), atol=1e-9)
    np.testing.assert_allclose(found[1][3:, 3:], np.eye(3) / 2.0, atol=1e-9)


def test_several_trajectories_at_once() -> None:
    transition, noise, _ = ConstantVelocity([0.1] * 3).transition(1.0)
    first = np.stack([np.eye(6), 2.0 * np.eye(6)])
    gained = np.stack([np.eye(6), 0.5 * np.eye(6)])[None]
    together = bounds.posterior_bounds(first, transition[None], noise[None], gained)
    for k in range(2):
        alone = bounds.posterior_bounds(first[k], transition[None], noise[None], gained[:, k])
        np.testing.assert_allclose(together[:, k], alone, rtol=1e-12)


def test_the_bound_of_the_average_information_is_the_lower_one() -> None:
    """A bound is a convex function of the information: its mean over trajectories is the sharper one."""
    random = np.random.default_rng(3)
    transition, noise, _ = ConstantVelocity([0.1] * 3).transition(1.0)
    factors = random.normal(size=(5, 40, 6, 6))
    factors[1:, :, 1:] = 0.0  # a detection tells one direction, which differs between trajectories
    information = np.swapaxes(factors, -1, -2) @ factors
    steps = np.tile(transition, (4, 1, 1)), np.tile(noise, (4, 1, 1))
    each = bounds.posterior_bounds(information[0], *steps, information[1:]).mean(axis=1)
    average = information.mean(axis=1)
    lower = bounds.posterior_bounds(average[0], *steps, average[1:])
    for mean, bound in zip(each, lower, strict=True):
        assert np.linalg.eigvalsh(mean - bound).min() > 0.0
