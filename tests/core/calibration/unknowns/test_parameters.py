"""Parameters: names, priors and the map to cameras."""

import numpy as np
import pytest

from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER, ROTATION
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import rotation_from_vector
from tests import scenes


def camera(name: str, center: tuple[float, float, float], yaw: float) -> Camera:
    return scenes.build_camera(name, center, [0.0, yaw, 0.0], focal=(900.0, 890.0), middle=(400.0, 300.0))


@pytest.fixture
def parameters() -> ParameterSet:
    cameras = (camera("left", (-20, 0, 0), -0.2), camera("right", (20, 0, 0), 0.3))
    stds = (5.0, 5.0, 5.0, 0.01, 0.1, 0.01)
    return ParameterSet(
        cameras,
        tuple(Parameter(n, "right", 0.0, s) for n, s in zip(CENTER + ROTATION, stds, strict=True)),
    )


def test_offsets_move_the_centre_in_the_world_and_turn_about_the_cameras_own_axes(parameters: ParameterSet) -> None:
    left, right = parameters.build([1.0, 2.0, 3.0, 0.0, 0.0, 0.5])
    assert left is parameters.cameras[0]
    np.testing.assert_allclose(right.pose.center, [21.0, 2.0, 3.0])
    # a roll leaves the optical axis where it is
    np.testing.assert_allclose(right.pose.rotation[2], parameters.cameras[1].pose.rotation[2])
    turned = right.pose.rotation @ parameters.cameras[1].pose.rotation.T
    np.testing.assert_allclose(turned, rotation_from_vector([0.0, 0.0, 0.5]), atol=1e-12)


def test_build_and_difference_are_inverse(parameters: ParameterSet) -> None:
    values = parameters.sample(np.random.default_rng(1), 5)
    for row in values:
        np.testing.assert_allclose(parameters.difference(parameters.build(row)), row, atol=1e-12)


def test_prior_is_the_normal_density(parameters: ParameterSet) -> None:
    from scipy.stats import multivariate_normal

    values = parameters.sample(np.random.default_rng(2), 4)
    expected = multivariate_normal(parameters.prior_mean, np.diag(parameters.prior_std**2)).logpdf(values)
    np.testing.assert_allclose(parameters.log_prior(values), expected)
    assert parameters.log_prior(values[0]).shape == ()


def test_samples_have_the_priors_spread(parameters: ParameterSet) -> None:
    samples = parameters.sample(np.random.default_rng(3), 20_000) / parameters.prior_std
    # five standard errors of a standard deviation: 5 / sqrt(2 n)
    np.testing.assert_allclose(samples.std(axis=0), 1.0, atol=5 / np.sqrt(40_000))


def test_bad_parameters_are_refused(parameters: ParameterSet) -> None:
    with pytest.raises(ValueError, match="positive standard deviation"):
        Parameter("center_x", "right", 0.0, 0.0)
    with pytest.raises(ValueError, match="expected one of"):
        Parameter("center_w", "right", 0.0, 1.0)
    with pytest.raises(ValueError, match="every parameter once"):
        ParameterSet(parameters.cameras, parameters.parameters * 2)
    with pytest.raises(ValueError, match="expected 6 values"):
        parameters.build([0.0])
