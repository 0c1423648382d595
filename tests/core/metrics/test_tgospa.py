"""Trajectory GOSPA by hand."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.metrics.distances import tgospa
from stereophd.core.metrics.distances.tgospa import trajectory_gospa
from stereophd.core.metrics.matching.near_pairs import near_pairs
from stereophd.core.metrics.scans import PointSets
from stereophd.errors import InputError

# Seed, cost of a switch, and distance by LPTrajMetric_Cluster of github.com/Agarciafernandez/T-GOSPA-metric-python at
# c6e22b7.
EXPECTED = [(0, 0.5, 4.154219), (1, 1.0, 4.334684), (2, 2.0, 5.633773), (3, 1.5, 5.005377)]


def point_sets(scans: list[dict[int, float]]) -> PointSets:
    """Return points on the x axis by label, scan by scan."""
    start = np.concatenate([[0], np.cumsum([len(scan) for scan in scans])]).astype(np.int64)
    x = np.array([value for scan in scans for value in scan.values()], dtype=float)
    position = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    label = np.array([label for scan in scans for label in scan], dtype=np.int64)
    return PointSets(start, position, np.full_like(position, np.nan), label)


def distance(
    tracks: list[dict[int, float]], objects: list[dict[int, float]], switch_cost: float, order: float = 2.0
) -> tgospa.TrajectoryGospa:
    estimates, truth = point_sets(tracks), point_sets(objects)
    return trajectory_gospa(estimates, truth, near_pairs(estimates, truth, 2.0), order, 2.0, switch_cost)


def test_a_track_that_ends_and_goes_on_under_another_name() -> None:
    """Five scans of one object, 0.5 away from two tracks of two scans each: four errors, a miss and a switch."""
    objects = [{0: float(k)} for k in range(5)]
    tracks = [{7: 0.5}, {7: 1.5}, {}, {8: 3.5}, {8: 4.5}]
    found = distance(tracks, objects, 1.0)
    assert found.localisation == pytest.approx(4 * 0.25)
    assert found.missed == pytest.approx(2.0)
    assert found.false == pytest.approx(0.0, abs=1e-9)
    assert found.switches == pytest.approx(1.0)
    assert found.mean(2.0) == pytest.approx(np.sqrt((1.0 + 2.0 + 1.0) / 5))
    named = [dict.fromkeys([7] * len(scan), *scan.values()) for scan in tracks]
    assert distance(named, objects, 1.0).switches == pytest.approx(0.0, abs=1e-9)


def test_two_tracks_that_exchange_their_objects_switch_or_err() -> None:
    objects = [{0: 0.0, 1: 1.0}] * 6
    tracks = [{7: 0.0, 8: 1.0}] * 3 + [{8: 0.0, 7: 1.0}] * 3
    cheap = distance(tracks, objects, 1.0)
    assert (cheap.switches, cheap.switched, cheap.localisation) == pytest.approx((2.0, 2.0, 0.0), abs=1e-9)
    # with a dear switch it is cheaper to keep the tracks, each 1 away in three scans
    dear = distance(tracks, objects, 3.0)
    assert (dear.switches, dear.localisation) == pytest.approx((0.0, 6.0), abs=1e-9)


def test_without_a_cost_of_switches_it_is_gospa() -> None:
    generator = np.random.default_rng(5)
    objects = [{k: float(x) for k, x in enumerate(generator.uniform(0, 6, 3))} for _ in range(8)]
    tracks = [{k + 10: float(x) for k, x in enumerate(generator.uniform(0, 6, 4))} for _ in range(8)]
    estimates, truth = point_sets(tracks), point_sets(objects)
    from stereophd.core.metrics.distances.ospa import score_scans

    scores = score_scans(estimates, truth, 2.0, 2.0, mahalanobis=False)
    found = distance(tracks, objects, 1e-9)
    assert found.mean(2.0) ** 2 == pytest.approx(np.mean(scores.gospa.distance**2))


@pytest.mark.parametrize(("seed", "switch_cost", "expected"), EXPECTED)
def test_random_scenes_have_the_distances_of_the_public_code(seed: int, switch_cost: float, expected: float) -> None:
    """Four tracks change their objects, a fifth is false."""
    generator = np.random.default_rng(seed)
    x = np.cumsum(generator.normal(0, 0.4, (15, 4)), axis=0) + generator.uniform(0, 3, 4)
    objects = [{k: float(x[t, k]) for k in range(4) if 2 * k <= t < 15 - k} for t in range(15)]
    tracks = [
        {10 + (k + (t >= 7)) % 4: place + float(generator.normal(0, 0.3)) for k, place in scan.items()}
        | ({20: float(generator.uniform(0, 3))} if 3 <= t < 9 else {})
        for t, scan in enumerate(objects)
    ]
    assert distance(tracks, objects, switch_cost).mean(2.0) * np.sqrt(15) == pytest.approx(expected, abs=1e-6)


def test_nothing_in_common_costs_misses_and_false_tracks() -> None:
    found = distance([{7: 50.0}, {}], [{0: 0.0}, {0: 0.0}], 1.0)
    assert (found.missed, found.false, found.switches, found.localisation) == (4.0, 2.0, 0.0, 0.0)


def test_a_program_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tgospa, "MOST_WEIGHTS", 3)
    with pytest.raises(InputError, match="`switch_cost`: expected at most 3 weights"):
        distance([{7: 0.0}] * 5, [{0: 0.0}] * 5, 1.0)
