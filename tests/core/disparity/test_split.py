"""Split of a Gaussian by the field of view (paper VI-C, Fig. 8)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.disparity import moments
from stereophd.core.disparity.moved import OUT_OF_VIEW, PARTLY_IN_VIEW
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from tests.core.disparity.cases import (
    converging,
    in_deviations,
    make_camera,
    make_space,
    random_covariance,
    state_in,
    weighted,
)
from tests.core.disparity.moves import (
    METHODS,
    REFERENCE_SAMPLES,
    Case,
    figure_7,
    monte_carlo_margins,
    nearly_linear,
    reference_samples,
    sample_sets,
)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("p_detect", [0.5, 0.95])
@pytest.mark.parametrize("method", METHODS)
def test_the_two_parts_make_up_the_whole(method: str, p_detect: float, size: int) -> None:
    """Mass, mean and second moment are kept: exactly, where nothing but the split happens."""
    space = make_space(make_camera())
    motion = ConstantVelocity([0.0] * 3) if size == 6 else Static()
    mean = np.array([796.0, 300.0, 7.0, 3.0, 1.0, 0.1])[:size]
    covariance = random_covariance(np.random.default_rng(6), [8.0, 5.0, 1.0, 2.0, 2.0, 0.2][:size])
    sets = sample_sets(method, 1024, motion)
    moved = Case(mean, covariance, space, space, 0.0, motion).move(sets, 0, p_detect)
    assert moved.status[0] == PARTLY_IN_VIEW
    detected = p_detect * moved.fraction[0]
    missed = 1.0 - detected
    total = detected * moved.means[0] + missed * moved.missed_means[0]
    spread = [
        weight * (part + np.outer(center - total, center - total))
        for weight, center, part in (
            (detected, moved.means[0], moved.covariances[0]),
            (missed, moved.missed_means[0], moved.missed_covariances[0]),
        )
    ]
    samples = sets.turn(0)[:size]
    factor = np.linalg.cholesky(covariance)
    np.testing.assert_allclose(total, mean + factor @ samples.mean(axis=1), rtol=1e-10)
    expected = factor @ np.cov(samples, bias=True) @ factor.T
    assert in_deviations(sum(spread) - expected, covariance).max() < 1e-9
    # beyond the edge lies what was missed
    assert moved.means[0, 0] < mean[0] < moved.missed_means[0, 0]


@cache
def large_sample(make: Callable[..., Case], *arguments: float) -> tuple[Array, Array, Array]:
    """States, where they are in the destination, and whether they are seen there: one sample for all methods."""
    case = make(*arguments)
    samples = reference_samples()
    states = case.mean + samples[: len(case.mean)].T @ np.linalg.cholesky(case.covariance).T
    return states, *case.trip(samples)


@cache
def part_in_view(make: Callable[..., Case], *arguments: float) -> tuple[float, Array, Array, Array]:
    """Share of the large sample that is seen, its points there, and their mean and covariance."""
    _, points, seen = large_sample(make, *arguments)
    inside = points[seen]
    return float(seen.mean()), inside, *weighted(inside, np.ones(len(inside)))


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("method", METHODS)
def test_split_by_the_field_of_view(method: str, size: int) -> None:
    """Fraction, part in view and missed part (Fig. 8) against a large sample, within Monte Carlo margins."""
    case, count, p_detect = figure_7(size), 1024, 0.95
    states, _, seen = large_sample(figure_7, size)
    share, inside, expected_mean, expected = part_in_view(figure_7, size)
    moved = case.move(sample_sets(method, count, case.motion), 0, p_detect)
    assert moved.status[0] == PARTLY_IN_VIEW
    assert abs(moved.fraction[0] - share) < 5.0 * np.sqrt(share * (1 - share) / count)
    margin, variance_margin = monte_carlo_margins(inside, share * count)
    assert in_deviations(moved.means[0] - expected_mean, expected).max() < margin
    assert (np.abs(np.diag(moved.covariances[0]) / np.diag(expected) - 1.0) < variance_margin).all()
    weights = 1.0 - p_detect * seen
    expected_mean, expected = weighted(states, weights)
    effective = weights.sum() ** 2 / (weights**2).sum() * count / REFERENCE_SAMPLES
    # a Gaussian's variance has a kurtosis of 3; the missed part is a cut Gaussian, with less
    assert in_deviations(moved.missed_means[0] - expected_mean, expected).max() < 5.0 / np.sqrt(effective)
    relative = np.abs(np.diag(moved.missed_covariances[0]) / np.diag(expected) - 1.0)
    assert relative.max() < 5.0 * np.sqrt(2.0 / effective)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [3, 6])
def test_behind_the_camera_is_out_of_view(method: str, size: int) -> None:
    home = make_space(make_camera())
    behind = make_space(make_camera(center=(0.0, 0.0, 200.0)))
    facing_away = make_space(make_camera((0.0, np.pi, 0.0)))
    motion: Motion = ConstantVelocity([0.1] * 3) if size == 6 else Static()
    mean = state_in(home, [1.0, 1.0, 100.0, 0.0, 0.0, 0.0][:size])
    covariance = np.diag([1.0, 1.0, 0.1, 1.0, 1.0, 0.1])[:size, :size] ** 2
    for destination in (behind, facing_away):
        moved = Case(mean, covariance, home, destination, 0.1, motion).move(sample_sets(method, 64, motion))
        assert moved.status.tolist() == [OUT_OF_VIEW]
        assert moved.fraction.tolist() == [0.0]


def test_status_by_the_number_of_samples_in_view() -> None:
    """Below 24 of 64 samples, or an eighth of many, a component counts as out of view."""
    assert [moments.minimum_in_view(n) for n in (16, 48, 64, 192, 200, 1024)] == [8, 24, 24, 24, 25, 128]
    space, motion = make_space(make_camera()), Static()
    sets = sample_sets("qmc", 64, motion)
    normal = np.sort(sets.turn(0)[0])
    for needed, status in ((24, PARTLY_IN_VIEW), (23, OUT_OF_VIEW)):
        # the left edge of the image, at -0.5, cuts off all but the rightmost samples
        edge = 0.5 * (normal[64 - needed] + normal[63 - needed])
        case = Case(np.array([-0.5 - edge, 300.0, 5.0]), np.eye(3), space, space, 0.0, motion)
        moved = case.move(sets)
        assert moved.status[0] == status
        assert moved.fraction[0] == (needed / 64 if status == PARTLY_IN_VIEW else 0.0)


def tail_in_view(size: int, place: float) -> Case:
    """A newborn of the left camera, of whose wide depths the right camera sees one end only."""
    home, destination = converging(20.0, 0.26)
    mean = np.array([place, 300.0, 7.0, 0.0, 0.0, 0.0])[:size]
    covariance = np.diag([1.4, 1.4, 3.0, 9.0, 9.0, 1.0])[:size, :size] ** 2
    motion: Motion = ConstantVelocity([0.01] * 3, max_speed=6.0) if size == 6 else Static()
    return Case(mean, covariance, home, destination, 0.5, motion)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", [650.0, 700.0, 750.0])
def test_a_tail_in_view_is_found_where_it_matters(method: str, size: int, place: float) -> None:
    """Too few of 64 samples in view: out of view, unless important; then close to a large sample."""
    case, p_detect = tail_in_view(size, place), 0.95
    sets = sample_sets(method, 64, case.motion)
    assert case.move(sets, 0, p_detect).status[0] == OUT_OF_VIEW
    moved = case.move(sets, 0, p_detect, important=True)
    assert moved.status[0] == PARTLY_IN_VIEW
    share, inside, mean, covariance = part_in_view(tail_in_view, size, place)
    assert 0.01 < share < 0.375
    # the reserve's own size, its weights, and the samples that count: all in the effective number in view
    reserve, seen_there = case.trip(sets.reserve)
    weights = sets.reserve_weights * seen_there
    effective = weights.sum() ** 2 / (weights**2).sum()
    assert abs(moved.fraction[0] - share) < 5.0 * share / np.sqrt(effective)
    margin, variance_margin = monte_carlo_margins(inside, effective)
    assert in_deviations(moved.means[0] - mean, covariance).max() < margin
    assert (np.abs(np.diag(moved.covariances[0]) / np.diag(covariance) - 1.0) < variance_margin).all()
    # exactly, against NumPy on the same weighted samples
    expected_mean, expected = weighted(reserve, weights)
    assert moved.fraction[0] == pytest.approx(weights.sum() / sets.reserve_weights.sum(), rel=1e-12)
    np.testing.assert_allclose(moved.means[0], expected_mean, rtol=1e-8)
    assert in_deviations(moved.covariances[0] - expected, expected).max() < 1e-8
    states = case.mean + sets.reserve[:size].T @ np.linalg.cholesky(case.covariance).T
    missed_mean, missed = weighted(states, sets.reserve_weights * (1.0 - p_detect * seen_there))
    np.testing.assert_allclose(moved.missed_means[0], missed_mean, rtol=1e-8, atol=1e-8)
    assert in_deviations(moved.missed_covariances[0] - missed, missed).max() < 1e-8


@pytest.mark.parametrize("size", [3, 6])
def test_importance_changes_nothing_that_is_well_in_view(size: int) -> None:
    for case in (nearly_linear(size), figure_7(size)):
        sets = sample_sets("qmc", 64, case.motion)
        one, other = case.move(sets, 0, 0.9), case.move(sets, 0, 0.9, important=True)
        assert one.status[0] != OUT_OF_VIEW
        for name in ("means", "covariances", "fraction", "status", "missed_means", "missed_covariances"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
