"""OSPA and GOSPA: Stone Soup as the oracle, and the axioms of a metric."""

from __future__ import annotations

import datetime
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stereophd.core.metrics.distances.ospa import Gospa, Ospa, ScanScores, score_scans
from stereophd.core.metrics.matching.near_pairs import near_pairs
from stereophd.core.metrics.scans import PointSets

TIME = datetime.datetime(2020, 1, 1)
SIZES = [(0, 1), (1, 0), (0, 4), (5, 0), (1, 1), (1, 6), (6, 1), (2, 2), (3, 3), (4, 7), (7, 4), (8, 8)]


def one_scan(points: Any, covariance: np.ndarray | None = None) -> PointSets:
    """A single scan of points."""
    position = np.asarray(points, dtype=float).reshape(-1, 3)
    return PointSets(
        np.array([0, len(position)]), position, np.zeros_like(position), np.arange(len(position)), covariance
    )


def scores_of(x: Any, y: Any, order: float, cutoff: float, covariance: np.ndarray | None = None) -> ScanScores:
    return score_scans(one_scan(x, covariance), one_scan(y), order, cutoff, mahalanobis=covariance is not None)


def ospa(x: Any, y: Any, order: float, cutoff: float, covariance: np.ndarray | None = None) -> Ospa:
    return Ospa(*(part[0] for part in scores_of(x, y, order, cutoff, covariance).ospa))


def gospa(x: Any, y: Any, order: float, cutoff: float) -> Gospa:
    return Gospa(*(part[0] for part in scores_of(x, y, order, cutoff).gospa))


def random_sets(seed: int, sizes: tuple[int, int], spread: float) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.normal(0, spread, (sizes[0], 3)), random.normal(0, spread, (sizes[1], 3))


def stone_soup() -> Any:
    """Stone Soup's OSPA and GOSPA: imported where they are used, which takes seconds."""
    from stonesoup.metricgenerator import ospametric

    return ospametric


def states(points: np.ndarray) -> list[Any]:
    from stonesoup.types.state import State

    return [State(point[:, None], timestamp=TIME) for point in points]


def ospa_by_enumeration(x: np.ndarray, y: np.ndarray, order: float, cutoff: float) -> float:
    """Paper VIII-C, literally: the minimum over all permutations."""
    if len(x) > len(y):
        x, y = y, x
    if len(y) == 0:
        return 0.0
    best = min(
        sum(min(cutoff, float(np.linalg.norm(x[i] - y[j]))) ** order for i, j in enumerate(permutation))
        for permutation in permutations(range(len(y)), len(x))
    )
    return ((best + cutoff**order * (len(y) - len(x))) / len(y)) ** (1 / order)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("spread", [1.0, 5.0, 50.0])
def test_ospa_of_order_one_is_stone_soups(sizes, spread):
    oracle = stone_soup().OSPAMetric(p=1, c=10.0)
    for seed in range(20):
        x, y = random_sets(seed, sizes, spread)
        expected = oracle.compute_OSPA_distance(states(x), states(y)).value
        assert ospa(x, y, 1.0, 10.0).distance == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("order", [2.0, 3.0])
def test_ospa_of_higher_order_against_stone_soup(sizes, order):
    """Stone Soup 1.9.1 assigns by the sum of d, then raises to p; the definition assigns by the sum of d^p.

    Its OSPA is therefore an upper bound, reached whenever both assignments agree. Its GOSPA does assign by
    d^p, and gives the OSPA of the definition: they differ by the cost of the surplus points only.
    """
    cutoff, equal = 10.0, 0
    for seed in range(20):
        x, y = random_sets(seed, sizes, 5.0)
        ours = float(ospa(x, y, order, cutoff).distance)
        theirs = stone_soup().OSPAMetric(p=order, c=cutoff).compute_OSPA_distance(states(x), states(y)).value
        assert ours <= theirs + 1e-9
        equal += abs(ours - theirs) < 1e-9
        value = stone_soup().GOSPAMetric(p=order, c=cutoff).compute_gospa_metric(states(x), states(y))[0].value
        surplus = abs(len(x) - len(y)) * cutoff**order
        by_definition = ((value["distance"] ** order + 0.5 * surplus) / max(sizes)) ** (1 / order)
        assert ours == pytest.approx(by_definition, abs=1e-9)
    assert equal >= 10


