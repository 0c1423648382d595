"""What holds for every move: full rank, the same bits on any number of threads, components on their own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.disparity import moments
from stereophd.core.disparity.moments import move, world_moments
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW, PARTLY_IN_VIEW, Sources
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from tests.core.disparity.cases import converging, make_camera, make_space, random_covariance, state_in
from tests.core.disparity.moves import METHODS, Case, figure_7, nearly_linear, sample_sets

wide = st.floats(-6.0, 4.0).map(lambda exponent: 10.0**exponent)


@settings(max_examples=100)
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
    intervals = motion.arrays(rng.uniform(-1, 1, count))
    arguments = (
        Sources(means, covariances, np.tile(home.packed(), (count, 1)), intervals),
        destination.packed(),
    )
    assert count * 64 // moments.TRIPS_PER_THREAD >= 3  # the threads are really used
    results = [move(*arguments, sets, 5, 0.95, threads=threads) for threads in (1, 2, 3)]
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
    together = move(Sources(means, covariances, homes, motion.arrays(dts)), destination.packed(), sets, 2, 0.95)
    for k in range(3):
        part = slice(k, k + 1)
        alone = move(
            Sources(means[part], covariances[part], homes[part], motion.arrays(dts[part])),
            destination.packed(),
            sets,
            2,
            0.95,
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
    assert move(Sources(*empty[:3], motion.arrays(empty[3])), space.packed(), sets, 0).means.shape == (0, size)
    means, covariances = world_moments(*empty, motion, sets, 0)
    assert means.shape == (0, 6)
    assert covariances.shape == (0, 6, 6)
