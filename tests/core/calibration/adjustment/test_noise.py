"""The noise of detections and what they share: cells, components of variance, and what a fit absorbs of them."""

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.noise import (
    PRIOR_REDUNDANCY,
    NoiseEstimate,
    cells_of,
    estimate_noise,
    variance_components,
    weights_of,
)
from stereophd.core.calibration.adjustment.problem import Observations, Problem
from stereophd.core.calibration.adjustment.solver import Adjustment, adjust
from stereophd.core.calibration.annealing.fits import FITTED_LOSS
from stereophd.core.geometry.lens import Lens
from tests.core.calibration.adjustment.test_solver import solve
from tests.core.calibration.adjustment.test_suspicions import posed
from tests.core.calibration.scenes import SIGMA, MadeUp, make_problem


def test_cells_are_runs_within_a_radius_of_their_first_detection() -> None:
    points = np.array([[0.0, 0.0], [3.0, 4.0], [9.0, 0.0], [10.0, 0.0], [0.0, 0.0], [50.0, 50.0]])
    count = len(points)
    observations = Observations(
        np.array([0, 0, 0, 0, 0, 1]), np.zeros(count, dtype=np.int64), np.arange(count, dtype=np.float64), points,
        np.zeros((count, 2, 2)), np.zeros(count), np.zeros(count),
    )  # fmt: skip
    cells = cells_of(observations, 5.5)
    assert (np.diff(cells) != 0).tolist() == [False, True, False, True, True]
    assert len(np.unique(cells)) == 4
    # the order of the rows does not matter
    order = np.array([5, 3, 1, 4, 2, 0])
    shuffled = replace(
        observations, trajectories=observations.trajectories[order], times=observations.times[order],
        points=points[order],
    )  # fmt: skip
    assert (cells_of(shuffled, 5.5) == cells[order]).all()


def test_components_of_variance_are_those_of_the_errors() -> None:
    rng = np.random.default_rng(1)
    cells = np.repeat(np.arange(400), rng.integers(1, 40, 400))
    residuals = 0.4 * rng.standard_normal((len(cells), 2)) + 0.8 * rng.standard_normal((400, 2))[cells]
    own, shared = variance_components(residuals, cells)
    np.testing.assert_allclose(np.sqrt([own, shared]), [0.4, 0.8], rtol=0.06)


def with_shared_errors(size: float) -> tuple[Problem, Adjustment]:
    """A fit to detections whose errors are shared in cells of 40 pixels, beside errors of their own."""
    made = make_problem(3, objects=12)
    observations = made.observations
    cells = cells_of(observations, 40.0)
    errors = size * np.random.default_rng(2).standard_normal((int(cells.max()) + 1, 2))[cells]
    made = MadeUp(**{**vars(made), "observations": replace(observations, points=observations.points + errors)})
    return solve(made)


def estimated(
    problem: Problem, adjustment: Adjustment, radius: float = 40.0, noise: float = 1.0, shared: Array | None = None
) -> NoiseEstimate:
    count = len(problem.parameters.cameras)
    shared = np.zeros(count) if shared is None else shared
    return estimate_noise(problem, adjustment, np.full(count, noise), shared, radius, np.random.default_rng(0))


def differs(found: NoiseEstimate, shared: Array, from_above: bool = False) -> list[bool]:
    out: list[bool] = found.differs(shared, np.full(len(shared), from_above)).tolist()
    return out


def test_errors_of_their_own_keep_their_weight_and_shared_ones_lose_it() -> None:
    for size in (0.0, 3.0):
        problem, adjustment = with_shared_errors(size)
        found = estimated(problem, adjustment)
        assert ((found.shared > 0.0) == (size > 0.0)).all()
        assert differs(found, np.zeros(2)) == [size > 0.0] * 2
        weights = weights_of(problem.observations, found.shared, 40.0)
        if size > 0.0:
            stds = SIGMA * found.factors * np.sqrt(found.shared)
            assert (stds > 1.5).all()
            assert (stds < 5.0).all()
            assert weights.mean() < 0.5
        else:
            np.testing.assert_array_equal(weights, 1.0)
    assert (estimated(problem, adjustment, 0.0).shared == 0.0).all()


def test_false_detections_show_no_error_that_is_shared() -> None:
    problem, adjustment = with_shared_errors(0.6)
    problem = replace(problem, loss=FITTED_LOSS)
    adjustment = adjust(problem, adjustment.values, adjustment.states)
    right = estimated(problem, adjustment)
    observations = problem.observations
    false = np.arange(len(observations)) % 20 == 7
    points = observations.points + 300.0 * false[:, None]
    cells = cells_of(observations, 40.0)
    with_false = replace(problem, observations=replace(observations, points=points))
    found = estimated(with_false, adjust(with_false, adjustment.values, adjustment.states))
    assert len(np.unique(cells[~false])) == len(np.unique(cells))
    np.testing.assert_allclose(found.factors, right.factors, rtol=0.15)


