"""Gaussians carried between disparity spaces: against large samples, against NumPy, and exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, Sources
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from tests.core.disparity.cases import (
    LENSES,
    in_deviations,
    make_camera,
    make_space,
    random_covariance,
    state_in,
    weighted,
)
from tests.core.disparity.moves import (
    METHODS,
    Case,
    figure_4,
    figure_7,
    monte_carlo_margins,
    nearly_linear,
    sample_sets,
)


def check_against_reference(case: Case, method: str, samples: int) -> None:
    points, seen = case.reference
    share = seen.mean()
    mean, covariance = points[seen].mean(axis=0), np.cov(points[seen].T)
    in_view = samples * share
    mean_margin, variance_margin = monte_carlo_margins(points[seen], in_view)
    sets = sample_sets(method, samples, case.motion)
    for turn in range(4):
        moved = case.move(sets, turn)
        assert moved.status[0] == (IN_VIEW if moved.fraction[0] == 1.0 else PARTLY_IN_VIEW)
        assert abs(moved.fraction[0] - share) <= 5.0 * np.sqrt(share * (1.0 - share) / samples) + 1.0 / samples
        assert in_deviations(moved.means[0] - mean, covariance).max() <= mean_margin
        relative = np.abs(np.diag(moved.covariances[0]) / np.diag(covariance) - 1.0)
        assert (relative <= variance_margin).all()
        # correlations: off-diagonal errors are at most those of the variances
        error = in_deviations(moved.covariances[0] - covariance, covariance)
        assert (error <= np.sqrt(np.outer(variance_margin, variance_margin))).all()


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("method", ["qmc", "adaptive", "unscented", "linear"])
def test_nearly_linear_move(method: str, size: int) -> None:
    """Where the map is nearly linear no sampling noise is left: 1 % of a deviation, 2 % of a covariance."""
    case = nearly_linear(size)
    points, seen = case.reference
    assert seen.all()
    covariance = np.cov(points.T)
    sets = sample_sets(method, 64, case.motion)
    for turn in range(16):
        moved = case.move(sets, turn)
        assert moved.status[0] == IN_VIEW
        assert moved.fraction[0] == 1.0
        # linear: the mean of the image is not the image of the mean, by second-order terms
        assert in_deviations(moved.means[0] - points.mean(axis=0), covariance).max() < (
            0.03 if method == "linear" else 0.012
        )
        assert in_deviations(moved.covariances[0] - covariance, covariance).max() < 0.02


@pytest.mark.parametrize("size", [3, 6])
def test_nearly_linear_move_of_particles(size: int) -> None:
    check_against_reference(nearly_linear(size), "particle", 1024)


@pytest.mark.parametrize("method", ["qmc", "particle"])
@pytest.mark.parametrize("case", [figure_4(), figure_7(), figure_7(3)], ids=["figure 4", "figure 7", "figure 7 static"])
def test_paper_figures(case: Case, method: str) -> None:
    check_against_reference(case, method, 512)


def test_figure_7_reaches_beyond_the_image() -> None:
    _, seen = figure_7().reference
    assert 0.5 < seen.mean() < 0.95


@pytest.mark.parametrize("method", ["unscented", "linear"])
def test_low_order_methods_in_the_paper_figures(method: str) -> None:
    """Unscented and linear may be wrong about Figures 4 and 7 (that is their point), never singular."""
    for case in (figure_4(), figure_7(), figure_7(3)):
        moved = case.move(sample_sets(method, 512, case.motion))
        assert moved.status[0] != OUT_OF_VIEW
        assert np.isfinite(moved.means).all()
        np.linalg.cholesky(moved.covariances[0])


def test_linear_move_of_a_gaussian_narrower_than_numbers_resolve() -> None:
    """The points of the derivative round to one pixel; those of the rule, 5000 times as far away, do not."""
    space = make_space(make_camera())
    case = Case(np.array([400.3, 300.2, 3.4]), 1e-22 * np.eye(3), space, space, 0.0, Static())
    moved = case.move(sample_sets("linear", 64, case.motion))
    assert moved.status[0] == IN_VIEW
    np.testing.assert_allclose(moved.means[0], case.mean)
    np.testing.assert_allclose(moved.covariances[0], case.covariance, atol=0.1e-22)


def test_figure_4_linear_underestimates_the_uncertainty() -> None:
    """What the paper shows of the extended Kalman filter, and that `particle` and `qmc` do not."""
    case = figure_4()
    points, _ = case.reference
    true = np.cov(points[:, :2].T)
    determinant = {
        method: np.linalg.det(case.move(sample_sets(method, 512, case.motion)).covariances[0][:2, :2])
        for method in METHODS
    }
    # noise in px is noise in cm times the disparity, of which linear takes the mean: (E d)^2 and not E d^2,
    # in u and in v; the noise is nearly all of the covariance
    assert determinant["linear"] < 0.9 * np.linalg.det(true)
    assert abs(determinant["qmc"] / np.linalg.det(true) - 1.0) < 0.05


def test_quasi_random_samples_beat_random_ones() -> None:
    """Mean error over the sets in turn: at most a third of that of as many random samples."""
    case = nearly_linear()
    points, _ = case.reference
    mean, covariance = points.mean(axis=0), np.cov(points.T)
    error = {}
    for method in ("qmc", "particle"):
        sets = sample_sets(method, 64, case.motion)
        errors = [in_deviations(case.move(sets, k).means[0] - mean, covariance) for k in range(16)]
        error[method] = np.sqrt(np.mean(np.square(errors)))
    assert error["qmc"] < error["particle"] / 3.0


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32),
    size=st.sampled_from([3, 6]),
    method=st.sampled_from(["qmc", "unscented", "linear"]),
    rectification=st.sampled_from(["horizontal", "vertical"]),
    disparity=st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent),
)
def test_no_move_is_the_identity(seed: int, size: int, method: str, rectification: str, disparity: float) -> None:
    rng = np.random.default_rng(seed)
    space = make_space(make_camera(rng.uniform(-1, 1, 3), rng.uniform(-50, 50, 3)), 2.0, rectification)
    mean = np.array([*rng.uniform(200.0, 400.0, 2), disparity, *rng.uniform(-9, 9, 2), 0.1 * disparity])[:size]
    # correlations short of 1: rounding grows with the condition of the covariance
    shrunk = 0.9 * random_covariance(rng, np.ones(size)) + 0.1 * np.eye(size)
    std = np.array([3.0, 2.0, 0.3 * disparity, 5.0, 6.0, 0.1 * disparity])[:size]
    motion = ConstantVelocity([0.0] * 3) if size == 6 else Static()
    case = Case(mean, shrunk * np.outer(std, std), space, space, 0.0, motion)
    moved = case.move(sample_sets(method, 64, motion))
    assert moved.status[0] == IN_VIEW
    np.testing.assert_allclose(moved.means[0], mean, rtol=1e-9, atol=1e-9 * disparity)
    assert in_deviations(moved.covariances[0] - case.covariance, case.covariance).max() < 1e-9


def oracle_move(case: Case, samples: np.ndarray, p_detect: float) -> tuple[np.ndarray, ...]:
    """What `move` must return of one component, in plain NumPy: mean, covariance, fraction, missed part."""
    points, seen = case.trip(samples)
    states = case.mean + samples[: len(case.mean)].T @ np.linalg.cholesky(case.covariance).T
    missed = weighted(states, 1.0 - p_detect * seen)
    return (*weighted(points, seen.astype(float)), seen.mean(), *missed)


@pytest.mark.parametrize("lens", list(LENSES))
@pytest.mark.parametrize("rectification", ["horizontal", "vertical"])
@pytest.mark.parametrize("dt", [0.0, 1.5, -0.8])
@pytest.mark.parametrize("size", [3, 6])
def test_move_is_the_trip_of_its_samples(lens: str, rectification: str, dt: float, size: int) -> None:
    camera = make_camera((0.0, -0.3, 0.1), (-20.0, 0.0, 0.0), LENSES[lens])
    home = make_space(camera, 1.0, rectification)
    destination = make_space(make_camera((0.05, 0.1, 0.0), (20.0, 3.0, 0.0), LENSES[lens]), 1.3, rectification)
    motion: Motion = ConstantVelocity([0.3, 1.0, 0.6], max_speed=5.0) if size == 6 else Static()
    sets = sample_sets("qmc", 256, motion)
    # components in the middle and at each edge of the destination's image
    places = [[20.0, 0.0, 100.0], [52.0, 2.0, 100.0], [-35.0, 5.0, 100.0], [15.0, 38.0, 90.0]]
    covariance = random_covariance(np.random.default_rng(5), [9.0, 9.0, 0.6, 20.0, 20.0, 0.6][:size])
    cases = [
        Case(state_in(home, [*place, 2.0, -1.0, 1.0][:size]), covariance, home, destination, dt, motion)
        for place in places
    ]
    moved = move(
        Sources(
            np.stack([case.mean for case in cases]), np.stack([covariance] * 4), np.stack([home.packed()] * 4),
            motion.arrays(np.full(4, dt)),
        ),
        destination.packed(), sets, 3, 0.9,
    )  # fmt: skip
    partly = 0
    for k, case in enumerate(cases):
        mean, expected, fraction, missed_mean, missed = oracle_move(case, sets.turn(3), 0.9)
        if fraction < 32 / 256:
            assert moved.status[k] == OUT_OF_VIEW
            continue
        assert moved.fraction[k] == pytest.approx(fraction, abs=1e-12)
        np.testing.assert_allclose(moved.means[k], mean, rtol=1e-8)
        assert in_deviations(moved.covariances[k] - expected, expected).max() < 1e-8
        assert moved.status[k] == (IN_VIEW if fraction == 1.0 else PARTLY_IN_VIEW)
        if fraction < 1.0:
            partly += 1
            np.testing.assert_allclose(moved.missed_means[k], missed_mean, rtol=1e-10)
            assert in_deviations(moved.missed_covariances[k] - missed, missed).max() < 1e-10
    assert partly >= 2
