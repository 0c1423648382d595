"""What a posterior says: observability, spreads of poses, draws."""

import numpy as np
import pytest

from stereophd.core.calibration.unknowns.observability import (
    DETERMINED,
    PARTLY,
    UNDETERMINED,
    laplace_draws,
    observability,
)
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.pose import CENTER, ROTATION
from tests.scenes import build_camera

STDS = np.array([5.0, 5.0, 5.0, 0.01, 0.1, 0.01])


@pytest.fixture
def parameters() -> ParameterSet:
    cameras = tuple(
        build_camera(name, (x, 0.0, 0.0), (0.0, yaw, 0.0), focal=(900.0, 890.0), middle=(400.0, 300.0))
        for name, x, yaw in (("left", -20.0, -0.2), ("right", 20.0, 0.3))
    )  # fmt: skip
    chosen = zip(CENTER + ROTATION, STDS, strict=True)
    return ParameterSet(cameras, tuple(Parameter(n, "right", 0.0, float(s)) for n, s in chosen))


def test_what_the_data_leave_as_the_prior_has_it_is_undetermined(parameters: ParameterSet) -> None:
    known = np.array([1.0, 0.02, 0.02, 0.02, 0.02, 0.02])
    nothing = np.zeros(6)
    found = observability(parameters, 0, nothing, np.diag((known * STDS) ** 2))
    # the one open direction is the scale
    assert (found.status, found.scale_ratio) == (DETERMINED, pytest.approx(1.0))
    assert np.abs(found.directions[-1]).argmax() == 0
    assert found.information_bits == pytest.approx(5 * np.log2(50.0))
    for ratios, status in (([1, 1, 0.1, 0.1, 0.1, 0.1], PARTLY), ([1, 1, 1, 1, 0.1, 0.1], UNDETERMINED)):
        assert observability(parameters, 0, nothing, np.diag((np.array(ratios) * STDS) ** 2)).status == status
    # an open direction that is not the scale is not forgiven
    yaw = np.array([0.02, 0.02, 0.02, 0.02, 1.0, 0.02])
    assert observability(parameters, 0, nothing, np.diag((yaw * STDS) ** 2)).status == PARTLY


def test_the_scale_is_that_of_the_prior_where_one_centre_is_known_best() -> None:
    """The data know the shape of three cameras, and the prior the distance of one of them: that is the scale."""
    cameras = tuple(build_camera(f"cam{k}", (20.0 * k, 0.0, 0.0), (0.0, 0.0, 0.0)) for k in range(3))
    chosen = [(f"cam{k}", name, std) for k, std in ((1, 0.5), (2, 10.0)) for name in CENTER]
    parameters = ParameterSet(cameras, tuple(Parameter(name, camera, 0.0, std) for camera, name, std in chosen))
    covariance = np.diag(np.full(6, 1e-6))
    # each centre lies on its ray; the prior knows the logarithm of the scale to 0.5 / 20 and to 10 / 40
    offsets = np.array([20.0, 0.0, 0.0, 40.0, 0.0, 0.0])
    covariance += np.outer(offsets, offsets) / ((20.0 / 0.5) ** 2 + (40.0 / 10.0) ** 2)
    found = observability(parameters, 0, np.zeros(6), covariance)
    assert (found.status, found.scale_ratio) == (DETERMINED, pytest.approx(1.0, abs=1e-3))


def test_draws_at_a_larger_scale_are_spread_wider(parameters: ParameterSet) -> None:
    stds = np.array([12.0, 0.2, 0.4, 0.001, 0.002, 0.001])
    covariance = np.diag(stds**2)
    covariance[2, 4] = covariance[4, 2] = 0.7 * stds[2] * stds[4]
    count = 40_000
    draws = laplace_draws(parameters, 0, np.zeros(6), covariance, count, np.random.default_rng(1))
    factor = 1.0 + draws[:, 0] / 40.0
    # to five standard errors
    tolerance = 5.0 / np.sqrt(count)
    np.testing.assert_allclose(draws.std(axis=0)[[0, 3, 4, 5]] / stds[[0, 3, 4, 5]], 1.0, atol=tolerance)
    directions = draws[:, 1:3] / factor[:, None]
    np.testing.assert_allclose(directions.std(axis=0) / stds[1:3], 1.0, atol=tolerance)
    assert np.corrcoef(directions[:, 1], draws[:, 4])[0, 1] == pytest.approx(0.7, abs=tolerance)
    for chosen in (factor > 1.3, factor < 0.7):
        ratio = draws[chosen, 1].std() / stds[1] / np.sqrt((factor[chosen] ** 2).mean())
        assert ratio == pytest.approx(1.0, abs=5.0 / np.sqrt(2 * chosen.sum()))


def test_draws_of_a_known_scale_are_normal(parameters: ParameterSet) -> None:
    covariance = np.diag((0.01 * STDS) ** 2)
    rng = np.random.default_rng(2)
    draws = laplace_draws(parameters, 0, np.ones(6), covariance, 2000, rng)
    expected = 1.0 + np.random.default_rng(2).standard_normal((2000, 6)) * 0.01 * STDS
    np.testing.assert_allclose(draws, expected, rtol=0.0, atol=1e-3 * STDS.max())
