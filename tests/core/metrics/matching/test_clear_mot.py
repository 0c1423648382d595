"""Identities over a whole run: the assignment of CLEAR MOT, IDF1 and HOTA, against `motmetrics` and plain code."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from stereophd.core.metrics.distances.hota import THRESHOLDS, hota
from stereophd.core.metrics.distances.ospa import ScanScores, score_scans
from stereophd.core.metrics.identities import identity_score, identity_switches
from stereophd.core.metrics.matching.clear_mot import beside_another, match_within
from stereophd.core.metrics.matching.near_pairs import least_cost, near_pairs
from stereophd.core.metrics.scans import PointSets

CUTOFF = 10.0


def point_sets(scans: list[list[tuple[int, np.ndarray]]]) -> PointSets:
    """Points of each scan, as (label, position)."""
    label = np.array([one for scan in scans for one, _ in scan], dtype=np.int64)
    position = np.array([place for scan in scans for _, place in scan]).reshape(-1, 3)
    start = np.concatenate([[0], np.cumsum([len(scan) for scan in scans])]).astype(np.int64)
    return PointSets(start, position, np.zeros_like(position), label)


def crowded_run(seed: int, scans: int = 60) -> tuple[PointSets, PointSets]:
    """Clusters of objects much nearer to each other than the cutoff, whose tracks break, stop, swap and come back.

    Every pair is either nearer than 0.4 cutoffs or beyond the cutoff, so that the cheapest assignment has as many pairs
    as possible: the rule of motmetrics for what keeps no assignment is the most pairs, ours the least cost.
    """
    random = np.random.default_rng(seed)
    centre = np.repeat([[0.0, 0, 0], [40.0, 0, 0]], [4, 3], axis=0)
    tracks = np.arange(7) + 20
    estimates, truth = [], []
    for _ in range(scans):
        place = centre + random.uniform(-0.8, 0.8, (7, 3))
        seen = place + random.uniform(-0.8, 0.8, (7, 3))
        if random.random() < 0.1:
            one, other = random.choice(7, 2, replace=False)
            tracks[[one, other]] = tracks[[other, one]]
        if random.random() < 0.1:
            tracks[random.integers(7)] = tracks.max() + 1
        exists, reported = random.random(7) < 0.9, random.random(7) < 0.8
        truth.append([(k, place[k]) for k in range(7) if exists[k]])
        estimates.append([(int(tracks[k]), seen[k]) for k in range(7) if reported[k]])
    return point_sets(estimates), point_sets(truth)


def followed(estimates: PointSets, truth: PointSets, order: float = 1.0, cutoff: float = CUTOFF) -> ScanScores:
    return match_within(estimates, truth, score_scans(estimates, truth, order, cutoff), order, cutoff, cutoff)[0]


def switches(estimates: PointSets, truth: PointSets, scores: ScanScores) -> int:
    pairs = scores.pairs.scan, truth.label[scores.pairs.truth], estimates.label[scores.pairs.estimate]
    return int(identity_switches(*pairs).sum())


def assign_by_hand(estimates: PointSets, truth: PointSets, order: float) -> list[tuple[int, int]]:
    """CLEAR MOT, one scan after the other, in plain code: rows of estimates and true points."""
    last: dict[int, tuple[int, int]] = {}
    out = []
    for scan in range(truth.scans):
        rows = range(*estimates.start[scan : scan + 2])
        columns = range(*truth.start[scan : scan + 2])
        distance = {(e, x): np.linalg.norm(estimates.position[e] - truth.position[x]) for e in rows for x in columns}
        pairs: list[tuple[int, int]] = []
        for x in sorted(columns, key=lambda x: -last.get(truth.label[x], (-1, -1))[1]):
            track = last.get(truth.label[x], (-1, -1))[0]
            taken = {e for e, _ in pairs}
            keeps = [e for e in rows if estimates.label[e] == track >= 0 and distance[e, x] < CUTOFF and e not in taken]
            pairs.extend((e, x) for e in keeps[:1])
        rows = [e for e in rows if e not in {e for e, _ in pairs}]
        columns = [x for x in columns if x not in {x for _, x in pairs}]
        cost = np.array([[min(distance[e, x] / CUTOFF, 1.0) ** order for x in columns] for e in rows])
        if cost.size:
            chosen = [(rows[i], columns[j]) for i, j in zip(*linear_sum_assignment(cost), strict=True)]
            pairs += [pair for pair in chosen if distance[pair] < CUTOFF]
        last |= {truth.label[x]: (estimates.label[e], scan) for e, x in pairs if estimates.label[e] >= 0}
        out += pairs
    return sorted(out)


def test_perfect_tracks_nearer_than_their_errors_never_switch():
    random = np.random.default_rng(4)
    place = np.array([[0.0, 0, 0], [3.0, 0, 0]])
    truth = point_sets([[(0, place[0]), (1, place[1])] for _ in range(500)])
    seen = place + random.normal(0.0, 2.0, (500, 2, 3))
    estimates = point_sets([[(7, both[0]), (8, both[1])] for both in seen])
    optimal = score_scans(estimates, truth, 2.0, 20.0)
    assert switches(estimates, truth, optimal) > 100
    scores = followed(estimates, truth, 2.0, 20.0)
    assert switches(estimates, truth, scores) == 0
    assert (scores.n_matched == 2).all()
    assert (estimates.label[scores.pairs.estimate] == truth.label[scores.pairs.truth] + 7).all()
    assert (scores.ospa.distance == optimal.ospa.distance).all()
    assert beside_another(estimates, truth, scores.pairs, near_pairs(estimates, truth, 20.0)) == 0


def test_a_match_that_is_wrong_from_the_first_scan_on_is_kept_within_the_distance_only():
    """At the first scan track 8 lies beside object 0, and object 1 has no track; then both tracks are right."""
    places = np.array([[0.0, 0, 0], [10.0, 0, 0]])
    truth = point_sets([[(0, places[0]), (1, places[1])] for _ in range(50)])
    later = [(7, places[0] + 0.1), (8, places[1] + 0.1)]
    estimates = point_sets([[(8, np.array([3.0, 0, 0]))], *([later] * 49)])
    optimal = score_scans(estimates, truth, 2.0, 20.0)
    wide, pairs = match_within(estimates, truth, optimal, 2.0, 20.0, 20.0)
    assert wide.pairs.estimate.tolist() == followed(estimates, truth, 2.0, 20.0).pairs.estimate.tolist()
    assert beside_another(estimates, truth, wide.pairs, pairs) == 98
    narrow, pairs = match_within(estimates, truth, optimal, 2.0, 20.0, 5.0)
    assert beside_another(estimates, truth, narrow.pairs, pairs) == 0
    assert narrow.n_matched.tolist() == [1] + [2] * 49
    assert (narrow.ospa.distance == optimal.ospa.distance).all()
    assert switches(estimates, truth, narrow) == 1


def test_a_track_beyond_the_cutoff_is_let_go_and_may_be_taken_up_again():
    places = [[0.0, 1.0, 30.0, 31.0, 2.0, 0.0], [4.0, 4.0, 4.0, 0.5, 1.0, 4.0]]
    truth = point_sets([[(3, np.zeros(3))] for _ in places[0]])
    near = point_sets(
        [[(k, np.array([x, 0.0, 0.0])) for k, x in enumerate(both)] for both in zip(*places, strict=True)]
    )
    # Object 3 has track 0, then 1 when 0 is far, and keeps 1 although 0 comes nearer again.
    scores = followed(near, truth)
    assert near.label[scores.pairs.estimate].tolist() == [0, 0, 1, 1, 1, 1]
    assert switches(near, truth, scores) == 1


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_pairs_are_those_of_plain_code(seed, order):
    estimates, truth = crowded_run(seed)
    # Some tracks carry no identity: they neither keep an object nor are kept.
    label = np.where(estimates.label % 5 == 0, -1, estimates.label)
    estimates = PointSets(estimates.start, estimates.position, estimates.velocity, label)
    scores = followed(estimates, truth, order)
    pairs = list(zip(scores.pairs.estimate.tolist(), scores.pairs.truth.tolist(), strict=True))
    assert pairs == assign_by_hand(estimates, truth, order)
    assert scores.n_matched.tolist() == np.bincount(truth.scan[scores.pairs.truth], minlength=truth.scans).tolist()


@pytest.mark.parametrize("seed", range(5))
def test_switches_and_idf1_are_those_of_motmetrics(seed):
    motmetrics = pytest.importorskip("motmetrics")
    estimates, truth = crowded_run(seed)
    distance = np.linalg.norm(truth.position[:, None] - estimates.position[None], axis=-1)
    distance[distance >= CUTOFF] = np.nan
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    matched: dict[int, int] = {}
    scores = followed(estimates, truth)
    for scan in range(truth.scans):
        # Where two objects claim one track motmetrics gives it to the first in the list: the last that had it.
        rows = sorted(range(*truth.start[scan : scan + 2]), key=lambda row: -matched.get(truth.label[row], -1))
        columns = range(*estimates.start[scan : scan + 2])
        accumulator.update(truth.label[rows], estimates.label[columns], distance[np.ix_(rows, columns)])
        found = truth.label[scores.pairs.truth[scores.pairs.scan == scan]]
        matched |= dict.fromkeys(found.tolist(), scan)
    names = ["num_switches", "num_misses", "num_false_positives", "idf1", "idp", "idr"]
    expected = motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0]
    assert switches(estimates, truth, scores) == expected["num_switches"] > 5
    assert len(truth.label) - scores.n_matched.sum() == expected["num_misses"]
    assert len(estimates.label) - scores.n_matched.sum() == expected["num_false_positives"]
    identity = identity_score(estimates, truth, near_pairs(estimates, truth, CUTOFF))
    assert identity["idf1"] == pytest.approx(expected["idf1"])
    assert identity["id_precision"] == pytest.approx(expected["idp"])
    assert identity["id_recall"] == pytest.approx(expected["idr"])


def hota_by_hand(estimates: PointSets, truth: PointSets) -> np.ndarray:
    """HOTA by its definition (Luiten et al. 2021): HOTA, DetA, AssA, LocA at each threshold, (19, 4)."""
    distance = np.linalg.norm(truth.position[:, None] - estimates.position[None], axis=-1)
    same = truth.scan[:, None] == estimates.scan[None]
    similarity = np.where(same, np.maximum(1.0 - distance / CUTOFF, 0.0), 0.0)
    whole = similarity.sum(axis=0)[None] + similarity.sum(axis=1)[:, None] - similarity
    share = np.divide(similarity, whole, out=np.zeros_like(whole), where=whole > 0)
    objects = truth.label[:, None] == np.unique(truth.label)
    tracks = estimates.label[:, None] == np.unique(estimates.label)
    overlap = objects.T.astype(float) @ share @ tracks
    either = objects.sum(axis=0)[:, None] + tracks.sum(axis=0)[None]
    score = (objects @ (overlap / (either - overlap)) @ tracks.T) * similarity
    rows, columns = linear_sum_assignment(-np.where(same, score, 0.0))
    kept = same[rows, columns]
    rows, columns = rows[kept], columns[kept]
    out = []
    for threshold in THRESHOLDS:
        right = similarity[rows, columns] >= threshold - 1e-12
        true_positives = [
            (truth.label[x], estimates.label[e]) for x, e in zip(rows[right], columns[right], strict=True)
        ]
        count = len(true_positives)
        association = [
            true_positives.count((x, e))
            / ((truth.label == x).sum() + (estimates.label == e).sum() - true_positives.count((x, e)))
            for x, e in true_positives
        ]
        detection = count / (len(truth.label) + len(estimates.label) - count)
        mean = float(np.mean(association)) if count else 0.0
        location = float(similarity[rows, columns][right].mean()) if count else 1.0
        out.append((np.sqrt(detection * mean), detection, mean, location))
    return np.array(out)


@pytest.mark.parametrize("seed", range(3))
def test_hota_is_that_of_its_definition(seed):
    estimates, truth = crowded_run(seed, 30)
    curves = hota(estimates, truth, near_pairs(estimates, truth, CUTOFF))
    found = np.stack([curves.hota, curves.detection, curves.association, curves.localisation], axis=1)
    assert found == pytest.approx(hota_by_hand(estimates, truth), abs=1e-12)
    assert 0.1 < curves.hota.mean() < 0.9


def test_perfect_tracks_and_runs_without_estimates_or_pairs():
    _, truth = crowded_run(1)
    near = near_pairs(truth, truth, CUTOFF)
    assert identity_score(truth, truth, near)["idf1"] == 1.0
    assert hota(truth, truth, near).hota == pytest.approx(np.ones(19))
    nothing = truth.keep_points(np.zeros(len(truth.label), dtype=bool))
    far = PointSets(truth.start, truth.position + 1000.0, truth.velocity, truth.label)
    for estimates in (nothing, far):
        near = near_pairs(estimates, truth, CUTOFF)
        assert len(near.scan) == 0
        assert identity_score(estimates, truth, near)["id_recall"] == 0.0
        assert (hota(estimates, truth, near).hota == 0.0).all()
        assert followed(estimates, truth).n_matched.sum() == 0
    assert np.isnan(identity_score(nothing, truth, near)["id_precision"])
    empty = near_pairs(nothing, nothing, CUTOFF)
    assert np.isnan(identity_score(nothing, nothing, empty)["idf1"])
    assert (hota(nothing, nothing, empty).hota == 0.0).all()


def test_an_estimate_without_identity_is_a_track_of_its_own():
    truth = point_sets([[(0, np.zeros(3))] for _ in range(4)])
    estimates = point_sets([[(5 if scan < 2 else -1, np.zeros(3))] for scan in range(4)])
    near = near_pairs(estimates, truth, CUTOFF)
    assert identity_score(estimates, truth, near)["idf1"] == 0.5
    assert hota(estimates, truth, near).association == pytest.approx(np.full(19, (2 * 0.5 + 2 * 0.25) / 4))


@pytest.mark.parametrize("size", [1.0, 1e-20])
def test_pairs_of_least_cost_are_those_of_enumeration(size):
    """Small costs count as well: powers of distances far below the cutoff."""
    random = np.random.default_rng(8)
    for _ in range(30):
        is_near = random.random((3, 4)) < 0.6
        table = np.where(is_near, size * random.random((3, 4)), 1.0)
        rows, columns = np.nonzero(is_near)
        chosen = least_cost(rows, columns, table[rows, columns], 1.0)
        assert len(set(rows[chosen])) == len(set(columns[chosen])) == len(chosen)
        found = table[rows, columns][chosen].sum() + (3 - len(chosen))
        best = min(sum(table[row, order[row]] for row in range(3)) for order in permutations(range(4), 3))
        assert found == pytest.approx(best, rel=1e-9)
