"""Gaussians carried between disparity spaces: against large samples, against NumPy, and exactly.

Margins. A fit to N independent samples has an error of std / sqrt(N) in the mean, and of
sqrt((k - 1) / N) of itself in a variance, k being the kurtosis of the (exact) result: `particle` and `qmc`
must stay within five of these for their own N, in the worst of all coordinates. The references have
200,000 samples, whose own error is small against that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.disparity import moments
from stereophd.disparity.moments import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, Moved, move, world_moments
from stereophd.disparity.samples import SampleSets, draw_sample_sets
from stereophd.disparity.space import DisparitySpace
from stereophd.motion import ConstantVelocity, Motion, Static
from tests.disparity.cases import (
    LENSES,
    converging,
    in_deviations,
    make_camera,
    make_space,
    oracle_trip,
    oracle_world,
    random_covariance,
    state_in,
    weighted,
)

METHODS = ("qmc", "particle", "unscented", "linear")
REFERENCE_SAMPLES = 200_000


def sample_sets(method: str, samples: int, motion: Motion, seed: int = 1) -> SampleSets:
    rows = 3 if isinstance(motion, Static) else 12
    return draw_sample_sets(method, samples, rows, np.random.SeedSequence(seed))


@dataclass(frozen=True)
class Case:
    """A Gaussian to be carried from one space to another."""

    mean: np.ndarray
    covariance: np.ndarray
    home: DisparitySpace
    destination: DisparitySpace
    dt: float
    motion: Motion

    def move(self, sets: SampleSets, turn: int = 0, p_detect: float = 1.0, important: bool = False) -> Moved:
        return move(
            self.mean[None], self.covariance[None], self.home.packed()[None], np.array([self.dt]),
            self.destination.packed(), self.motion, sets, turn, p_detect, np.array([important]),
        )  # fmt: skip

    def trip(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return oracle_trip(self.mean, self.covariance, samples, self.home, self.destination, self.dt, self.motion)

    def reference(self) -> tuple[np.ndarray, np.ndarray]:
        return self.trip(np.random.default_rng(99).standard_normal((12, REFERENCE_SAMPLES)))


def nearly_linear(size: int = 6) -> Case:
    """A well localised object: 1 px, 2 % of disparity."""
    home, destination = converging(20.0, 0.26)
    world = [2.0, -3.0, 110.0, 1.0, -0.5, 2.0][:size]
    covariance = random_covariance(np.random.default_rng(1), [1.0, 1.2, 0.15, 1.0, 1.0, 0.02][:size])
    motion = ConstantVelocity([0.1, 0.2, 0.1]) if size == 6 else Static()
    return Case(state_in(home, world), covariance, home, destination, 0.5, motion)


def figure_4() -> Case:
    """Prediction in one camera: velocity (2, 2, 0.5) cm/s, noise of variance 0.08 cm^2/s^2, over 5 s."""
    space = make_space(make_camera())
    mean = state_in(space, [0.0, 0.0, 100.0, 2.0, 2.0, 0.5])
    covariance = np.diag([3.0, 3.0, 2.5, 1.0, 1.0, 0.02]) ** 2
    return Case(mean, covariance, space, space, 5.0, ConstantVelocity([0.08**0.5] * 3, max_speed=10.0))


def figure_7(size: int = 6) -> Case:
    """Cameras 200 cm apart, turned inward by pi/8; velocities of variance 0.03 cm^2/s^2 about 0."""
    home, destination = converging(100.0, np.pi / 8)
    mean = np.array([400.0, 300.0, 3.4, 0.0, 0.0, 0.0])[:size]
    # 0.6 px/s and 0.0022 px/s are 0.03^0.5 cm/s at the mean disparity
    covariance = np.diag([1.4, 1.4, 1.4, 0.6, 0.6, 0.0022])[:size, :size] ** 2
    motion = ConstantVelocity([0.1] * 3, max_speed=2.0) if size == 6 else Static()
    return Case(mean, covariance, home, destination, 1.0, motion)


def monte_carlo_margins(points: np.ndarray, count: int) -> tuple[float, np.ndarray]:
    """Five standard errors of the mean (in standard deviations) and of each variance (relative)."""
    scaled = (points - points.mean(axis=0)) / points.std(axis=0)
    return 5.0 / np.sqrt(count), 5.0 * np.sqrt(((scaled**4).mean(axis=0) - 1.0) / count)


def check_against_reference(case: Case, method: str, samples: int) -> None:
    points, seen = case.reference()
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
@pytest.mark.parametrize("method", ["qmc", "unscented", "linear"])
def test_nearly_linear_move(method: str, size: int) -> None:
    """Where the map is nearly linear no sampling noise is left: 1 % of a deviation, 2 % of a covariance."""
    case = nearly_linear(size)
    points, seen = case.reference()
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
    _, seen = figure_7().reference()
    assert 0.5 < seen.mean() < 0.95


@pytest.mark.parametrize("method", ["unscented", "linear"])
def test_low_order_methods_in_the_paper_figures(method: str) -> None:
    """Unscented and linear may be wrong about Figures 4 and 7 (that is their point), never singular."""
    for case in (figure_4(), figure_7(), figure_7(3)):
        moved = case.move(sample_sets(method, 512, case.motion))
        assert moved.status[0] != OUT_OF_VIEW
        assert np.isfinite(moved.means).all()
        np.linalg.cholesky(moved.covariances[0])


def test_figure_4_linear_underestimates_the_uncertainty() -> None:
    """What the paper shows of the extended Kalman filter, and that `particle` and `qmc` do not."""
    case = figure_4()
    points, _ = case.reference()
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
    points, _ = case.reference()
    mean, covariance = points.mean(axis=0), np.cov(points.T)
    error = {}
    for method in ("qmc", "particle"):
        sets = sample_sets(method, 64, case.motion)
        errors = [in_deviations(case.move(sets, k).means[0] - mean, covariance) for k in range(16)]
        error[method] = np.sqrt(np.mean(np.square(errors)))
    assert error["qmc"] < error["particle"] / 3.0


@settings(max_examples=60, deadline=None)
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
        np.stack([case.mean for case in cases]), np.stack([covariance] * 4), np.stack([home.packed()] * 4),
        np.full(4, dt), destination.packed(), motion, sets, 3, 0.9,
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


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("p_detect", [0.5, 0.95])
@pytest.mark.parametrize("method", METHODS)
def test_the_two_parts_make_up_the_whole(method: str, p_detect: float, size: int) -> None:
    """Mass, mean and second moment are kept: exactly, where nothing but the split happens."""
    space = make_space(make_camera())
    motion = ConstantVelocity([0.0] * 3) if size == 6 else Static()
    mean = np.array([796.0, 300.0, 7.0, 3.0, 1.0, 0.1])[:size]
    covariance = random_covariance(np.random.default_rng(6), [8.0, 5.0, 1.0, 2.0, 2.0, 0.2][:size])
    sets = sample_sets(method, 1024, motion)
    moved = Case(mean, covariance, space, space, 0.0, motion).move(sets, 0, p_detect)
    assert moved.status[0] == PARTLY_IN_VIEW
    detected = p_detect * moved.fraction[0]
    missed = 1.0 - detected
    total = detected * moved.means[0] + missed * moved.missed_means[0]
    spread = [
        weight * (part + np.outer(center - total, center - total))
        for weight, center, part in (
            (detected, moved.means[0], moved.covariances[0]),
            (missed, moved.missed_means[0], moved.missed_covariances[0]),
        )
    ]
    samples = sets.turn(0)[:size]
    factor = np.linalg.cholesky(covariance)
    np.testing.assert_allclose(total, mean + factor @ samples.mean(axis=1), rtol=1e-10)
    expected = factor @ np.cov(samples, bias=True) @ factor.T
    assert in_deviations(sum(spread) - expected, covariance).max() < 1e-9
    # beyond the edge lies what was missed
    assert moved.means[0, 0] < mean[0] < moved.missed_means[0, 0]


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("method", METHODS)
def test_split_by_the_field_of_view(method: str, size: int) -> None:
    """Fraction, part in view and missed part (Fig. 8) against a large sample, within Monte Carlo margins."""
    case, count, p_detect = figure_7(size), 1024, 0.95
    rng = np.random.default_rng(99)
    samples = rng.standard_normal((12, REFERENCE_SAMPLES))
    points, seen = case.trip(samples)
    share = seen.mean()
    states = case.mean + samples[:size].T @ np.linalg.cholesky(case.covariance).T
    moved = case.move(sample_sets(method, count, case.motion), 0, p_detect)
    assert moved.status[0] == PARTLY_IN_VIEW
    assert abs(moved.fraction[0] - share) < 5.0 * np.sqrt(share * (1 - share) / count)
    expected_mean, expected = weighted(points, seen.astype(float))
    margin, variance_margin = monte_carlo_margins(points[seen], share * count)
    assert in_deviations(moved.means[0] - expected_mean, expected).max() < margin
    assert (np.abs(np.diag(moved.covariances[0]) / np.diag(expected) - 1.0) < variance_margin).all()
    weights = 1.0 - p_detect * seen
    expected_mean, expected = weighted(states, weights)
    effective = weights.sum() ** 2 / (weights**2).sum() * count / REFERENCE_SAMPLES
    # a Gaussian's variance has a kurtosis of 3; the missed part is a cut Gaussian, with less
    assert in_deviations(moved.missed_means[0] - expected_mean, expected).max() < 5.0 / np.sqrt(effective)
    relative = np.abs(np.diag(moved.missed_covariances[0]) / np.diag(expected) - 1.0)
    assert relative.max() < 5.0 * np.sqrt(2.0 / effective)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [3, 6])
def test_behind_the_camera_is_out_of_view(method: str, size: int) -> None:
    home = make_space(make_camera())
    behind = make_space(make_camera(center=(0.0, 0.0, 200.0)))
    facing_away = make_space(make_camera((0.0, np.pi, 0.0)))
    motion: Motion = ConstantVelocity([0.1] * 3) if size == 6 else Static()
    mean = state_in(home, [1.0, 1.0, 100.0, 0.0, 0.0, 0.0][:size])
    covariance = np.diag([1.0, 1.0, 0.1, 1.0, 1.0, 0.1])[:size, :size] ** 2
    for destination in (behind, facing_away):
        moved = Case(mean, covariance, home, destination, 0.1, motion).move(sample_sets(method, 64, motion))
        assert moved.status.tolist() == [OUT_OF_VIEW]
        assert moved.fraction.tolist() == [0.0]


def test_status_by_the_number_of_samples_in_view() -> None:
    """Below 24 of 64 samples, or an eighth of many, a component counts as out of view."""
    assert [moments.minimum_in_view(n) for n in (16, 48, 64, 192, 200, 1024)] == [8, 24, 24, 24, 25, 128]
    space, motion = make_space(make_camera()), Static()
    sets = sample_sets("qmc", 64, motion)
    normal = np.sort(sets.turn(0)[0])
    for needed, status in ((24, PARTLY_IN_VIEW), (23, OUT_OF_VIEW)):
        # the left edge of the image, at -0.5, cuts off all but the rightmost samples
        edge = 0.5 * (normal[64 - needed] + normal[63 - needed])
        case = Case(np.array([-0.5 - edge, 300.0, 5.0]), np.eye(3), space, space, 0.0, motion)
        moved = case.move(sets)
        assert moved.status[0] == status
        assert moved.fraction[0] == (needed / 64 if status == PARTLY_IN_VIEW else 0.0)


def tail_in_view(size: int, place: float) -> Case:
    """A newborn of the left camera, of whose wide depths the right camera sees one end only."""
    home, destination = converging(20.0, 0.26)
    mean = np.array([place, 300.0, 7.0, 0.0, 0.0, 0.0])[:size]
    covariance = np.diag([1.4, 1.4, 3.0, 9.0, 9.0, 1.0])[:size, :size] ** 2
    motion: Motion = ConstantVelocity([0.01] * 3, max_speed=6.0) if size == 6 else Static()
    return Case(mean, covariance, home, destination, 0.5, motion)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("place", [650.0, 700.0, 750.0])
def test_a_tail_in_view_is_found_where_it_matters(method: str, size: int, place: float) -> None:
    """Too few of 64 samples in view: out of view, unless important; then close to a large sample."""
    case, p_detect = tail_in_view(size, place), 0.95
    sets = sample_sets(method, 64, case.motion)
    assert case.move(sets, 0, p_detect).status[0] == OUT_OF_VIEW
    moved = case.move(sets, 0, p_detect, important=True)
    assert moved.status[0] == PARTLY_IN_VIEW
    samples = np.random.default_rng(99).standard_normal((12, REFERENCE_SAMPLES))
    points, seen = case.trip(samples)
    share = seen.mean()
    assert 0.01 < share < 0.375
    # the reserve's own size, its weights, and the samples that count: all in the effective number in view
    reserve, seen_there = case.trip(sets.reserve)
    weights = sets.reserve_weights * seen_there
    effective = weights.sum() ** 2 / (weights**2).sum()
    assert abs(moved.fraction[0] - share) < 5.0 * share / np.sqrt(effective)
    mean, covariance = weighted(points, seen.astype(float))
    margin, variance_margin = monte_carlo_margins(points[seen], effective)
    assert in_deviations(moved.means[0] - mean, covariance).max() < margin
    assert (np.abs(np.diag(moved.covariances[0]) / np.diag(covariance) - 1.0) < variance_margin).all()
    # exactly, against NumPy on the same weighted samples
    expected_mean, expected = weighted(reserve, weights)
    assert moved.fraction[0] == pytest.approx(weights.sum() / sets.reserve_weights.sum(), rel=1e-12)
    np.testing.assert_allclose(moved.means[0], expected_mean, rtol=1e-8)
    assert in_deviations(moved.covariances[0] - expected, expected).max() < 1e-8
    states = case.mean + sets.reserve[:size].T @ np.linalg.cholesky(case.covariance).T
    missed_mean, missed = weighted(states, sets.reserve_weights * (1.0 - p_detect * seen_there))
    np.testing.assert_allclose(moved.missed_means[0], missed_mean, rtol=1e-8, atol=1e-8)
    assert in_deviations(moved.missed_covariances[0] - missed, missed).max() < 1e-8


@pytest.mark.parametrize("size", [3, 6])
def test_importance_changes_nothing_that_is_well_in_view(size: int) -> None:
    for case in (nearly_linear(size), figure_7(size)):
        sets = sample_sets("qmc", 64, case.motion)
        one, other = case.move(sets, 0, 0.9), case.move(sets, 0, 0.9, important=True)
        assert one.status[0] != OUT_OF_VIEW
        for name in ("means", "covariances", "fraction", "status", "missed_means", "missed_covariances"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


wide = st.floats(-6.0, 4.0).map(lambda exponent: 10.0**exponent)


@settings(max_examples=250, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    size=st.sampled_from([3, 6]),
    method=st.sampled_from(METHODS),
    samples=st.sampled_from([16, 64, 256]),
    disparity=st.one_of(st.floats(-50.0, 2000.0), st.floats(-1e-3, 1e-3), st.just(0.0)),
    stds=st.tuples(*[wide] * 6),
    dt=st.one_of(st.just(0.0), st.floats(-100.0, 100.0)),
    max_speed=st.sampled_from([None, 0.1, 10.0]),
    acceleration=st.sampled_from([0.0, 1e-3, 10.0]),
    p_detect=st.sampled_from([0.5, 0.95, 1.0]),
    close=st.booleans(),
    important=st.booleans(),
)
def test_no_rank_deficient_covariance_leaves(
    seed: int,
    size: int,
    method: str,
    samples: int,
    disparity: float,
    stds: tuple[float, ...],
    dt: float,
    max_speed: float | None,
    acceleration: float,
    p_detect: float,
    close: bool,
    important: bool,
) -> None:
    rng = np.random.default_rng(seed)
    spread = 0.05 if close else 1.5
    home = make_space(make_camera(rng.uniform(-spread, spread, 3), rng.uniform(-30, 30, 3)))
    destination = make_space(make_camera(rng.uniform(-spread, spread, 3), rng.uniform(-30, 30, 3)))
    mean = np.array([*rng.uniform(-100, 900, 2), disparity, *rng.uniform(-50, 50, 2), rng.uniform(-1, 1)])[:size]
    covariance = random_covariance(rng, stds[:size])
    motion: Motion = ConstantVelocity([acceleration] * 3, max_speed) if size == 6 else Static()
    sets = sample_sets(method, samples, motion, seed=0)
    moved = Case(mean, covariance, home, destination, dt, motion).move(sets, seed % 16, p_detect, important)
    if moved.status[0] == OUT_OF_VIEW:
        assert moved.fraction[0] == 0.0
    else:
        assert 0.0 < moved.fraction[0] <= 1.0
        assert np.isfinite(moved.means).all()
        np.linalg.cholesky(moved.covariances[0])
    if moved.status[0] == PARTLY_IN_VIEW:
        assert np.isfinite(moved.missed_means).all()
        np.linalg.cholesky(moved.missed_covariances[0])
    world, world_covariance = world_moments(
        mean[None], covariance[None], home.packed()[None], np.array([dt]), motion, sets, 0
    )
    if np.isfinite(world).all():
        assert np.isfinite(world_covariance).all()
        np.linalg.cholesky(world_covariance[0, :size, :size])
    else:
        assert np.isnan(world).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [3, 6])
def test_threads_do_not_change_a_bit(method: str, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moments, "TRIPS_PER_THREAD", 500)
    rng = np.random.default_rng(8)
    home, destination = converging(20.0, 0.26)
    motion: Motion = ConstantVelocity([0.1] * 3, 6.0) if size == 6 else Static()
    sets = sample_sets(method, 64, motion)
    count = 101
    world = np.column_stack(
        [rng.uniform(-60, 60, (count, 2)), rng.uniform(60, 300, count), rng.normal(0, 2, (count, 3))]
    )
    means = home.from_world(world[:, :size])
    covariances = np.stack([random_covariance(rng, [6.0, 6.0, 0.5, 9.0, 9.0, 0.2][:size]) for _ in range(count)])
    arguments = (
        means,
        covariances,
        np.tile(home.packed(), (count, 1)),
        rng.uniform(-1, 1, count),
        destination.packed(),
    )
    parts = moments._slices(count, 64, 3)
    assert len(parts) == 3  # the threads are really used
    assert [k for part in parts for k in range(count)[part]] == list(range(count))
    results = [move(*arguments, motion, sets, 5, 0.95, threads=threads) for threads in (1, 2, 3)]
    assert set(results[0].status) == {OUT_OF_VIEW, PARTLY_IN_VIEW, IN_VIEW}
    for other in results[1:]:
        for name in ("means", "covariances", "fraction", "status", "missed_means", "missed_covariances"):
            np.testing.assert_array_equal(getattr(results[0], name), getattr(other, name))


@pytest.mark.parametrize("method", METHODS)
def test_components_do_not_influence_one_another(method: str) -> None:
    cases = [nearly_linear(), figure_7()]
    home, destination = cases[0].home, cases[0].destination
    motion = ConstantVelocity([0.1] * 3)
    sets = sample_sets(method, 64, motion)
    means = np.stack([case.mean for case in cases] + [state_in(home, [90.0, 0.0, 60.0, 0.0, 0.0, 0.0])])
    covariances = np.stack([case.covariance for case in (*cases, cases[0])])
    homes, dts = np.stack([home.packed()] * 3), np.array([0.5, 1.0, 0.2])
    together = move(means, covariances, homes, dts, destination.packed(), motion, sets, 2, 0.95)
    for k in range(3):
        part = slice(k, k + 1)
        alone = move(
            means[part], covariances[part], homes[part], dts[part], destination.packed(), motion, sets, 2, 0.95
        )
        assert together.status[k] == alone.status[0]
        assert together.fraction[k] == alone.fraction[0]
        if alone.status[0] != OUT_OF_VIEW:
            np.testing.assert_array_equal(together.means[k], alone.means[0])
            np.testing.assert_array_equal(together.covariances[k], alone.covariances[0])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [3, 6])
def test_no_components(method: str, size: int) -> None:
    motion: Motion = ConstantVelocity([0.1] * 3) if size == 6 else Static()
    space = make_space(make_camera())
    sets = sample_sets(method, 64, motion)
    empty = np.empty((0, size)), np.empty((0, size, size)), np.empty((0, 30)), np.empty(0)
    assert move(*empty, space.packed(), motion, sets, 0).means.shape == (0, size)
    means, covariances = world_moments(*empty, motion, sets, 0)
    assert means.shape == (0, 6)
    assert covariances.shape == (0, 6, 6)


@pytest.mark.parametrize("method", ["qmc", "particle"])
@pytest.mark.parametrize(("rectification", "dt"), [("horizontal", 0.0), ("vertical", 2.0), ("horizontal", -1.0)])
def test_world_moments_against_sampling(method: str, rectification: str, dt: float) -> None:
    """Also with samples at and beyond infinity, which are left out by the stated rule."""
    space = make_space(make_camera((0.2, -0.3, 0.1), (5.0, 6.0, 7.0)), 1.0, rectification)
    motion = ConstantVelocity([0.5, 0.1, 0.3], max_speed=8.0)
    sets = sample_sets(method, 4096, motion)
    for std in (0.3, 4.0):
        mean = state_in(space, [*space.camera.pose.to_world([[3.0, -2.0, 120.0]])[0].tolist(), 1.0, 2.0, -1.0])
        covariance = random_covariance(np.random.default_rng(10), [2.0, 2.0, std, 4.0, 4.0, 0.2])
        samples = np.random.default_rng(11).standard_normal((12, REFERENCE_SAMPLES))
        disparity = mean[2] + samples[:6].T @ np.linalg.cholesky(covariance)[2]
        kept = disparity >= mean[2] / 10.0
        assert kept.all() == (std == 0.3)
        world = oracle_world(mean, covariance, samples, space, dt, motion)[kept]
        found_mean, found = world_moments(
            mean[None], covariance[None], space.packed()[None], np.array([dt]), motion, sets, 0
        )
        margin, variance_margin = monte_carlo_margins(world, 4096 * kept.mean())
        expected = np.cov(world.T)
        assert in_deviations(found_mean[0] - world.mean(axis=0), expected).max() < margin
        assert (np.abs(np.diag(found[0]) / np.diag(expected) - 1.0) < variance_margin).all()
        error = in_deviations(found[0] - expected, expected)
        assert (error < np.sqrt(np.outer(variance_margin, variance_margin))).all()


def test_world_moments_of_the_same_samples() -> None:
    space = make_space(make_camera((0.2, -0.3, 0.1), (5.0, 6.0, 7.0)), 0.5, "vertical")
    motion = ConstantVelocity([0.5, 0.1, 0.3], max_speed=3.0)
    sets = sample_sets("qmc", 64, motion)
    mean = state_in(space, [*space.camera.pose.to_world([[3.0, -2.0, 120.0]])[0].tolist(), 1.0, 2.0, -1.0])
    covariance = random_covariance(np.random.default_rng(10), [2.0, 2.0, 0.3, 4.0, 4.0, 0.2])
    for dt in (0.0, 1.5, -0.5):
        world = oracle_world(mean, covariance, sets.turn(7), space, dt, motion)
        found_mean, found = world_moments(
            mean[None], covariance[None], space.packed()[None], np.array([dt]), motion, sets, 7
        )
        expected_mean, expected = weighted(world, np.ones(64))
        np.testing.assert_allclose(found_mean[0], expected_mean, rtol=1e-9)
        assert in_deviations(found[0] - expected, expected).max() < 1e-9


def test_world_moments_of_static_objects() -> None:
    space, motion = make_space(make_camera((0.2, -0.3, 0.1), (5.0, 6.0, 7.0))), Static()
    sets = sample_sets("qmc", 256, motion)
    mean, covariance = np.array([300.0, 200.0, 8.0]), np.diag([2.0, 2.0, 0.5]) ** 2
    found_mean, found = world_moments(
        mean[None], covariance[None], space.packed()[None], np.array([3.0]), motion, sets, 0
    )
    world = space.to_world(mean + sets.turn(0).T * [2.0, 2.0, 0.5])
    np.testing.assert_allclose(found_mean[0, :3], world.mean(axis=0), rtol=1e-10)
    np.testing.assert_allclose(found[0, :3, :3], np.cov(world.T, bias=True), rtol=1e-9, atol=1e-9)
    assert not found_mean[0, 3:].any()
    assert not found[0, 3:].any()
    assert not found[0, :, 3:].any()


@pytest.mark.parametrize("disparity", [0.0, -1.0])
def test_objects_at_infinity_have_no_place(disparity: float) -> None:
    space, motion = make_space(make_camera()), ConstantVelocity([0.1] * 3)
    mean = np.array([[400.0, 300.0, disparity, 0.0, 0.0, 0.0], [400.0, 300.0, 5.0, 0.0, 0.0, 0.0]])
    found_mean, found = world_moments(
        mean, np.stack([np.eye(6)] * 2), np.stack([space.packed()] * 2), np.zeros(2), motion,
        sample_sets("qmc", 64, motion), 0,
    )  # fmt: skip
    assert np.isnan(found_mean[0]).all()
    assert np.isnan(found[0]).all()
    assert np.isfinite(found_mean[1]).all()
