"""OSPA(2): by hand, against the definition written out, and as a metric."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.metrics.distances import ospa2 as ospa2_module
from stereophd.core.metrics.distances.ospa import Ospa, score_scans
from stereophd.core.metrics.distances.ospa2 import ospa2_of_windows
from stereophd.core.metrics.matching.near_pairs import near_pairs
from stereophd.core.metrics.scans import PointSets

# Scans of {label: x}; every point lies on the x axis.
Scans = list[dict[int, float]]


def point_sets(scans: Scans, variance: float = 1.0) -> PointSets:
    x = np.array([value for scan in scans for value in scan.values()], dtype=float)
    label = np.array([name for scan in scans for name in scan], dtype=np.int64)
    position = np.stack([x, 0 * x, 0 * x], axis=1)
    start = np.concatenate([[0], np.cumsum([len(scan) for scan in scans])]).astype(np.int64)
    # The second axis differs, so that the right element counts.
    covariance = np.tile(np.diag([variance, 9.0, 16.0]), (len(x), 1, 1))
    return PointSets(start, position, 0 * position, label, covariance)


def windows_of(
    x: PointSets, y: PointSets, window: int, order: float, cutoff: float, *, mahalanobis: bool = False
) -> Ospa:
    return ospa2_of_windows(x, y, near_pairs(x, y, cutoff, mahalanobis=mahalanobis), window, order, cutoff)


def distances(x: Scans, y: Scans, window: int = 3, order: float = 1.0, cutoff: float = 10.0) -> list[float]:
    return windows_of(point_sets(x), point_sets(y), window, order, cutoff).distance.tolist()


def written_out(x: Scans, y: Scans, window: int, order: float, cutoff: float) -> list[tuple[float, float, float]]:
    """Beard, Vo and Vo's definition, as it stands, with all permutations."""
    results = []
    for last in range(len(x)):
        times = range(max(last - window + 1, 0), last + 1)
        smaller, larger = ({name for t in times for name in scans[t]} for scans in (x, y))
        one, other = x, y
        if len(smaller) > len(larger):
            smaller, larger, one, other = larger, smaller, y, x
        if not larger:
            results.append((0.0, 0.0, 0.0))
            continue
        base = {}
        for f in smaller:
            for g in larger:
                terms = []
                for t in times:
                    if f in one[t] and g in other[t]:
                        terms.append(min(cutoff, abs(one[t][f] - other[t][g])))
                    elif f in one[t] or g in other[t]:
                        terms.append(cutoff)
                base[f, g] = sum(terms) / len(terms)
        least = min(
            sum(base[f, g] ** order for f, g in zip(sorted(smaller), chosen, strict=True))
            for chosen in permutations(larger, len(smaller))
        )
        absent = cutoff**order * (len(larger) - len(smaller))
        parts = ((least + absent) / len(larger), least / len(larger), absent / len(larger))
        results.append(tuple(part ** (1 / order) for part in parts))
    return results


def test_a_track_of_constant_offset():
    truth = [{1: float(t)} for t in range(6)]
    track = [{7: t + 2.0} for t in range(6)]
    assert distances(track, truth) == pytest.approx([2.0] * 6)
    assert distances(track, track) == [0.0] * 6
    assert distances([{}] * 6, truth) == distances(track, [{}] * 6) == [10.0] * 6
    assert distances([{}] * 6, [{}] * 6) == [0.0] * 6


def test_a_change_of_identity_costs_while_it_is_in_the_window():
    truth = [{1: 0.0}] * 6
    track = [{7: 0.0}] * 2 + [{8: 0.0}] * 4
    # At scan 2 the window has 7, 7, 8: the better track covers 2 of 3 scans, base c/3, and one track is too
    # many: (c/3 + c) / 2. At scan 3: 7, 8, 8, the same. From scan 4 on only 8 is in the window.
    assert distances(track, truth) == pytest.approx([0.0, 0.0, 20 / 3, 20 / 3, 0.0, 0.0])
    assert distances(track, truth, window=1) == [0.0] * 6


