"""Eight-point and five-point methods against essential matrices that are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.discovery.essential import (
    constraint_rows,
    eight_point,
    essential_of,
    five_point,
    poses_of,
)
from stereophd.core.geometry.pose import rotation_from_vector

ROTATION = rotation_from_vector([0.1, 0.5, -0.2])
DIRECTION = np.array([-1.0, 0.2, 0.3]) / np.linalg.norm([-1.0, 0.2, 0.3])


def slopes(points: Array) -> tuple[Array, Array]:
    """Slopes (n, 2) of points before both cameras."""
    other = points @ ROTATION.T + DIRECTION
    return points[:, :2] / points[:, 2:], other[:, :2] / other[:, 2:]


def distance(essential: Array) -> float:
    """Largest difference of the entries from the true ones, for either sign."""
    true = essential_of(ROTATION, DIRECTION) / np.sqrt(2.0)
    scaled = essential / np.linalg.norm(essential)
    return float(min(np.abs(scaled - true).max(), np.abs(scaled + true).max()))


@pytest.mark.parametrize("seed", range(5))
def test_five_points_are_enough(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (5, 3)) + [0.0, 0.0, 4.0]
    rows = constraint_rows(*slopes(points))
    space = np.linalg.svd(rows)[2][5:]
    found, of_space = five_point(np.stack([space, space]))
    assert (np.bincount(of_space) >= 1).all()
    for number in (0, 1):
        assert min(distance(one) for one in found[of_space == number]) < 1e-6
    values = np.linalg.svd(found)[1]
    np.testing.assert_allclose(values[:, 0], values[:, 1], rtol=1e-5)
    np.testing.assert_allclose(values[:, 2], 0.0, atol=1e-5)


def test_eight_point_of_noisy_rows_among_missing_ones() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (200, 3)) + [0.0, 0.0, 4.0]
    first, second = slopes(points)
    second += 5e-4 * rng.standard_normal(second.shape)
    valid = np.ones((1, 200))
    valid[0, :40], second[:40] = 0.0, rng.uniform(-0.3, 0.3, (40, 2))
    found = eight_point(constraint_rows(first, second)[None], valid, (0.08, 0.005))[0]
    assert distance(found) < 0.01


def test_one_of_the_four_poses_is_the_true_one() -> None:
    poses = poses_of(essential_of(ROTATION, DIRECTION))
    assert all(np.linalg.det(rotation) == pytest.approx(1.0) for rotation, _ in poses)
    errors = [max(np.abs(r - ROTATION).max(), np.abs(t - DIRECTION).max()) for r, t in poses]
    assert min(errors) < 1e-9
    assert sum(error < 1e-9 for error in errors) == 1
