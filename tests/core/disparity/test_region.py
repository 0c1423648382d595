"""The region where objects can be (a box, a range of depth), and corners of the view."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from stereophd.config.tracking import RegionConfig
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, Moved
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.disparity.trips import REGION_SLACK, region_mask
from stereophd.core.geometry.region import are_inside, box_half_spaces, half_spaces, pack_region
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.numerics.samples import RESERVE_SAMPLES, RESERVE_WIDTH, draw_sample_sets
from tests.core.disparity.cases import (
    converging,
    in_deviations,
    make_camera,
    make_space,
    oracle_world,
    state_in,
    weighted,
)
from tests.core.disparity.moves import METHODS, Case, figure_7, nearly_linear, sample_sets

EVERYWHERE = np.array([-np.inf, np.inf])


def box(depth: tuple[float, float] = (-np.inf, np.inf), **limits: tuple[float, float]) -> np.ndarray:
    """A packed region: depth before the home camera, and x, y, z in the world; infinite where not given."""
    return pack_region(depth, box_half_spaces(limits))


def inside(world: np.ndarray, home: DisparitySpace, region: np.ndarray) -> np.ndarray:
    """Which world points (n, 3), of samples in front of their home camera, are in the region."""
    depth = (world - home.camera.pose.center) @ home.camera.pose.rotation[2]
    return are_inside(world, half_spaces(region)) & (depth >= region[0]) & (depth <= region[1])


def run(
    case: Case, region: np.ndarray | None, samples: int = 1024, important: bool = False, **options: object
) -> Moved:
    sets = sample_sets(str(options.get("method", "qmc")), samples, case.motion)
    return move(
        case.sources, case.destination.packed(), sets, 0, float(options.get("p_detect", 0.9)),
        np.array([important]), 1, region,
    )  # fmt: skip


def test_packed_region_of_a_configuration() -> None:
    np.testing.assert_array_equal(RegionConfig(depth=(3.0, 200.0)).packed(), box(depth=(3.0, 200.0)))
    both = RegionConfig.model_validate({"box": {"x": [-1, 1], "y": [-2, 2], "z": [0, 5]}, "depth": [1, 9]})
    np.testing.assert_array_equal(both.packed(), box(depth=(1, 9), x=(-1, 1), y=(-2, 2), z=(0, 5)))


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([1.0, 10.0, 60.0]), size=st.sampled_from([4, 7]))
def test_region_mask(seed: int, spread: float, size: int) -> None:
    """Against NumPy: share, the weights outside, and the slack."""
    rng = np.random.default_rng(seed)
    home = make_space(make_camera(rng.uniform(-0.5, 0.5, 3), rng.uniform(-30.0, 30.0, 3)))
    destination = make_space(
        make_camera(rng.uniform(-3.0, 3.0, 3), rng.uniform(-30.0, 30.0, 3)), 0.3, rng.choice(["horizontal", "vertical"])
    )
    count = 200
    world = [1.0, 2.0, 110.0] + spread * rng.standard_normal((count, 3))
    at_home = home.from_world(world)
    points = np.zeros((size, count))
    points[:3] = destination.from_world(world).T
    z_b = destination.camera.pose.to_camera(world)[:, 2]
    z_a = home.camera.pose.to_camera(world)[:, 2]
    points[-1] = z_b / z_a  # rho times the depth before the destination: negative behind it
    limits = np.sort(rng.normal([1.0, 2.0, 110.0], 1.5 * spread, (2, 3)), axis=0)
    depth = np.sort(np.abs(rng.normal(110.0, 2.0 * spread, 2)))
    region = box(depth=tuple(depth), **{axis: tuple(pair) for axis, pair in zip("xyz", limits.T, strict=True)})
    sample_weights, weights = rng.uniform(0.1, 2.0, count), np.empty(count)
    share = region_mask(points, destination.packed(), home.packed(), region, REGION_SLACK, sample_weights, weights)
    good = inside(world, home, region) & (at_home[:, 2] > 0.0)
    expected = sample_weights @ good / sample_weights.sum()
    if expected >= REGION_SLACK:
        assert share == 1.0
        np.testing.assert_array_equal(weights, sample_weights)
    else:
        assert share == pytest.approx(expected, rel=1e-12)
        np.testing.assert_array_equal(weights, np.where(good, sample_weights, 0.0))


def test_beyond_infinity_is_in_no_region() -> None:
    """Samples of a far object with d <= 0 are nowhere: not even in a region without limits."""
    space = make_space(make_camera())
    case = Case(np.array([400.0, 300.0, 0.3]), np.diag([1.0, 1.0, 1.0]), space, space, 0.0, Static())
    moved = run(case, EVERYWHERE, 4096)
    assert moved.inside[0] == pytest.approx(ndtr(0.3), abs=5.0 * 0.5 / 64.0)
    # the mean of what is left is that of a Gaussian cut at 0
    hazard = np.exp(-0.5 * 0.3**2) / np.sqrt(2.0 * np.pi) / ndtr(0.3)
    assert moved.means[0, 2] == pytest.approx(0.3 + hazard, abs=0.02)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("method", ["qmc", "particle"])
def test_the_component_is_cut_at_the_region(method: str, size: int) -> None:
    """A component half in the box and wholly in view: share and moments are those of the samples inside."""
    case = nearly_linear(size)
    sets = sample_sets(method, 1024, case.motion)
    world = oracle_world(case.mean, case.covariance, sets.turn(0), case.home, case.dt, case.motion)
    region = box(z=(float(np.median(world[:, 2])), np.inf))
    moved = run(case, region, method=method)
    weights = inside(world[:, :3], case.home, region).astype(float)
    assert moved.status[0] == IN_VIEW
    assert moved.fraction[0] == 1.0
    assert moved.inside[0] == pytest.approx(weights.mean(), rel=1e-12)
    mean, covariance = weighted(case.destination.from_world(world), weights)
    assert in_deviations(moved.means[0] - mean, case.covariance).max() < 1e-9
    assert in_deviations(moved.covariances[0] - covariance, case.covariance).max() < 1e-9
    # farther than before
    free = run(case, None, method=method)
    assert moved.means[0, 2] < free.means[0, 2]
    assert moved.covariances[0, 2, 2] < free.covariances[0, 2, 2]


@pytest.mark.parametrize("share", [0.9, 0.81, 0.79, 0.5, 0.2])
def test_slack(share: float) -> None:
    """A component with a tail outside is left alone; with more than a fifth outside it is cut."""
    space = make_space(make_camera())
    d = 5.0 - 0.2 * ndtri(share)
    near = space.disparity_focal / 1e9, space.disparity_focal / d
    case = Case(np.array([400.0, 300.0, 5.0]), np.diag([1.0, 1.0, 0.04]), space, space, 0.0, Static())
    free, moved = run(case, None, 4096), run(case, box(depth=near), 4096)
    if share > REGION_SLACK:
        assert moved.inside[0] == 1.0
        np.testing.assert_array_equal(moved.means, free.means)
        np.testing.assert_array_equal(moved.covariances, free.covariances)
    else:
        # a low-discrepancy set of 4096: well within the error of as many random samples
        assert moved.inside[0] == pytest.approx(share, abs=3.0 * np.sqrt(share * (1.0 - share) / 4096))
        assert moved.means[0, 2] > d


@pytest.mark.parametrize("method", METHODS)
def test_depth_is_before_the_home_camera(method: str) -> None:
    """By the depth before the camera that saw the object last, not before the one it is carried to."""
    home, destination = make_space(make_camera()), make_space(make_camera(center=(0.0, 0.0, -50.0)))
    mean = state_in(home, [0.0, 0.0, 100.0])
    case = Case(mean, np.diag([1.0, 1.0, 0.01]), home, destination, 0.0, Static())
    assert run(case, box(depth=(90.0, 110.0)), method=method).inside[0] == 1.0
    gone = run(case, box(depth=(140.0, 160.0)), method=method)
    assert gone.inside[0] == 0.0
    assert gone.status[0] == OUT_OF_VIEW
    assert gone.fraction[0] == 0.0


@pytest.mark.parametrize(
    ("method", "share"),
    [(method, share) for method in METHODS for share in (0.3, 0.5, 0.7)],
)
def test_every_method_knows_the_region(method: str, share: float) -> None:
    """The share inside is that of the Gaussian whatever carries it over (points of a rule are no share)."""
    home, destination = converging(20.0, 0.26)
    mean = state_in(home, [0.0, 0.0, 110.0])
    std = 0.3
    d = float(mean[2] - std * ndtri(share))
    case = Case(mean, np.diag([1.0, 1.0, std**2]), home, destination, 0.0, Static())
    moved = run(case, box(depth=(0.0, home.disparity_focal / d)), 1024, method=method)
    margin = 5.0 * np.sqrt(share * (1.0 - share) / 1024)
    assert moved.inside[0] == pytest.approx(share, abs=margin)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("where", ["behind", "beside"])
def test_components_that_the_camera_does_not_see(where: str, size: int) -> None:
    """Behind the camera or beside its view: kept where the region reaches, and cut where it does not."""
    home = make_space(make_camera())
    destination = make_space(make_camera((0.0, np.pi, 0.0)) if where == "behind" else make_camera((0.0, 1.4, 0.0)))
    motion = ConstantVelocity([0.01] * 3) if size == 6 else Static()
    mean = state_in(home, [0.0, 0.0, 100.0, 1.0, 0.0, 0.0][:size])
    covariance = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.1])[:size, :size] ** 2
    case = Case(mean, covariance, home, destination, 0.0, motion)
    whole = run(case, box(x=(-20, 20), y=(-20, 20), z=(50, 300)))
    assert (whole.status[0], whole.fraction[0], whole.inside[0]) == (OUT_OF_VIEW, 0.0, 1.0)
    region = box(z=(-np.inf, 100.0))
    cut = run(case, region)
    sets = sample_sets("qmc", 1024, motion)
    world = oracle_world(mean, covariance, sets.turn(0), home, 0.0, motion)
    weights = inside(world[:, :3], home, region).astype(float)
    assert (cut.status[0], cut.fraction[0]) == (OUT_OF_VIEW, 0.0)
    assert cut.inside[0] == pytest.approx(weights.mean(), rel=1e-12)
    assert 0.4 < cut.inside[0] < 0.6
    states = mean + sets.turn(0)[:size].T @ np.linalg.cholesky(covariance).T
    expected_mean, expected = weighted(states, weights)
    assert in_deviations(cut.missed_means[0] - expected_mean, covariance).max() < 1e-9
    assert in_deviations(cut.missed_covariances[0] - expected, covariance).max() < 1e-9


def test_region_and_view_together() -> None:
    """A component cut by both: the fraction in view is of what is inside the region, and so is the missed part."""
    case, p_detect = figure_7(), 0.9
    sets = sample_sets("qmc", 1024, case.motion)
    world = oracle_world(case.mean, case.covariance, sets.turn(0), case.home, case.dt, case.motion)
    region = box(depth=(0.0, 300.0))
    good = inside(world[:, :3], case.home, region) & (world[:, 2] > -1e9)
    good &= (case.mean + sets.turn(0)[:6].T @ np.linalg.cholesky(case.covariance).T)[:, 2] > 0.0
    seen = case.destination.camera.in_view(world[:, :3]) & good
    moved = run(case, region, p_detect=p_detect)
    assert moved.status[0] == PARTLY_IN_VIEW
    assert 0.1 < moved.inside[0] < REGION_SLACK
    assert moved.inside[0] == pytest.approx(good.mean(), rel=1e-12)
    assert moved.fraction[0] == pytest.approx(seen.sum() / good.sum(), rel=1e-12)
    mean, covariance = weighted(case.destination.from_world(world), seen.astype(float))
    assert in_deviations(moved.means[0] - mean, covariance).max() < 1e-8
    assert in_deviations(moved.covariances[0] - covariance, covariance).max() < 1e-8
    states = case.mean + sets.turn(0)[:6].T @ np.linalg.cholesky(case.covariance).T
    mean, covariance = weighted(states, good * (1.0 - p_detect * seen))
    assert in_deviations(moved.missed_means[0] - mean, covariance).max() < 1e-8
    assert in_deviations(moved.missed_covariances[0] - covariance, covariance).max() < 1e-8


@settings(max_examples=150)
@given(
    seed=st.integers(0, 2**32 - 1), method=st.sampled_from(METHODS), size=st.sampled_from([3, 6]),
    near=st.floats(0.0, 200.0), width=st.floats(0.0, 200.0), important=st.booleans(), disparity=st.floats(-5.0, 40.0),
    std=st.floats(1e-3, 30.0),
)  # fmt: skip
def test_any_region_leaves_full_rank(
    seed: int, method: str, size: int, near: float, width: float, important: bool, disparity: float, std: float
) -> None:
    rng = np.random.default_rng(seed)
    home = make_space(make_camera(rng.uniform(-0.6, 0.6, 3), rng.uniform(-30.0, 30.0, 3)))
    destination = make_space(make_camera(rng.uniform(-0.6, 0.6, 3), rng.uniform(-30.0, 30.0, 3)))
    mean = np.array([*rng.uniform(0, 800, 2), disparity, *rng.uniform(-5, 5, 3)])[:size]
    covariance = np.diag([2.0, 2.0, std, 3.0, 3.0, 0.5])[:size, :size] ** 2
    motion = ConstantVelocity([0.1] * 3, 10.0) if size == 6 else Static()
    case = Case(mean, covariance, home, destination, float(rng.uniform(0, 2)), motion)
    moved = run(case, box(depth=(near, near + width), x=(-40.0, 40.0)), 64, important, method=method)
    assert 0.0 <= moved.inside[0] <= 1.0
    assert 0.0 <= moved.fraction[0] <= 1.0
    if moved.status[0] != OUT_OF_VIEW:
        assert np.isfinite(moved.means).all()
        np.linalg.cholesky(moved.covariances[0])
    cut = moved.status[0] == OUT_OF_VIEW and 0.0 < moved.inside[0] < 1.0
    if moved.status[0] == PARTLY_IN_VIEW or cut:
        assert np.isfinite(moved.missed_means).all()
        np.linalg.cholesky(moved.missed_covariances[0])


def corner(share: float, side: int) -> Case:
    """An object of wide disparity of which exactly this share is in view of a camera beside the first.

    Between parallel cameras u moves by d times the distance in baselines, so the edge of the image is a value of
    d; its own spread along u is kept small against that.
    """
    home = make_space(make_camera())
    destination = make_space(make_camera(center=(side * 20.0, 0.0, 0.0)))
    mean, std = 10.0, 3.0
    # to the right camera (side 1) points move left by 20 d: in view while u - 20 d >= -0.5
    edge = mean - std * ndtri(1.0 - share)
    u = -0.5 + 20.0 * edge if side > 0 else 799.5 - 20.0 * edge
    return Case(np.array([u, 300.0, mean]), np.diag([0.1, 1.0, std]) ** 2, home, destination, 0.0, Static())


# Of 3 % an error of 0.03 standard deviations; that of a reserve is 0.08 to 0.1, of which the test allows five.
TAIL_SAMPLES = 40_000


@cache
def tail_of(share: float, side: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Share in view, mean and covariance there of a large sample: one for all methods."""
    points, seen = corner(share, side).trip(np.random.default_rng(4).standard_normal((3, TAIL_SAMPLES)))
    return seen.mean(), *weighted(points, seen.astype(float))


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("share", [0.03, 0.06, 0.12])
@pytest.mark.parametrize("method", METHODS)
def test_a_corner_of_the_view(method: str, share: float, side: int) -> None:
    """3 % in view: nothing for 64 samples, found by the reserve, with the moments of a Gaussian's tail."""
    case = corner(share, side)
    assert run(case, None, 64, method=method).status[0] == OUT_OF_VIEW
    moved = run(case, None, 64, True, method=method)
    assert moved.status[0] == PARTLY_IN_VIEW
    sets = sample_sets(method, 64, case.motion)
    _, seen = case.trip(sets.reserve)
    weights = sets.reserve_weights * seen
    effective = weights.sum() ** 2 / (weights**2).sum()
    # the point of the wide reserve: more effective samples than 1024 plain ones have there
    assert effective > 1.2 * share * RESERVE_SAMPLES
    seen_share, tail, spread = tail_of(share, side)
    assert seen_share == pytest.approx(share, abs=5.0 * np.sqrt(share / TAIL_SAMPLES))
    assert moved.fraction[0] == pytest.approx(share, rel=5.0 / np.sqrt(effective))
    assert in_deviations(moved.means[0] - tail, spread).max() < 5.0 / np.sqrt(effective)
    # by hand: the mean of a standard normal beyond a point is its density there over the tail's mass
    edge = ndtri(1.0 - share)
    hazard = np.exp(-0.5 * edge**2) / np.sqrt(2.0 * np.pi) / share
    assert moved.means[0, 2] == pytest.approx(10.0 - 3.0 * hazard, abs=5.0 * np.sqrt(spread[2, 2] / effective))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("rows", [3, 12])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_reserve_is_a_proper_importance_sample(method: str, rows: int, seed: int) -> None:
    """Mean weight 1; moments up to the fourth and the tails of the widened coordinate, in five standard errors."""
    sets = draw_sample_sets(method, 64, rows, np.random.SeedSequence(seed))  # type: ignore[arg-type]
    points, weights = sets.reserve, sets.reserve_weights
    assert weights.mean() == pytest.approx(1.0, rel=1e-12)
    assert weights.max() < 1.2 * RESERVE_WIDTH  # the ratio of the densities is largest at 0, where it is the width
    z = points[2]
    quantities = [z, z**2 - 1.0, z**3, z**4 - 3.0, z * points[0], points[1] ** 2 - 1.0]
    quantities += [(z > limit) - ndtr(-limit) for limit in (-1.0, 0.0, 1.0, 1.9, 2.5)]
    for values in quantities:
        error = np.sqrt(((weights * values) ** 2).mean() / len(z))
        assert abs((weights * values).mean()) < 5.0 * error
    # on either side beyond 1.9: 17 % of the samples, for 3 % of the mass
    for side in (z > 1.9, z < -1.9):
        assert side.mean() == pytest.approx(ndtr(-1.9 / RESERVE_WIDTH), abs=5.0 * np.sqrt(0.17 * 0.83 / len(z)))


def test_bins_of_the_reserve_along_the_disparity() -> None:
    """The weighted distribution is the standard normal's, bin by bin."""
    sets = draw_sample_sets("qmc", 64, 12, np.random.SeedSequence(4))
    for low, high in pairwise(np.linspace(-3.0, 3.0, 13)):
        share = ((sets.reserve[2] > low) & (sets.reserve[2] <= high)) @ sets.reserve_weights / RESERVE_SAMPLES
        expected = ndtr(high) - ndtr(low)
        density = np.exp(-0.5 * min(low**2, high**2, (low * high > 0) * 9.0) * 0.75) * RESERVE_WIDTH
        assert share == pytest.approx(expected, abs=5.0 * np.sqrt(expected * density / RESERVE_SAMPLES))
