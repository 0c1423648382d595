"""Association marginals and evidence cluster by cluster, against the sum over all associations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.multi.association import belief
from stereophd.core.multi.association.exact_association import (
    MOST_COST,
    MOST_COST_A_PAIR,
    MOST_WIDTH,
    WEAK_LINKS,
    association_marginals,
)
from stereophd.core.multi.association.frontier import eliminate, make_plan, make_table
from tests.core.multi.association.associations import Marginals, enumerate_associations, worst

EXACT = 1e-12
seeds = st.integers(0, 2**32 - 1)
sizes = st.integers(1, 6)


def solve(odds: np.ndarray) -> Marginals:
    """The package's answer, from a matrix with 0 for "no pair"."""
    tracks, detections = np.array(np.nonzero(odds))
    pair, missed, unclaimed, log_evidence = association_marginals(
        tracks, detections, odds[tracks, detections], *odds.shape
    )
    dense = np.zeros_like(odds)
    dense[tracks, detections] = pair
    return Marginals(dense, missed, unclaimed, log_evidence)


def random_odds(seed: int, n_tracks: int, n_detections: int, low: float, high: float, filled: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = n_tracks, n_detections
    return np.asarray(10.0 ** rng.uniform(low, high, shape) * (rng.random(shape) < filled))


@settings(max_examples=100)
@given(seed=seeds, n_tracks=sizes, n_detections=sizes, filled=st.floats(0.1, 1.0), high=st.sampled_from([0, 3, 6, 12]))
def test_exact(seed: int, n_tracks: int, n_detections: int, filled: float, high: float) -> None:
    odds = random_odds(seed, n_tracks, n_detections, -3.0, high, filled)
    found, exact = solve(odds), enumerate_associations(odds)
    assert worst(found, exact) < EXACT
    assert found.log_evidence == pytest.approx(exact.log_evidence, rel=1e-12, abs=1e-12)


@settings(max_examples=100)
@given(seed=seeds, n_tracks=sizes, n_detections=sizes)
def test_small_probabilities_are_exact_to_their_own_size(seed: int, n_tracks: int, n_detections: int) -> None:
    """The probability that a nearly certain track was missed is a sum of positive terms: nothing cancels."""
    odds = random_odds(seed, n_tracks, n_detections, 4.0, 9.0, 0.7)
    found, exact = solve(odds), enumerate_associations(odds)
    several = (odds > 0).sum(axis=1) > 0
    np.testing.assert_allclose(found.missed[several], exact.missed[several], rtol=1e-6)


@pytest.mark.parametrize("width", [1, 3, 6])
def test_orders_and_orientations_agree(width: int) -> None:
    """The recursion over tracks and the one over detections solve the same problem."""
    odds = random_odds(width, 6, width, -1.0, 4.0, 0.8)
    exact = enumerate_associations(odds)
    tracks, detections = np.array(np.nonzero(odds))
    values = odds[tracks, detections]
    table, index = make_table(tracks, detections, values, 6, width)
    pair, idle, free, log_evidence = eliminate(table, make_plan(table, 12))
    np.testing.assert_allclose(pair, exact.pair[tracks[index], detections[index]], atol=EXACT)
    np.testing.assert_allclose(idle, exact.missed, atol=EXACT)
    turned, index = make_table(detections, tracks, values, width, 6)
    pair, idle, free, other = eliminate(turned, make_plan(turned, 12))
    np.testing.assert_allclose(pair, exact.pair[tracks[index], detections[index]], atol=EXACT)
    np.testing.assert_allclose(free, exact.missed, atol=EXACT)
    assert log_evidence == pytest.approx(other, rel=1e-13)


def test_where_belief_propagation_decides_it_does_not() -> None:
    """Joint odds 3:1, single odds about 1000: 0.75, not 0.99."""
    odds = np.array([[1e3, 1e3 / 3.0], [1e3, 1e3]])
    assert solve(odds).pair[0, 0] == pytest.approx(0.75, abs=0.002)
    tracks, detections = np.array(np.nonzero(odds))
    pair, _, _, _ = belief.propagate_beliefs(tracks, detections, odds[tracks, detections], 2, 2)
    assert pair[0] > 0.99


def test_a_long_chain_is_exact() -> None:
    """Three hundred tracks in a row that share detections with their neighbours: the frontier stays narrow."""
    rng = np.random.default_rng(3)
    count = 300
    tracks = np.repeat(np.arange(count), 2)
    detections = tracks + np.tile([0, 1], count)
    odds = 10.0 ** rng.uniform(-1.0, 5.0, 2 * count)
    found = association_marginals(tracks, detections, odds, count, count + 1)
    # a chain has no loop: belief propagation is exact on it
    expected = belief.propagate_beliefs(tracks, detections, odds, count, count + 1)
    for one, other in zip(found[:3], expected[:3], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7)
    assert found[3] == pytest.approx(expected[3], rel=1e-9)


def test_clusters_are_independent() -> None:
    one, other = random_odds(1, 4, 5, -1.0, 3.0, 1.0), random_odds(2, 5, 3, -1.0, 3.0, 1.0)
    both = np.zeros((9, 8))
    both[:4, :5], both[4:, 5:] = one, other
    found, first, second = solve(both), solve(one), solve(other)
    np.testing.assert_array_equal(found.pair[:4, :5], first.pair)
    np.testing.assert_array_equal(found.pair[4:, 5:], second.pair)
    assert found.log_evidence == pytest.approx(first.log_evidence + second.log_evidence, rel=1e-14)


def test_weak_links_are_taken_to_first_order() -> None:
    """Two clusters tied by a pair of odds below the first level: the error is that of second order."""
    odds = np.zeros((4, 4))
    odds[:2, :2], odds[2:, 2:] = 100.0 * np.eye(2) + 3.0, 5.0
    odds[1, 2] = 0.9 * WEAK_LINKS[0]
    found, exact = solve(odds), enumerate_associations(odds)
    assert found.pair[1, 2] == pytest.approx(exact.pair[1, 2], rel=1e-3)
    assert worst(found, exact) < WEAK_LINKS[0]
    np.testing.assert_allclose(found.pair.sum(axis=1) + found.missed, 1.0, atol=1e-9)


def dense(n_tracks: int, n_detections: int) -> np.ndarray:
    return random_odds(5, n_tracks, n_detections, 0.0, 3.0, 1.0)


def test_a_cluster_too_large_is_propagated() -> None:
    odds = dense(30, 30)
    tracks, detections = np.array(np.nonzero(odds))
    values = odds[tracks, detections]
    table, _ = make_table(tracks, detections, values, 30, 30)
    assert make_plan(table, 12).cost > max(MOST_COST, MOST_COST_A_PAIR * len(values))
    found = association_marginals(tracks, detections, values, 30, 30)
    expected = belief.propagate_beliefs(tracks, detections, values, 30, 30)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@settings(max_examples=60)
@given(seed=seeds, n_tracks=st.integers(2, 60), n_detections=st.integers(2, 60), width=st.integers(1, 4))
def test_what_counts_as_too_dense_has_no_plan(seed: int, n_tracks: int, n_detections: int, width: int) -> None:
    """The bound on the pairs of a node leaves no affordable cluster out, here for narrower frontiers.

    Columns are near one another, as in an image, so that many plans are just narrow enough.
    """
    rng = np.random.default_rng(seed)
    place = np.arange(n_tracks) * (n_detections - 1) // (n_tracks - 1)
    reach = rng.integers(0, width + 2, n_tracks)
    near = np.abs(np.arange(n_detections) - place[:, None]) <= reach[:, None]
    tracks, detections = np.nonzero(near)
    table, _ = make_table(tracks, detections, np.ones(len(tracks)), n_tracks, n_detections)
    assert len(tracks) <= width * (n_tracks + n_detections) or not np.isfinite(make_plan(table, width).cost)


def test_a_crowd_is_propagated() -> None:
    """More pairs of a track than any plan allows: belief propagation alone, as without the bound on pairs."""
    odds = dense(60, 60)
    tracks, detections = np.array(np.nonzero(odds))
    values = odds[tracks, detections]
    assert len(values) > MOST_WIDTH * 120
    found = association_marginals(tracks, detections, values, 60, 60)
    expected = belief.propagate_beliefs(tracks, detections, values, 60, 60)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_large_cluster_splits_at_weak_links() -> None:
    """Ten clusters of three, all tied by odds below the second level: exact, to about the odds of the ties."""
    rng = np.random.default_rng(6)
    odds = 10.0 ** rng.uniform(-8.0, -5.0, (30, 30))
    for block in range(10):
        part = slice(3 * block, 3 * block + 3)
        odds[part, part] = 10.0 ** rng.uniform(1.0, 3.0, (3, 3))
    found = solve(odds)
    for block in range(10):
        part = slice(3 * block, 3 * block + 3)
        exact = enumerate_associations(odds[part, part])
        np.testing.assert_allclose(found.pair[part, part], exact.pair, atol=1e-4)
    np.testing.assert_allclose(found.pair.sum(axis=1) + found.missed, 1.0, atol=1e-6)


@settings(max_examples=100)
@given(seed=seeds, n_tracks=sizes, n_detections=sizes, low=st.floats(-300.0, 0.0), high=st.floats(0.0, 300.0))
def test_finite_for_extreme_odds(seed: int, n_tracks: int, n_detections: int, low: float, high: float) -> None:
    found = solve(random_odds(seed, n_tracks, n_detections, low, high, 0.7))
    assert np.isfinite(found.log_evidence)
    for values in (found.pair, found.missed, found.unclaimed):
        assert np.isfinite(values).all()
        assert ((values >= 0.0) & (values <= 1.0)).all()
    np.testing.assert_allclose(found.pair.sum(axis=1) + found.missed, 1.0, rtol=0, atol=1e-6)


@settings(max_examples=100)
@given(seed=seeds, n_tracks=sizes, n_detections=sizes)
def test_order_of_the_pairs_does_not_matter(seed: int, n_tracks: int, n_detections: int) -> None:
    rng = np.random.default_rng(seed)
    odds = 10.0 ** rng.uniform(-3.0, 2.0, (n_tracks, n_detections))
    rows, columns = rng.permutation(n_tracks), rng.permutation(n_detections)
    found, turned = solve(odds), solve(odds[rows][:, columns])
    np.testing.assert_allclose(turned.pair, found.pair[rows][:, columns], rtol=0, atol=1e-12)
    np.testing.assert_allclose(turned.unclaimed, found.unclaimed[columns], rtol=0, atol=1e-12)
    assert turned.log_evidence == pytest.approx(found.log_evidence, abs=1e-12)


@pytest.mark.parametrize(("n_tracks", "n_detections"), [(0, 0), (0, 3), (2, 0), (2, 3)])
def test_nothing_to_pair(n_tracks: int, n_detections: int) -> None:
    found = solve(np.zeros((n_tracks, n_detections)))
    np.testing.assert_array_equal(found.missed, np.ones(n_tracks))
    np.testing.assert_array_equal(found.unclaimed, np.ones(n_detections))
    assert found.log_evidence == 0.0
