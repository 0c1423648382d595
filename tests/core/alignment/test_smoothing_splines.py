"""Smoothing splines: those of SciPy at the same smoothness, and as near to the truth as its cross-validation."""

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.optimize import minimize_scalar

from stereophd.core.alignment.smoothing_splines import smoothing_spline
from stereophd.core.arrays import Array


def noisy(noise: float) -> tuple[Array, Array, Array]:
    """Times in uneven steps, values, and their true derivatives."""
    rng = np.random.default_rng(4)
    times = np.arange(120) / 5.0 + rng.uniform(-0.05, 0.05, 120)
    return times, 8.0 * np.sin(0.4 * times) + rng.normal(0.0, noise, 120), 3.2 * np.cos(0.4 * times)


def test_a_spline_is_one_of_those_of_scipy() -> None:
    times, values, _ = noisy(0.1)
    found = smoothing_spline(times, values)(times)

    def off(log: float) -> float:
        return float(np.abs(make_smoothing_spline(times, values, lam=np.exp(log))(times) - found).max())

    assert minimize_scalar(off, bounds=(-10.0, 10.0), method="bounded", options={"xatol": 1e-10}).fun < 1e-7


@pytest.mark.parametrize("noise", [1e-9, 0.03, 0.5])
def test_velocities_are_as_good_as_those_of_cross_validation_by_the_bands_of_an_inverse(noise: float) -> None:
    times, values, true = noisy(noise)
    by_scipy = make_smoothing_spline(times, values).derivative()(times)
    error, other = (
        float(np.sqrt(((one - true) ** 2).mean())) for one in (smoothing_spline(times, values)(times, 1), by_scipy)
    )
    assert error < 1.05 * other


def test_a_few_values_on_a_line_stay() -> None:
    times = np.array([0.0, 1.0, 3.0, 4.0, 7.0])
    np.testing.assert_allclose(smoothing_spline(times, 2.0 * times - 1.0)(times, 1), 2.0, atol=1e-9)
