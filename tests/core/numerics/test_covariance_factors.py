"""Factors of covariances that rounding has made indefinite."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.numerics.covariance_factors import covariance_factor


def test_a_covariance_has_its_cholesky_factor() -> None:
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_array_equal(covariance_factor(covariance), np.linalg.cholesky(covariance))


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e15])
def test_a_direction_that_is_lost_in_rounding(scale: float) -> None:
    direction = scale * np.array([1.0, 1.0 / 3.0, -0.7])
    covariance = np.outer(direction, direction) - 1e-13 * scale**2 * np.eye(3)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(covariance)
    factor = covariance_factor(covariance)
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=1e-11)


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_what_is_no_covariance(matrix: np.ndarray) -> None:
    with pytest.raises(np.linalg.LinAlgError):
        covariance_factor(matrix)