@pytest.mark.parametrize("sizes", [(0, 3), (2, 0), (1, 1), (2, 2), (3, 5), (5, 3), (5, 5)])
def test_ospa_is_the_minimum_over_permutations(sizes):
    for seed in range(10):
        x, y = random_sets(seed, sizes, 8.0)
        for order in (1.0, 2.0, 4.0):
            expected = ospa_by_enumeration(x, y, order, 12.0)
            assert ospa(x, y, order, 12.0).distance == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_gospa_and_its_parts_are_stone_soups(sizes, order):
    oracle = stone_soup().GOSPAMetric(p=order, c=10.0)
    for seed in range(20):
        x, y = random_sets(seed, sizes, 6.0)
        expected = oracle.compute_gospa_metric(states(x), states(y))[0].value
        found = gospa(x, y, order, 10.0)
        assert found.distance == pytest.approx(expected["distance"], abs=1e-9)
        for part in ("localisation", "missed", "false"):
            assert getattr(found, part) ** order == pytest.approx(expected[part], abs=1e-9)


def test_two_empty_sets_are_equal():
    nothing = np.zeros((0, 3))
    assert ospa(nothing, nothing, 2.0, 20.0).distance == 0.0
    assert gospa(nothing, nothing, 2.0, 20.0).distance == 0.0
    assert ospa([], [], 2.0, 20.0).distance == 0.0


def test_parts_of_ospa_by_hand():
    found = ospa([[0.0, 0, 0], [100.0, 0, 0]], [[3.0, 4.0, 0]], 2.0, 20.0)
    assert found.localisation == pytest.approx(np.sqrt(25 / 2))
    assert found.cardinality == pytest.approx(np.sqrt(400 / 2))
    assert found.distance == pytest.approx(np.sqrt(425 / 2))


def test_mahalanobis_distances_as_base():
    random = np.random.default_rng(3)
    x, y = random.normal(size=(4, 3)), random.normal(size=(5, 3))
    factor = random.normal(size=(4, 3, 3))
    covariance = factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(3)
    near = near_pairs(one_scan(x, covariance), one_scan(y), 100.0, mahalanobis=True)
    assert len(near.ratio) == 20
    for i, j, ratio in zip(near.estimate, near.truth, near.ratio, strict=True):
        e = x[i] - y[j]
        assert 100.0 * ratio == pytest.approx(np.sqrt(e @ np.linalg.solve(covariance[i], e)))
    unit = ospa(x, y, 2.0, 3.0, np.tile(np.eye(3), (4, 1, 1)))
    assert unit.distance == pytest.approx(ospa(x, y, 2.0, 3.0).distance)
    assert ospa(x, y, 2.0, 3.0, covariance).distance != pytest.approx(ospa(x, y, 2.0, 3.0).distance)


def test_a_covariance_that_is_not_positive_definite_is_refused():
    with pytest.raises(ValueError, match="positive definite"):
        ospa(np.zeros((1, 3)), np.ones((1, 3)), 2.0, 3.0, np.diag([1.0, -1.0, 1.0])[None])


@pytest.mark.parametrize(("order", "cutoff"), [(0.5, 1.0), (np.inf, 1.0), (2.0, 0.0), (2.0, np.nan)])
def test_parameters_out_of_range_are_refused(order, cutoff):
    with pytest.raises(ValueError, match="expected"):
        ospa(np.zeros((1, 3)), np.zeros((1, 3)), order, cutoff)


point_sets = st.integers(0, 4).flatmap(
    lambda n: arrays(np.float64, (n, 3), elements=st.floats(-40, 40, allow_nan=False, width=32))
)
orders = st.sampled_from([1.0, 2.0, 3.5, 6.0, 10.0])


@settings(max_examples=150)
@given(x=point_sets, y=point_sets, z=point_sets, order=orders)
def test_ospa_is_a_bounded_metric(x, y, z, order):
    cutoff = 20.0

    def distance(a, b):
        return float(ospa(a, b, order, cutoff).distance)

    assert distance(x, x) == 0.0
    assert distance(x, x[::-1]) == 0.0
    assert distance(x, y) == pytest.approx(distance(y, x), abs=1e-9)
    assert 0.0 <= distance(x, y) <= cutoff + 1e-9
    assert distance(x, z) <= distance(x, y) + distance(y, z) + 1e-9


@settings(max_examples=100)
@given(x=point_sets, y=point_sets, order=orders)
def test_parts_add_up(x, y, order):
    one = ospa(x, y, order, 20.0)
    assert one.distance**order == pytest.approx(one.localisation**order + one.cardinality**order)
    two = gospa(x, y, order, 20.0)
    assert two.distance**order == pytest.approx(two.localisation**order + two.missed**order + two.false**order)
    assert two.distance <= 20.0 * max(len(x) + len(y), 1) + 1e-9
