"""Distances that are known at all times, beside dense linear algebra and numerical derivatives."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.linearisation import NormalEquations
from stereophd.core.calibration.adjustment.trajectories import fit_states, interpolation, place_knots
from stereophd.core.calibration.annealing.known_lengths import (
    _Answer,
    _distances,
    _odds_of_lengths,
    _sampled,
    _step,
    with_free_scale,
)
from stereophd.core.motion.constant_velocity import ConstantVelocity

STD = 0.3


def equations(seed: int, size: int, values: int) -> tuple[NormalEquations, np.ndarray, np.ndarray]:
    """Normal equations of random residuals, their whole matrix and right side, knots first."""
    rng = np.random.default_rng(seed)
    whole = np.zeros((size + values, size + values))
    for first in range(0, size - 11, 6):  # residuals of two knots in succession and of all values
        rows = np.zeros((30, size + values))
        rows[:, first : first + 12] = rng.standard_normal((30, 12))
        rows[:, size:] = rng.standard_normal((30, values))
        whole += rows.T @ rows
    right = rng.standard_normal(size + values)
    bands = np.zeros((12, size))
    for k in range(12):
        bands[k, : size - k] = np.diagonal(whole[:size, :size], -k)
    found = NormalEquations(
        0.0, bands, whole[:size, size:], whole[size:, size:], right[:size], right[size:], np.empty(0)
    )
    return found, whole, right


def test_a_step_is_that_of_the_dense_equations_of_the_answer_with_the_distances_added() -> None:
    """The values keep what the answer says of them, which is not what the normal equations say."""
    size, values, count = 24, 3, 5
    rng = np.random.default_rng(1)
    found, whole, right = equations(0, size, values)
    slopes, missing = rng.standard_normal((count, size)), rng.standard_normal(count)
    back, root = rng.standard_normal(values), rng.standard_normal((values, values))
    covariance = root @ root.T
    noise = STD**2 * (np.eye(count) + 1.0)
    across = np.column_stack([slopes, np.zeros((count, values))])
    knots, coupling, precision = whole[:size, :size], whole[:size, size:], np.linalg.inv(covariance)
    followed = np.linalg.solve(knots, np.column_stack([coupling, right[:size]]))
    dense = whole.copy()
    dense[size:, size:] = precision + coupling.T @ followed[:, :-1]
    right = np.append(right[:size], precision @ back + coupling.T @ followed[:, -1])
    dense = dense + across.T @ np.linalg.solve(noise, across)
    expected = np.linalg.solve(dense, right + across.T @ np.linalg.solve(noise, missing))
    linearisation: Any = SimpleNamespace(at=lambda _values, _states: found)
    factors = _Answer(linearisation, back, covariance).factors(np.zeros(values), np.zeros((size // 6, 2, 3)))
    steps, after, _ = _step(factors, slopes, missing, STD)
    np.testing.assert_allclose(steps[values:], expected[:size], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(steps[:values], expected[size:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(after, np.linalg.inv(dense)[size:, size:], rtol=1e-6, atol=1e-9)


def test_lengths_that_say_nothing_leave_the_answer_and_what_it_was_widened_by() -> None:
    """The joint optimum is elsewhere, and the normal equations are more certain: both are of another question."""
    size, values = 24, 3
    found, whole, _ = equations(4, size, values)
    widened = 9.0 * np.linalg.inv(whole)[size:, size:]
    linearisation: Any = SimpleNamespace(at=lambda _values, _states: found)
    factors = _Answer(linearisation, np.zeros(values), widened).factors(np.zeros(values), np.zeros((size // 6, 2, 3)))
    steps, after, cost = _step(factors, np.ones((5, size)), np.ones(5), 1e6)
    np.testing.assert_allclose(steps[:values], 0.0, atol=1e-9)
    np.testing.assert_allclose(after, widened, rtol=1e-9)
    assert cost < 1e-9


def test_a_free_scale_leaves_what_is_known_beside_it() -> None:
    """In the coordinates of the scale and of what is independent of it, the scale alone is less certain."""
    rng = np.random.default_rng(3)
    root, gradient = rng.standard_normal((4, 4)), rng.standard_normal(4)
    covariance = root @ root.T
    with_scale = covariance @ gradient
    freed = with_free_scale(covariance, gradient, 7.0)
    assert gradient @ freed @ gradient == pytest.approx(49.0)
    beside = np.eye(4) - np.outer(with_scale, gradient) / (gradient @ with_scale)  # of the scale's regression
    np.testing.assert_allclose(beside @ freed @ beside.T, beside @ covariance @ beside.T, atol=1e-12)
    np.testing.assert_array_equal(with_free_scale(covariance, gradient, 0.0), covariance)


def test_derivatives_of_distances_are_the_numerical_ones() -> None:
    rng = np.random.default_rng(2)
    knots = place_knots(
        [np.linspace(*span, 6) for span in ((0.0, 1.0), (0.2, 1.3), (0.0, 2.0))], 0.4, ConstantVelocity(0.5)
    )
    fit: Any = SimpleNamespace(knots=knots)
    states = rng.standard_normal((len(knots.times), 2, 3))
    pairs = np.array([[0, 1], [1, 2]])
    pair, times = _sampled(fit, pairs, states.size)
    assert (times[pair == 0] > 0.2).all()
    assert (times[pair == 0] < 1.0).all()
    rows = np.linspace(0, len(times) - 1, 7).astype(int)
    distances, slopes = _distances(fit, states, pairs[pair[rows]], times[rows])
    for k in range(states.size):
        moved = states.ravel().copy()
        moved[k] += 1e-6
        after, _ = _distances(fit, moved.reshape(states.shape), pairs[pair[rows]], times[rows])
        np.testing.assert_allclose((after - distances) / 1e-6, slopes[:, k], atol=2e-5)


@pytest.mark.parametrize("noise", [0.02, 2.0])
def test_a_pair_of_about_the_length_is_told_from_one_of_the_length_where_the_tracks_are_precise(noise: float) -> None:
    """Two rods of 10, known to 0.01, a pair of 10.3, and one that goes from 9.8 to 10.2."""
    times = np.arange(0.0, 8.0, 0.1)
    shift = np.array([3.0, 1.0, 2.0])
    paths = []
    rod = np.full(len(times), 10.0)
    for number, distance in enumerate((rod, rod, rod + 0.3, np.linspace(9.8, 10.2, len(times)))):
        one = number * np.array([0.0, 30.0, 0.0]) + times[:, None] * shift
        paths += [one, one + distance[:, None] * [0.6, 0.0, 0.8]]
    knots = place_knots([times] * 8, 1.0, ConstantVelocity(0.5))
    numbers, every = np.repeat(np.arange(8), len(times)), np.tile(times, 8)
    at = interpolation(knots, numbers, every)
    states = fit_states(knots, *at, np.concatenate(paths), np.full(len(every), 1e8))
    # every position is a measurement of this noise on each axis
    size = states.size
    rows = np.zeros((3 * len(every), size))
    for axis in range(3):
        for weight in range(4):
            column = 6 * at.knot + 3 * weight + axis
            rows[np.arange(len(every)) * 3 + axis, np.minimum(column, size - 1)] += at.weights[:, weight]
    whole = rows.T @ rows / noise**2
    bands = np.zeros((12, size))
    for k in range(12):
        bands[k, : size - k] = np.diagonal(whole, -k)
    nothing = np.zeros((size, 1))
    equations = NormalEquations(0.0, bands, nothing, np.eye(1), np.zeros(size), np.zeros(1), np.empty(0))
    linearisation: Any = SimpleNamespace(at=lambda _values, _states: equations)
    fit: Any = SimpleNamespace(knots=knots, adjustment=SimpleNamespace(states=states, values=np.zeros(1)))
    odds = _odds_of_lengths(_Answer(linearisation, np.zeros(1), np.eye(1)), fit, np.arange(8).reshape(4, 2), 10.0, 0.01)
    if noise < 1.0:
        assert (odds[:2] > 3.0).all()
        assert (odds[2:] < -10.0).all()
    else:
        assert np.abs(odds).max() < 2.0


@pytest.mark.parametrize("count", [2, 201, 300])
def test_any_number_of_rods_have_odds(count: int) -> None:
    """Rods of 10, alike but for their places, have the same odds; more than 133 are asked three times each."""
    times = np.arange(0.0, 2.0, 0.25)
    shift = np.array([3.0, 1.0, 2.0])
    paths = []
    for number in range(count):
        one = number * np.array([0.0, 30.0, 0.0]) + times[:, None] * shift
        paths += [one, one + 10.0 * np.array([0.6, 0.0, 0.8])]
    knots = place_knots([times] * (2 * count), 3.0, ConstantVelocity(0.5))
    numbers, every = np.repeat(np.arange(2 * count), len(times)), np.tile(times, 2 * count)
    states = fit_states(knots, *interpolation(knots, numbers, every), np.concatenate(paths), np.full(len(every), 1e8))
    size = states.size
    bands = np.zeros((12, size))
    bands[0] = 1e4
    equations = NormalEquations(0.0, bands, np.zeros((size, 1)), np.eye(1), np.zeros(size), np.zeros(1), np.empty(0))
    linearisation: Any = SimpleNamespace(at=lambda _values, _states: equations)
    fit: Any = SimpleNamespace(knots=knots, adjustment=SimpleNamespace(states=states, values=np.zeros(1)))
    odds = _odds_of_lengths(
        _Answer(linearisation, np.zeros(1), np.eye(1)), fit, np.arange(2 * count).reshape(count, 2), 10.0, 0.01
    )
    assert odds.shape == (count,)
    np.testing.assert_allclose(odds, odds[0], rtol=1e-6)
    assert odds[0] > 2.0
    pair, _ = _sampled(fit, np.arange(2 * count).reshape(count, 2), size, 3)
    assert (np.bincount(pair) == max(400 // count, 3)).all()


def test_equations_without_a_solution_leave_the_odds_as_they_are() -> None:
    knots = place_knots([np.linspace(0.0, 1.0, 4)] * 2, 0.4, ConstantVelocity(0.5))
    size = 6 * len(knots.times)
    equations = NormalEquations(
        0.0, -np.ones((12, size)), np.zeros((size, 1)), np.eye(1), np.zeros(size), np.zeros(1), np.empty(0),
    )  # fmt: skip
    linearisation: Any = SimpleNamespace(at=lambda _values, _states: equations)
    states = np.arange(float(size)).reshape(-1, 2, 3)
    fit: Any = SimpleNamespace(knots=knots, adjustment=SimpleNamespace(states=states, values=np.zeros(1)))
    np.testing.assert_array_equal(
        _odds_of_lengths(_Answer(linearisation, np.zeros(1), np.eye(1)), fit, np.array([[0, 1]]), 1.0, 0.1), [0.0]
    )
