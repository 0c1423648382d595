"""Motion models: exact discretisation for any time step."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static

steps = st.floats(-100.0, 100.0, allow_subnormal=False)
accelerations = st.tuples(*[st.floats(0.0, 10.0, allow_subnormal=False)] * 3)


def scale(*matrices: np.ndarray) -> float:
    """Size of the largest entry, for a tolerance."""
    return 1e-12 * max(1.0, *(float(np.abs(matrix).max()) for matrix in matrices))


@settings(max_examples=100)
@given(first=steps, second=steps, acceleration_std=accelerations)
def test_two_steps_of_one_direction_are_one_step(
    first: float, second: float, acceleration_std: tuple[float, ...]
) -> None:
    second = abs(second) * (-1.0 if first < 0 else 1.0)
    motion = ConstantVelocity(acceleration_std)
    (f1, q1, _), (f2, q2, _), (f, q, _) = (motion.transition(dt) for dt in (first, second, first + second))
    np.testing.assert_allclose(f2 @ f1, f, rtol=0, atol=scale(f))
    np.testing.assert_allclose(f2 @ q1 @ f2.T + q2, q, rtol=0, atol=scale(q, q1, q2))


@settings(max_examples=100)
@given(dt=steps, acceleration_std=accelerations)
def test_backward_step_undoes_the_forward_one(dt: float, acceleration_std: tuple[float, ...]) -> None:
    motion = ConstantVelocity(acceleration_std)
    forward, forward_covariance, _ = motion.transition(dt)
    backward, backward_covariance, _ = motion.transition(-dt)
    np.testing.assert_allclose(backward @ forward, np.eye(6), rtol=0, atol=1e-12)
    # x(t) = F x(t - dt) + w, hence x(t - dt) = F^-1 x(t) - F^-1 w.
    expected = backward @ forward_covariance @ backward.T
    np.testing.assert_allclose(backward_covariance, expected, rtol=0, atol=scale(expected, forward_covariance) * 10)


@settings(max_examples=100)
@given(dt=steps, acceleration_std=accelerations)
def test_process_covariance_is_symmetric_and_positive(dt: float, acceleration_std: tuple[float, ...]) -> None:
    _, q, _ = ConstantVelocity(acceleration_std).transition(dt)
    assert np.array_equal(q, q.T)
    assert np.linalg.eigvalsh(q).min() >= -scale(q)


def test_process_covariance_is_the_integral_of_white_acceleration() -> None:
    # Q = integral over the step of q F(s) G G^T F(s)^T, G the input of the acceleration.
    acceleration_std, dt, n = np.array([0.5, 1.0, 2.0]), 1.7, 20000
    s = (np.arange(n) + 0.5) * dt / n
    gain = np.stack([s, np.ones(n)])
    per_axis = gain @ gain.T * dt / n
    _, q, _ = ConstantVelocity(acceleration_std).transition(dt)
    for axis in range(3):
        block = q[np.ix_([axis, axis + 3], [axis, axis + 3])]
        np.testing.assert_allclose(block, acceleration_std[axis] ** 2 * per_axis, rtol=1e-8)
    assert q[0, 1] == q[0, 4] == 0.0


def test_one_second_gives_the_stated_change_of_velocity() -> None:
    _, q, _ = ConstantVelocity([0.1, 0.2, 0.3]).transition(1.0)
    np.testing.assert_allclose(np.sqrt(np.diag(q)[3:]), [0.1, 0.2, 0.3])


def test_no_time_is_no_change() -> None:
    f, q, _ = ConstantVelocity([1.0, 2.0, 3.0], max_speed=5.0).transition(0.0)
    assert np.array_equal(f, np.eye(6))
    assert np.array_equal(q, np.zeros((6, 6)))


def test_transition_moves_positions_by_velocity() -> None:
    f, _, _ = ConstantVelocity([0.0, 0.0, 0.0]).transition(-2.0)
    assert (f @ [1.0, 2.0, 3.0, 0.5, 0.0, -1.0]).tolist() == [0.0, 2.0, 5.0, 0.5, 0.0, -1.0]


@pytest.mark.parametrize("dt", [-3.0, 0.0, 4.0])
def test_static_objects_do_not_move(dt: float) -> None:
    f, q, _ = Static().transition(dt)
    assert np.array_equal(f, np.eye(6))
    assert np.array_equal(q, np.zeros((6, 6)))
    assert np.array_equal(Static().noise_std, np.zeros(3))
    assert Static().max_speed is None


def test_models_compare_by_value() -> None:
    assert ConstantVelocity((1, 2, 3), 4) == ConstantVelocity([1.0, 2.0, 3.0], 4.0)
    assert hash(ConstantVelocity((1, 2, 3), 4)) == hash(ConstantVelocity([1.0, 2.0, 3.0], 4.0))
    assert ConstantVelocity((1, 2, 3)) != ConstantVelocity((1, 2, 3), 4)
    assert Static() == Static()


@pytest.mark.parametrize(
    "arguments", [((-1, 0, 0),), ((1, 1),), ((1, np.nan, 1),), ((1, 1, 1), 0.0), ((1, 1, 1), -2.0)]
)
def test_bad_motion_is_refused(arguments: tuple[object, ...]) -> None:
    with pytest.raises(ValueError, match="motion"):
        ConstantVelocity(*arguments)  # type: ignore[arg-type]


def test_arrays_of_many_intervals_are_not_kept() -> None:
    """Thousands of objects have another number of components at each event."""
    motion = ConstantVelocity(0.1)
    tracemalloc.start()
    for count in range(50_000, 50_040):
        assert len(motion.arrays(np.full(count, 0.1)).keep) == count
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # those of one number are 3.6 MB
    assert kept < 10e6
