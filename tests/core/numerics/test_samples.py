"""Sample sets: exact moments where they are promised, shapes, and the same set for the same seed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from stereophd.core.numerics.samples import (
    RESERVE_SAMPLES,
    RESERVE_WIDTH,
    SETS_IN_TURN,
    _sets,
    cubature_points,
    draw_sample_sets,
)

QUASI = ("qmc", "unscented", "linear")


@pytest.mark.parametrize("method", QUASI)
@pytest.mark.parametrize(("samples", "rows"), [(64, 12), (256, 12), (64, 3), (1024, 3)])
def test_mirrored_sets_have_exact_moments(method: str, samples: int, rows: int) -> None:
    sets = draw_sample_sets(method, samples, rows, np.random.SeedSequence(1))
    assert sets.sets.shape == (SETS_IN_TURN, rows, samples)
    assert sets.size == samples
    for points in sets.sets:
        assert np.abs(points.sum(axis=1)).max() <= 1e-12
        np.testing.assert_allclose(points @ points.T / samples, np.eye(rows), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(points[:, : samples // 2], -points[:, samples // 2 :])


def test_quasi_random_points_are_normal() -> None:
    points = draw_sample_sets("qmc", 1024, 3, np.random.SeedSequence(2)).sets
    # quartiles and the fourth moment of a standard normal, over all sets (16384 points a row)
    for row in points.transpose(1, 0, 2).reshape(3, -1):
        assert abs(np.mean(np.abs(row) < 0.6744897501960817) - 0.5) < 0.005
        assert abs(np.mean(row**4) - 3.0) < 0.1


def test_particles_are_the_pseudo_random_draws_of_the_seed() -> None:
    sets = draw_sample_sets("particle", 500, 12, np.random.SeedSequence(3))
    children = np.random.SeedSequence(3).spawn(SETS_IN_TURN)
    for points, child in zip(sets.sets, children, strict=True):
        np.testing.assert_array_equal(points, np.random.default_rng(child).standard_normal((12, 500)))
    # independent draws do not have exact moments
    assert np.abs(sets.sets.mean(axis=2)).max() > 0.01


@pytest.mark.parametrize("method", ["qmc", "particle"])
def test_sets_depend_on_the_seed_only(method: str) -> None:
    drawn = []
    for seed in (4, 4, 5):
        _sets.cache_clear()  # drawn, not remembered
        drawn.append(draw_sample_sets(method, 64, 12, np.random.SeedSequence(seed)).sets)
    first, second, other = drawn
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("method", ["qmc", "particle"])
def test_sets_are_used_in_turn(method: str) -> None:
    sets = draw_sample_sets(method, 64, 12, np.random.SeedSequence(6))
    for k in range(SETS_IN_TURN):
        np.testing.assert_array_equal(sets.turn(k), sets.sets[k])
        np.testing.assert_array_equal(sets.turn(k + 3 * SETS_IN_TURN), sets.sets[k])
        assert not np.array_equal(sets.turn(k), sets.turn(k + 1))


def test_few_samples_are_rounded_up_so_that_they_can_be_whitened() -> None:
    sets = draw_sample_sets("qmc", 16, 12, np.random.SeedSequence(7))
    assert sets.size == 48
    np.testing.assert_allclose(sets.turn(0) @ sets.turn(0).T / 48, np.eye(12), rtol=0, atol=1e-12)


@pytest.mark.parametrize("rows", [3, 12])
def test_cubature_points(rows: int) -> None:
    points = cubature_points(rows)
    assert points.shape == (rows, 2 * rows)
    assert np.abs(points.sum(axis=1)).max() == 0.0
    np.testing.assert_allclose(points @ points.T / (2 * rows), np.eye(rows), rtol=0, atol=1e-14)
    assert np.count_nonzero(points) == 2 * rows


@pytest.mark.parametrize("method", ["qmc", "particle"])
def test_reserve_is_a_weighted_standard_normal(method: str) -> None:
    """Wider in the third coordinate, and weighted so that the moments are still those of a standard normal."""
    sets = draw_sample_sets(method, 64, 12, np.random.SeedSequence(8))
    points, weights = sets.reserve, sets.reserve_weights
    assert points.shape == (12, RESERVE_SAMPLES)
    assert (weights > 0.0).all()
    assert weights.mean() == pytest.approx(1.0, rel=1e-12)
    assert points[2].std() == pytest.approx(RESERVE_WIDTH, rel=0.1)
    # by the densities: a standard normal's over that of the wider one
    ratio = norm.pdf(points[2]) / norm.pdf(points[2], scale=RESERVE_WIDTH)
    np.testing.assert_allclose(weights, ratio / ratio.mean(), rtol=1e-10)
    # five standard errors of as many weighted samples
    margin = 5.0 * np.sqrt((weights**2).mean() / RESERVE_SAMPLES)
    assert np.abs(points @ weights / RESERVE_SAMPLES).max() < margin
    second = (points * weights) @ points.T / RESERVE_SAMPLES
    assert np.abs(second - np.eye(12)).max() < margin * np.sqrt(3.0)


@pytest.mark.parametrize(("samples", "expected"), [(64, RESERVE_SAMPLES), (4096, 4096)])
def test_reserve_is_never_smaller_than_a_set(samples: int, expected: int) -> None:
    sets = draw_sample_sets("particle", samples, 3, np.random.SeedSequence(9))
    assert sets.reserve.shape == (3, expected)
