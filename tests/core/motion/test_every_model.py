"""What holds for every motion model: its equations fit one another, and everything built from them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from stereophd.core.motion.settings import motion_models
from stereophd.core.simulation.objects import walk
from tests.core.motion.examples import MOVING, SETTINGS, WORDS, example

steps = st.floats(-8.0, 8.0, allow_subnormal=False)
every = pytest.mark.parametrize("word", WORDS)
moving = pytest.mark.parametrize("word", MOVING)


def close(found: np.ndarray, expected: np.ndarray, *others: np.ndarray) -> None:
    """Compare to the rounding of the largest entry."""
    size = max(1.0, *(float(np.abs(matrix).max()) for matrix in (expected, *others)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * size)


def test_every_model_has_an_example() -> None:
    assert set(SETTINGS) == set(motion_models())
    assert all(kind().model == word for word, kind in motion_models().items() if not SETTINGS[word])


@every
@settings(max_examples=50)
@given(first=steps, second=steps)
def test_two_intervals_of_one_direction_are_one(word: str, first: float, second: float) -> None:
    motion = example(word)
    second = abs(second) * (-1.0 if first < 0 else 1.0)
    (f1, q1, b1), (f2, q2, b2), (f, q, b) = (motion.transition(dt) for dt in (first, second, first + second))
    close(f2 @ f1, f, f2)
    close(f2 @ q1 @ f2.T + q2, q, q2)
    close(f2 @ b1 + b2, b, b2)


@every
@settings(max_examples=50)
@given(dt=steps)
def test_backward_undoes_forward(word: str, dt: float) -> None:
    motion = example(word)
    forward, backward = motion.transition(dt), motion.transition(-dt)
    close(backward.matrix @ forward.matrix, np.eye(6), backward.matrix)
    close(backward.matrix @ forward.drift + backward.drift, np.zeros(6), backward.drift)
    close(backward.noise, backward.matrix @ forward.noise @ backward.matrix.T, backward.noise, forward.noise)
    assert np.linalg.eigvalsh(forward.noise).min() >= -1e-11 * max(1.0, np.abs(forward.noise).max())


@every
@pytest.mark.parametrize("dt", [1e-4, 0.3, 4.0])
def test_equations_are_those_of_one_linear_system(word: str, dt: float) -> None:
    """The transition is an exponential, the noise white acceleration carried by it (C. Van Loan's integral)."""
    motion, h = example(word), 1e-6
    rate, pull = (motion.transition(h)[0] - motion.transition(-h)[0]) / (2 * h), motion.transition(h).drift / h
    white = np.diag([0.0, 0.0, 0.0, *motion.noise_std**2])
    # d/dt (x, 1) = [[A, b], [0, 0]] (x, 1), and exp [[-A, W], [0, A^T]] dt = [[.., F^-1 Q], [0, F^T]]
    affine = np.block([[rate, pull[:, None]], [np.zeros((1, 7))]])
    expected = expm(affine * dt)
    both = expm(np.block([[-rate, white], [np.zeros((6, 6)), rate.T]]) * dt)
    matrix, noise, drift = motion.transition(dt)
    np.testing.assert_allclose(matrix, expected[:6, :6], atol=1e-8)
    np.testing.assert_allclose(drift, expected[:6, 6], atol=1e-5 * max(dt, dt**2))
    np.testing.assert_allclose(noise, both[6:, 6:].T @ both[:6, 6:], rtol=1e-6, atol=1e-17)


@every
@pytest.mark.parametrize("dt", [0.0, 1e-5, 0.4, 30.0, -1.3])
def test_factor_of_the_noise(word: str, dt: float) -> None:
    motion = example(word)
    factor = motion.noise_factor(np.array([dt]))
    root = np.zeros((2, 2))
    root[0] = factor.position_noise * [factor.with_velocity[0], factor.alone[0]]
    root[1, 0] = factor.velocity_noise[0]
    position, cross, velocity = motion.noise(np.array(dt))
    expected = np.array([[position, cross], [cross, velocity]])
    std = np.maximum(np.sqrt(np.diag(expected)), 1e-100)
    np.testing.assert_allclose(root @ root.T / np.outer(std, std), expected / np.outer(std, std), atol=1e-9)


@every
def test_drawn_noise_has_the_covariance_of_the_model(word: str) -> None:
    """3000 walks of three uneven steps: sample moments within 5 standard errors."""
    motion, number = example(word), 3000
    intervals, start = np.array([0.2, 0.0, 1.1]), np.array([1.0, 2.0, 3.0, 0.5, -0.5, 0.2])
    rng, arrays = np.random.default_rng(1), motion.arrays(intervals)
    shocks = [motion.shocks(intervals, rng.standard_normal((3, 2, 3))) for _ in range(number)]
    ends = np.array([walk(start, arrays, *shock)[-1] for shock in shocks])
    matrix, noise, drift = motion.transition(1.3)
    std = np.sqrt(np.diag(noise))
    assert (np.abs(ends.mean(axis=0) - matrix @ start - drift) <= 5 * std / np.sqrt(number) + 1e-12).all()
    error = np.sqrt((noise**2 + np.outer(std**2, std**2)) / number)
    assert (np.abs(np.cov(ends.T) - noise) <= 5 * error + 1e-12).all()


@moving
def test_between_two_states_lies_their_conditional_mean(word: str) -> None:
    motion, elapsed, interval = example(word), 0.7, 1.9
    first, rest = motion.transition(elapsed), motion.transition(interval - elapsed)
    before, after = np.array([1.0, 2.0, 3.0, 0.5, -0.5, 0.2]), np.array([2.5, 0.8, 3.5, 0.4, -0.9, 0.1])
    mean = first.matrix @ before + first.drift
    gain = first.noise @ rest.matrix.T @ np.linalg.inv(rest.matrix @ first.noise @ rest.matrix.T + rest.noise)
    expected = mean + gain @ (after - rest.matrix @ mean - rest.drift)
    states = np.stack([before, after]).reshape(4, 3)
    for between, part in ((motion.between, expected[:3]), (motion.velocity_between, expected[3:])):
        weights, offsets = between(np.array([elapsed]), np.array([interval]))
        np.testing.assert_allclose(weights[0] @ states + offsets[0], part, atol=1e-12)


@moving
@pytest.mark.parametrize("deviation", [1e-3, 0.1, 10.0])
def test_knots_are_close_enough(word: str, deviation: float) -> None:
    """Half-way between two known states the position strays by no more than asked for."""
    motion = example(word)
    spacing = motion.knot_spacing(deviation)
    half = motion.transition(spacing / 2)
    whole = half.matrix @ half.noise @ half.matrix.T + half.noise
    gain = half.noise @ half.matrix.T @ np.linalg.inv(whole)
    left = half.noise - gain @ half.matrix @ half.noise
    assert np.sqrt(np.diag(left)[:3].max()) <= deviation * (1 + 1e-6)
    assert example(word, acceleration_std=0.0).knot_spacing(deviation) == np.inf
    assert example(word, acceleration_std=0.0).straying_time(deviation) == np.inf


@moving
def test_precision_is_the_inverse_of_the_noise(word: str) -> None:
    motion, intervals = example(word), np.array([0.05, 0.7, 6.0])
    position, cross, velocity = motion.noise(intervals)
    covariance = np.stack([position, cross, cross, velocity], axis=1).reshape(-1, 2, 2)
    np.testing.assert_allclose(motion.precision(intervals) @ covariance, np.tile(np.eye(2), (3, 1, 1)), atol=1e-9)


def test_a_damped_velocity_settles() -> None:
    motion = example("damped_velocity", acceleration_std=0.5)
    matrix, noise, _ = motion.transition(50.0)
    np.testing.assert_allclose(matrix[3:, 3:], 0.0, atol=1e-10)
    np.testing.assert_allclose(np.sqrt(np.diag(noise)[3:]), 0.5 * np.sqrt(2.0 / 2.0), rtol=1e-10)
    # over many time constants the position walks at random: variance acceleration_std^2 T^2 t
    np.testing.assert_allclose(np.diag(noise)[:3], 0.25 * 4.0 * (50.0 - 3.0), rtol=1e-10)


def test_a_damped_velocity_is_constant_over_short_times() -> None:
    damped = example("damped_velocity", time_constant_s=1e6)
    constant = example("constant_velocity", acceleration_std=SETTINGS["damped_velocity"]["acceleration_std"])
    for found, expected in zip(damped.transition(2.0), constant.transition(2.0), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_a_ball_flies_a_parabola() -> None:
    motion = example("ballistic", gravity=(0.0, 9.81, 0.0), acceleration_std=0.0)
    matrix, noise, drift = motion.transition(0.5)
    state = matrix @ [0.0, 1.0, 5.0, 2.0, -4.0, 0.0] + drift
    np.testing.assert_allclose(state, [1.0, 1.0 - 2.0 + 9.81 / 8, 5.0, 2.0, -4.0 + 9.81 / 2, 0.0], rtol=1e-12)
    assert not noise.any()


@pytest.mark.parametrize(
    ("word", "changes"),
    [
        ("damped_velocity", {"time_constant_s": 0.0}),
        ("damped_velocity", {"acceleration_std": -1.0}),
        ("ballistic", {"gravity": (0.0, np.nan, 0.0)}),
        ("ballistic", {"max_speed": 0.0}),
    ],
)
def test_bad_settings_are_refused(word: str, changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="motion"):
        example(word, **changes)