def test_identities_that_are_swapped():
    truth = [{1: 0.0, 2: 100.0}] * 4
    track = [{7: 0.0, 8: 100.0}] * 2 + [{8: 0.0, 7: 100.0}] * 2
    # Scan 2: both tracks are right in 2 of 3 scans. OSPA sees nothing of it.
    assert distances(track, truth) == pytest.approx([0.0, 0.0, 10 / 3, 10 / 3])
    scores = score_scans(point_sets(track), point_sets(truth), 1.0, 10.0)
    assert scores.ospa.distance.tolist() == [0.0] * 4


def test_scans_at_which_neither_exists_do_not_count():
    truth = [{1: 0.0}, {}, {1: 0.0}]
    assert distances([{7: 4.0}, {}, {}], truth) == pytest.approx([4.0, 4.0, 7.0])


def test_parts_and_order():
    truth = [{1: 0.0, 2: 50.0}]
    result = windows_of(point_sets([{7: 3.0}]), point_sets(truth), 10, 2.0, 10.0)
    assert result.localisation == pytest.approx([np.sqrt(9 / 2)])
    assert result.cardinality == pytest.approx([np.sqrt(100 / 2)])
    assert result.distance == pytest.approx([np.sqrt(109 / 2)])


def test_unlabelled_and_repeated_estimates_are_tracks_of_one_scan():
    truth = point_sets([{1: 0.0}] * 2)
    for labels in ([-1, -1], [-1, 3]):
        track = point_sets([{4: 0.0}] * 2)
        track = PointSets(track.start, track.position, track.velocity, np.array(labels))
        # Two tracks, each right in one of two scans: (c/2 + c) / 2.
        assert windows_of(track, truth, 2, 1.0, 10.0).distance == pytest.approx([0.0, 7.5])
    twice = point_sets([{4: 0.0, 5: 30.0}])
    twice = PointSets(twice.start, twice.position, twice.velocity, np.array([4, 4]))
    assert windows_of(twice, point_sets([{1: 0.0}]), 2, 1.0, 10.0).distance == pytest.approx([5.0])
    # A negative identity of a true object is one like any other.
    assert distances([{4: 1.0}] * 3, [{-2: 0.0}] * 3) == pytest.approx([1.0] * 3)


def test_mahalanobis_distance():
    truth, track = [{1: 0.0}] * 3, [{7: 3.0}] * 3
    result = windows_of(point_sets(track, variance=4.0), point_sets(truth), 2, 2.0, 10.0, mahalanobis=True)
    assert result.distance == pytest.approx([1.5] * 3)
    with pytest.raises(ValueError, match="positive definite"):
        windows_of(point_sets(track, variance=0.0), point_sets(truth), 2, 2.0, 10.0, mahalanobis=True)
    bare = PointSets(*(getattr(point_sets(track), name) for name in ("start", "position", "velocity", "label")))
    with pytest.raises(ValueError, match="expected covariances"):
        windows_of(bare, point_sets(truth), 2, 2.0, 10.0, mahalanobis=True)


@pytest.mark.parametrize(
    ("scans", "options", "message"),
    [
        (3, {"window": 0}, "window"),
        (3, {"order": 0.5}, "order"),
        (3, {"cutoff": 0.0}, "cutoff"),
        (2, {}, "as many scans"),
    ],
)
def test_parameters_out_of_range(scans, options, message):
    options = {"window": 3, "order": 1.0, "cutoff": 10.0, **options}
    with pytest.raises(ValueError, match=message):
        windows_of(point_sets([{1: 0.0}] * scans), point_sets([{1: 0.0}] * 3), **options)


def test_no_scans():
    assert distances([], []) == []


def random_scans(random: np.random.Generator, scans: int, names: int, stay: float) -> Scans:
    """Tracks that come and go, wander, and sometimes swap their labels."""
    state, result = {}, []
    for _ in range(scans):
        for name in range(names):
            if random.random() > stay:
                if name in state:
                    del state[name]
                else:
                    state[name] = float(random.integers(0, 30))
        state = {name: x + random.normal() for name, x in state.items()}
        if random.random() < 0.15 and len(state) > 1:
            one, two = list(state)[:2]
            state[one], state[two] = state[two], state[one]
        result.append(dict(state))
    return result


