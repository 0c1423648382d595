"""Scoring of whole runs: the batched code against the one-scan functions, and the figures over pairs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.errors import (
    error_percentiles,
    independent_count,
    nees,
    nees_interval,
    root_mean_square,
    root_mean_square_per_group,
)
from stereophd.core.metrics.identities import identity_switches
from stereophd.core.metrics.matching import near_pairs as pairs_module
from stereophd.core.metrics.scans import PointSets


def random_sets(random: np.random.Generator, scans: int, most: int, covariance: bool = False) -> PointSets:
    counts = random.integers(0, most + 1, scans)
    total = int(counts.sum())
    factor = random.normal(size=(total, 3, 3))
    return PointSets(
        np.concatenate([[0], np.cumsum(counts)]),
        random.normal(0, 8, (total, 3)),
        random.normal(0, 1, (total, 3)),
        random.integers(0, 9, total),
        factor @ factor.transpose(0, 2, 1) + np.eye(3) if covariance else None,
    )


@pytest.mark.parametrize("mahalanobis", [False, True])
@pytest.mark.parametrize("entries", [1, 40, 100_000])
def test_batches_give_what_single_scans_give(mahalanobis, entries, monkeypatch):
    monkeypatch.setattr(pairs_module, "PAIRS_AT_ONCE", entries)
    random = np.random.default_rng(11)
    estimates, truth = random_sets(random, 80, 5, covariance=True), random_sets(random, 80, 4)
    order, cutoff = 2.0, 6.0
    scores = score_scans(estimates, truth, order, cutoff, mahalanobis=mahalanobis)
    for scan in range(80):
        rows, others = (slice(*sets.start[scan : scan + 2]) for sets in (estimates, truth))
        apart = estimates.position[rows][:, None] - truth.position[others]
        m, n = apart.shape[:2]
        weights = np.linalg.inv(estimates.covariance[rows]) if mahalanobis else np.broadcast_to(np.eye(3), (m, 3, 3))
        costs = np.minimum(np.sqrt(np.einsum("ijk,ikl,ijl->ij", apart, weights, apart)), cutoff) ** order
        pairs = costs[linear_sum_assignment(costs)]
        located, near = pairs.sum() / max(m, n, 1), pairs < cutoff**order
        assert scores.ospa.localisation[scan] == pytest.approx(located ** (1 / order), abs=1e-9)
        absent = cutoff**order * abs(m - n) / max(m, n, 1)
        assert scores.ospa.distance[scan] == pytest.approx((located + absent) ** (1 / order), abs=1e-9)
        # GOSPA charges a missed and a false point half the cutoff each
        whole = pairs[near].sum() + cutoff**order * (m + n - 2 * near.sum()) / 2
        assert scores.gospa.distance[scan] == pytest.approx(whole ** (1 / order), abs=1e-9)
        assert scores.n_matched[scan] == near.sum() == (scores.pairs.scan == scan).sum()
    assert (np.diff(scores.pairs.scan) >= 0).all()
    assert (estimates.scan[scores.pairs.estimate] == scores.pairs.scan).all()
    assert (truth.scan[scores.pairs.truth] == scores.pairs.scan).all()
    if not mahalanobis:
        errors = estimates.position[scores.pairs.estimate] - truth.position[scores.pairs.truth]
        assert (np.linalg.norm(errors, axis=1) < cutoff).all()


def test_points_and_scans_can_be_left_out():
    sets = random_sets(np.random.default_rng(2), 30, 4)
    keep = sets.label > 3
    fewer = sets.keep_points(keep)
    assert fewer.scans == 30
    assert (fewer.label > 3).all()
    assert (fewer.counts == np.bincount(sets.scan[keep], minlength=30)).all()
    some = sets.keep_scans(sets.counts == 2)
    assert (some.counts == 2).all()
    assert (some.label == sets.label[np.isin(sets.scan, np.flatnonzero(sets.counts == 2))]).all()


def test_no_scans():
    nothing = random_sets(np.random.default_rng(0), 0, 3)
    scores = score_scans(nothing, nothing, 2.0, 20.0)
    assert len(scores.ospa.distance) == len(scores.pairs.scan) == 0


def test_root_mean_square_and_groups():
    errors = np.array([[3.0, 4, 0], [0, 0, 1], [np.nan, 0, 0]])
    assert root_mean_square(errors) == pytest.approx(np.sqrt(26 / 2))
    by_group = root_mean_square_per_group(errors, np.array([0, 2, 1]), 4)
    assert by_group[[0, 2]] == pytest.approx([5.0, 1.0])
    assert np.isnan(by_group[[1, 3]]).all()
    assert np.isnan(root_mean_square(np.zeros((0, 3))))


def test_percentiles():
    errors = np.zeros((11, 3))
    errors[:, 1] = -np.arange(11.0)
    found = error_percentiles(errors)
    assert found == {"median": 5.0, "p90": 9.0, "n": 11}
    assert np.isnan(error_percentiles(errors[:0])["median"])


def test_nees_of_a_consistent_filter_lies_in_its_interval():
    random = np.random.default_rng(8)
    factor = random.normal(size=(3, 3))
    covariance = factor @ factor.T
    errors = random.multivariate_normal(np.zeros(3), covariance, 4000)
    values = nees(errors, np.tile(covariance, (4000, 1, 1)))
    assert values[0] == pytest.approx(errors[0] @ np.linalg.solve(covariance, errors[0]))
    low, high = nees_interval(4000, 3)
    # Four standard deviations of the mean, sqrt(2 d / n) each: a correct code fails once in 16,000 seeds.
    assert abs(values.mean() - 3.0) < 4 * np.sqrt(6 / 4000)
    assert 3.0 - low == pytest.approx(1.96 * np.sqrt(6 / 4000), rel=0.05)
    assert high - 3.0 == pytest.approx(1.96 * np.sqrt(6 / 4000), rel=0.05)
    overconfident = nees(errors, np.tile(covariance / 2, (4000, 1, 1)))
    assert overconfident.mean() > high


def test_nees_interval_is_the_chi_square_one():
    from scipy.stats import chi2

    for count in (1, 7, 100, 1_000_000):
        expected = chi2.ppf([0.025, 0.975], 3 * count) / count
        assert nees_interval(count, 3) == pytest.approx(tuple(expected), rel=1e-9)
    assert np.isnan(nees_interval(0, 3)).all()


def alike(random, objects, steps, correlation):
    """Errors (n, 3) of unit covariance, of each object a first-order autoregression, and their objects."""
    errors = random.normal(size=(objects, steps, 3))
    for step in range(1, steps):
        errors[:, step] = correlation * errors[:, step - 1] + np.sqrt(1 - correlation**2) * errors[:, step]
    return errors.reshape(-1, 3), np.repeat(np.arange(objects), steps)


@pytest.mark.parametrize(("correlation", "least"), [(0.0, 0.7), (0.5, 0.7), (0.9, 0.5)])
def test_errors_that_are_alike_count_less(correlation, least):
    # exact: d n^2 / sum of d r^(2 lag), for many steps n (1 - r^2) / (1 + r^2)
    exact = 3000 * (1 - correlation**2) / (1 + correlation**2)
    counts = [independent_count(*alike(np.random.default_rng(seed), 6, 500, correlation)) for seed in range(20)]
    assert least * exact < min(counts)
    assert max(counts) < 1.3 * exact
    assert max(counts) <= 3000


@pytest.mark.parametrize("correlation", [0.0, 0.9, 0.99])
def test_interval_holds_the_mean_nees_of_errors_that_are_alike(correlation):
    inside = 0
    for seed in range(200):
        errors, group = alike(np.random.default_rng(seed), 6, 200, correlation)
        low, high = nees_interval(independent_count(errors, group), 3)
        inside += low <= (errors**2).sum(axis=1).mean() <= high
    # 95 % and four standard errors of 200 runs; 0.99: a hundred steps are alike, so two to an object, seven in all
    assert inside >= 200 * (0.95 - 4 * np.sqrt(0.95 * 0.05 / 200))


def test_order_of_objects_does_not_matter_and_scale_neither():
    random = np.random.default_rng(3)
    errors, group = alike(random, 4, 50, 0.8)
    mixed = np.argsort(np.tile(np.arange(50), 4), kind="stable")
    assert independent_count(errors[mixed], group[mixed]) == pytest.approx(independent_count(errors, group))
    assert independent_count(3.0 * errors, group) == pytest.approx(independent_count(errors, group))
    assert independent_count(errors[:1], group[:1]) == 1.0
    assert independent_count(errors[:0], group[:0]) == 0.0


def test_nees_of_a_bad_covariance_is_nan():
    covariance = np.stack([np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan), -np.eye(3)])
    values = nees(np.ones((4, 3)), covariance)
    assert values[0] == pytest.approx(3.0)
    assert np.isnan(values[1:]).all()


def test_identity_switches():
    #            object 1: 5 5 - 6 (switch) ; object 2: 6 7 (switch) 7 ; unlabelled never counts
    scan = np.array([0, 0, 1, 1, 2, 3, 3])
    object_id = np.array([1, 2, 1, 2, 2, 1, 2])
    track_id = np.array([5, 6, 5, 7, -1, 6, 7])
    assert identity_switches(scan, object_id, track_id).tolist() == [
        False,
        False,
        False,
        True,
        False,
        True,
        False,
    ]
    assert not identity_switches(scan[:0], object_id[:0], track_id[:0]).any()


def test_nees_of_covariances_that_are_all_but_singular():
    # particles that almost all sit in one place: some of these matrices have positive minors and no Cholesky factor
    v, w = np.random.default_rng(0).standard_normal((2, 5000, 3))
    covariance = np.einsum("ni,nj->nij", v, v)
    covariance[2000:] += 1e-17 * np.einsum("ni,nj->nij", w[2000:], w[2000:])
    covariance[::3] += np.eye(3)
    covariance[1] = np.nan
    found = nees(v, covariance)
    assert np.isnan(found[1])
    expected = np.einsum("ni,nij,nj->n", v[::3], np.linalg.inv(covariance[::3]), v[::3])
    np.testing.assert_allclose(found[::3], expected, rtol=1e-9)
