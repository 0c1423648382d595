"""Errors of calibrated cameras, and NEES."""

import numpy as np
import pytest

from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.metrics.calibration import normalised_error_squared, pose_errors


def test_errors_are_those_relative_to_the_reference() -> None:
    true = [Pose(np.eye(3), (0.0, 0.0, 0.0)), Pose(np.eye(3), (10.0, 0.0, 0.0)), Pose(np.eye(3), (0.0, 20.0, 0.0))]
    # all cameras moved together, half as large again, and the second turned by 0.1 about an axis of its own
    turn, shift = rotation_from_vector([0.3, -0.2, 0.1]), np.array([5.0, -3.0, 2.0])
    own = rotation_from_vector([0.0, 0.1, 0.0])
    moved = [Pose(p.rotation @ turn.T, turn @ (1.5 * p.center) + shift) for p in true]
    moved[1] = Pose(own @ moved[1].rotation, moved[1].center)
    errors = pose_errors(moved, true, 0)
    np.testing.assert_allclose(errors.rotation, [0.1, 0.0], atol=1e-7)
    np.testing.assert_allclose(errors.direction, 0.0, atol=1e-7)
    np.testing.assert_allclose(errors.scale_ratio, 1.5)
    np.testing.assert_allclose(errors.center, [5.0, 10.0])
    np.testing.assert_allclose(errors.center_after_scale, 0.0, atol=1e-12)
    assert errors.common_scale == pytest.approx(1.5)
    # a direction that is off by 0.2 rad
    turned = [true[0], true[1], Pose(np.eye(3), (20.0 * np.sin(0.2), 20.0 * np.cos(0.2), 0.0))]
    assert pose_errors(turned, true, 0).direction[1] == pytest.approx(0.2)


def test_nees_of_covariances_that_say_something_and_that_do_not() -> None:
    rng = np.random.default_rng(1)
    factor = np.diag([1.0, 1e-3, 1e-6]) @ rng.standard_normal((3, 3))
    errors = rng.standard_normal((4000, 3)) @ factor.T
    values = [normalised_error_squared(error, factor @ factor.T) for error in errors]
    # to five standard errors of a chi-square with 3 degrees of freedom
    assert np.mean(values) == pytest.approx(3.0, abs=5.0 * np.sqrt(6.0 / 4000))
    one = np.outer(factor[:, 0], factor[:, 0])
    assert np.isnan(normalised_error_squared(errors[0], one))
    assert np.isnan(normalised_error_squared(errors[0], one * (1.0 + 1e-16 * rng.standard_normal((3, 3)))))
    assert np.isnan(normalised_error_squared(errors[0], np.zeros((3, 3))))