@pytest.mark.parametrize("size", [0.8, 3.0])
def test_what_is_shared_stays_when_it_is_counted(size: float) -> None:
    problem, adjustment = with_shared_errors(size)
    first = estimated(problem, adjustment)
    assert (first.shared > 0.2).all()
    # counted, and the trajectories following all detections again with the cameras of that answer
    observations = problem.observations
    precisions = observations.precisions / first.factors[observations.cameras, None, None] ** 2
    problem = replace(problem, observations=replace(observations, precisions=precisions))
    counted = problem.weighted(weights_of(observations, first.shared, 40.0))
    answer = adjust(counted, adjustment.values, adjustment.states)
    still = replace(problem, held=np.ones(len(answer.values), dtype=np.bool_))
    followed = adjust(still, answer.values, answer.states)
    assert not any(differs(estimated(problem, followed, shared=first.shared), first.shared))


def test_a_detection_of_weight_two_counts_as_two() -> None:
    made = make_problem(3, objects=3)
    problem, found = solve(made)
    rows = np.concatenate([np.arange(len(made.observations))] * 2)
    fields = {name: value[rows] for name, value in vars(made.observations).items() if value is not None}
    twice = Observations(**fields)
    weighted = replace(made.observations, weights=np.full(len(made.observations), 2.0))
    one = adjust(replace(problem, observations=twice), found.values, found.states)
    other = adjust(replace(problem, observations=weighted), found.values, found.states)
    np.testing.assert_allclose(one.values, other.values, atol=1e-9)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6)


@pytest.mark.parametrize("factor", [0.2, 1.0, 4.0])
def test_the_noise_of_a_camera_is_found_whatever_is_stated(factor: float) -> None:
    problem, begin = posed(Lens(), Lens())
    adjustment = begin
    stated = np.array([1.0, 1.0 / factor, 1.0])  # what is stated over the true noise
    for number in range(4):  # tracks follow the cameras whose noise is stated too small until it is known
        observations = problem.observations
        precisions = observations.precisions / stated[observations.cameras, None, None] ** 2
        noisy = replace(problem, observations=replace(observations, precisions=precisions))
        adjustment = adjust(noisy, np.zeros(problem.parameters.size), adjustment.states)
        found = estimated(noisy, adjustment, 0.0)
        if number == 0:
            assert differs(found, np.zeros(3)) == [False, factor != 1.0, False]
        stated = stated * found.factors
    # 160 to 320 coordinates of each camera tell, to 6 % at most: three standard deviations
    np.testing.assert_allclose(stated, 1.0, rtol=0.17)


def test_less_noise_is_not_believed_where_trajectories_follow_the_detections() -> None:
    redundancy, nothing = np.array([700.0, 100.0, 100.0]), np.zeros(3)
    estimate = NoiseEstimate(np.array([0.5, 0.5, 2.0]), nothing, redundancy, np.full(3, 1000.0), np.ones(3))
    assert differs(estimate, nothing) == [True, False, True]
    assert estimate.hides.tolist() == [False, True, True]
    # a noise from which the right one is looked for is what nobody has stated
    assert differs(estimate, nothing, from_above=True) == [True, True, True]


def test_few_coordinates_bring_a_noise_down_that_is_looked_for_from_above() -> None:
    redundancy, nothing = np.array([6.0, 6.0, 6.0]), np.zeros(3)
    estimate = NoiseEstimate(np.array([0.6, 0.9, 1.5]), nothing, redundancy, np.full(3, 15.0), np.ones(3))
    assert differs(estimate, nothing) == [False, False, False]
    assert differs(estimate, nothing, from_above=True) == [True, False, True]


def test_the_prior_of_a_noise_is_what_is_stated_or_less() -> None:
    problem, begin = posed(Lens(), Lens())
    low, stated, high = (estimated(problem, begin, 0.0, noise) for noise in (0.5, 1.0, 4.0))
    np.testing.assert_array_equal(low.factors, stated.factors)
    weight = PRIOR_REDUNDANCY / (PRIOR_REDUNDANCY + low.redundancy)
    np.testing.assert_allclose(stated.factors**2 - high.factors**2, weight * (1.0 - 1.0 / 16.0), rtol=1e-6)
