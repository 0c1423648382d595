"""Births from detections: moments against a large sample of depth and velocity in the world."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.stats import norm, qmc

from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.region import box_half_spaces, pack_region
from stereophd.core.multi.filter_settings.common import BirthPrior
from tests.core.disparity.cases import LENSES, birth_moments, make_camera, make_space

PIXELS = np.array([[10.0, 15.0], [400.0, 300.0], [790.0, 40.0]])


@cache
def drawn() -> tuple[np.ndarray, np.ndarray]:
    """Standard normal depths and velocities: Sobol points, scrambled."""
    normal = norm.ppf(qmc.Sobol(4, seed=1).random_base2(15))
    return normal[:, 0], normal[:, 1:]


def sampled(space: DisparitySpace, point: np.ndarray, prior: tuple[float, float], speed: float) -> np.ndarray:
    """States (n, 6): depth drawn from the prior on disparity, velocity from N(0, speed^2 I) in the world."""
    depths, velocities = drawn()
    states = np.column_stack([np.tile(point, (len(depths), 1)), prior[0] + prior[1] * depths])
    return space.from_world(np.column_stack([space.to_world(states), speed * velocities]))


@pytest.mark.parametrize("rectification", ["horizontal", "vertical"])
@pytest.mark.parametrize("lens", ["none", "fisheye"])
def test_moments_are_those_of_depth_and_velocity(rectification: str, lens: str) -> None:
    camera = make_camera((0.3, -0.4, 0.2), (5.0, -6.0, 7.0), LENSES[lens])
    space = make_space(camera, 1.3, rectification)
    event = make_event(camera, 0, 0.0, PIXELS)
    prior = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=2.0), velocity_std=1.5)
    means, covariances = birth_moments(event, space.packed(), prior, 6)
    for k in range(3):
        states = sampled(space, event.points[k], (7.0, 2.0), 1.5)
        expected = np.cov(states.T)
        expected[:2, :2] += event.covariances[k]
        np.testing.assert_allclose(means[k, :3], [*event.points[k], 7.0], rtol=1e-12)
        assert not means[k, 3:].any()
        std = np.sqrt(np.diag(expected))
        # 32,768 points of low discrepancy leave 0.00001 and 0.0004
        assert (np.abs(states.mean(axis=0) - means[k]) <= 1e-4 * std + 1e-9).all()
        assert (np.abs(covariances[k] - expected) <= 0.002 * np.outer(std, std) + 1e-12).all()
        np.linalg.cholesky(covariances[k])


def test_static_births_have_no_velocity() -> None:
    camera = make_camera(sigma=(1.5, 0.5))
    event = make_event(camera, 0, 0.0, PIXELS)
    means, covariances = birth_moments(
        event,
        make_space(camera).packed(),
        BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=2.0), velocity_std=1.0),
        3,
    )
    np.testing.assert_array_equal(means, np.column_stack([PIXELS, np.full(3, 7.0)]))
    np.testing.assert_allclose(covariances, np.tile(np.diag([2.25, 0.25, 4.0]), (3, 1, 1)))


@pytest.mark.parametrize("rectification", ["horizontal", "vertical"])
def test_depth_range_is_two_deviations_of_disparity(rectification: str) -> None:
    space = make_space(make_camera(), 0.5, rectification)
    mean, std = BirthPrior(depth_range=(20.0, 150.0), velocity_std=1.0).disparity_moments(space.packed())
    focal = 898.9 if rectification == "horizontal" else 880.0
    assert mean + 2.0 * std == pytest.approx(focal * 0.5 / 20.0, rel=1e-12)
    assert mean - 2.0 * std == pytest.approx(focal * 0.5 / 150.0, rel=1e-12)
    assert BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=3.0), velocity_std=1.0).disparity_moments(
        space.packed()
    ) == (7.0, 3.0)


def test_no_detections_no_births() -> None:
    camera = make_camera()
    event = make_event(camera, 0, 0.0, np.empty((0, 2)))
    means, covariances = birth_moments(
        event,
        make_space(camera).packed(),
        BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=3.0), velocity_std=1.0),
        6,
    )
    assert means.shape == (0, 6)
    assert covariances.shape == (0, 6, 6)


def test_a_region_is_a_prior_of_the_depths_along_a_ray() -> None:
    """A slab before the camera: the depths are those at which each ray is inside it, two deviations either side."""
    camera = make_camera()
    space = make_space(camera, 1.0)
    event = make_event(camera, 0, 0.0, PIXELS)
    prior = BirthPrior(depth_range=(1.0, 50.0), velocity_std=1.0)
    plain, _ = birth_moments(event, space.packed(), prior, 6)
    everywhere = (-np.inf, np.inf)
    slab = pack_region(everywhere, box_half_spaces({"z": (10.0, 10.4)}))
    forward = camera.pose.rotation.T @ np.array([0.0, 0.0, 1.0])
    directions = camera.rays(PIXELS) @ camera.pose.rotation
    depths = ((np.array([[10.0], [10.4]]) - camera.pose.center[2]) / directions[:, 2]).T
    assert forward[2] > 0.5
    means, covariances = birth_moments(event, space.packed(), prior, 6, slab)
    for k, (near, far) in enumerate(np.sort(depths, axis=1)):
        ends = space.disparity_focal * space.baseline / np.array([near, far])
        assert means[k, 2] == pytest.approx(ends.mean())
        assert np.sqrt(covariances[k, 2, 2]) == pytest.approx((ends[0] - ends[1]) / 4.0)
    # no region, one without limits, and one that no ray meets: the prior as it is
    for region in (np.array(everywhere), pack_region(everywhere, box_half_spaces({"z": (-9.0, -8.0)}))):
        same, _ = birth_moments(event, space.packed(), prior, 6, region)
        np.testing.assert_array_equal(same, plain)