@pytest.mark.parametrize("entries", [1, 60, 400_000])
@pytest.mark.parametrize(
    ("window", "order", "cutoff"), [(1, 1.0, 5.0), (4, 2.0, 8.0), (10, 1.5, 3.0), (500, 2.0, 20.0)]
)
def test_windows_are_as_the_definition_says(window, order, cutoff, entries, monkeypatch):
    monkeypatch.setattr(ospa2_module, "MOST_ENTRIES", entries)
    random = np.random.default_rng(5)
    truth, tracks = random_scans(random, 60, 3, 0.9), random_scans(random, 60, 4, 0.8)
    found = windows_of(point_sets(tracks), point_sets(truth), window, order, cutoff)
    expected = np.array(written_out(tracks, truth, window, order, cutoff)).T
    assert found.distance == pytest.approx(expected[0], abs=1e-9)
    assert found.localisation == pytest.approx(expected[1], abs=1e-9)
    assert found.cardinality == pytest.approx(expected[2], abs=1e-9)


def test_long_runs_in_pieces(monkeypatch):
    random = np.random.default_rng(6)
    truth, tracks = (point_sets(random_scans(random, 300, names, 0.9)) for names in (5, 6))
    whole = windows_of(tracks, truth, 7, 2.0, 8.0)
    monkeypatch.setattr(ospa2_module, "MOST_SCANS_AT_ONCE", 3)
    pieces = windows_of(tracks, truth, 7, 2.0, 8.0)
    assert pieces.distance == pytest.approx(whole.distance, abs=1e-9)


def test_only_tracks_of_the_window_come_together(monkeypatch):
    """Tracks that never meet cost no memory: tables stay below their bound however long the run is."""
    made = []
    original = ospa2_module.sums_between

    def watched(values, *arguments):
        made.append(values.size)
        return original(values, *arguments)

    monkeypatch.setattr(ospa2_module, "sums_between", watched)
    scans = 5000
    truth = point_sets([{t // 2: 0.0, 100_000 + t // 3: 50.0} for t in range(scans)])
    tracks = point_sets([{t: 0.0, 100_000 + t: 50.0} for t in range(scans)])
    found = windows_of(tracks, truth, 10, 1.0, 10.0)
    assert max(made) <= ospa2_module.MOST_ENTRIES
    assert sum(made) < 3000 * scans
    assert len(found.distance) == scans


TRACKS = st.lists(st.dictionaries(st.integers(0, 3), st.floats(-30, 30), max_size=4), min_size=5, max_size=5)


@settings(max_examples=100)
@given(x=TRACKS, y=TRACKS, z=TRACKS, window=st.integers(1, 6), order=st.floats(1, 4))
def test_it_is_a_metric(x, y, z, window, order):
    cutoff = 12.0
    xy, yx, yz, xz = (np.array(distances(a, b, window, order, cutoff)) for a, b in ((x, y), (y, x), (y, z), (x, z)))
    assert xy == pytest.approx(yx, abs=1e-9)
    assert distances(x, x, window, order, cutoff) == pytest.approx([0.0] * 5, abs=1e-9)
    assert (xz <= xy + yz + 1e-9).all()
    assert ((xy >= 0) & (xy <= cutoff + 1e-12)).all()


@settings(max_examples=100)
@given(x=TRACKS, y=TRACKS, order=st.floats(1, 4))
def test_one_scan_is_ospa_and_names_do_not_matter(x, y, order):
    ospa = score_scans(point_sets(x), point_sets(y), order, 12.0).ospa.distance
    assert distances(x, y, 1, order, 12.0) == pytest.approx(ospa.tolist(), abs=1e-9)
    renamed = [{50 - 7 * name: value for name, value in reversed(scan.items())} for scan in x]
    assert distances(renamed, y, 3, order) == pytest.approx(distances(x, y, 3, order), abs=1e-9)
