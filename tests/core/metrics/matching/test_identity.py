"""Purity of tracks and completeness of objects: by hand, and against counting one pair at a time."""

from __future__ import annotations

from collections import Counter

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.metrics.identities import PartnerCounts, tabulate

NOTHING = np.zeros(0, dtype=np.int64)


def of_tracks(label: np.ndarray, pair_track: np.ndarray, pair_object: np.ndarray) -> PartnerCounts:
    return tabulate(label[label >= 0], pair_track[pair_track >= 0], pair_object[pair_track >= 0])


def of_objects(truth: np.ndarray, pair_track: np.ndarray, pair_object: np.ndarray) -> PartnerCounts:
    return tabulate(truth, pair_object, pair_track, pair_track >= 0)


def test_by_hand():
    # Track 5: 4 estimates, twice on object 1, once on 2, once false. 6: false. 9: on object 2 only.
    label = np.array([5, 5, 5, 5, 6, 6, 9, -1])
    pair_track = np.array([5, 5, 5, 9, -1])
    pair_object = np.array([1, 2, 1, 2, 1])
    tracks = of_tracks(label, pair_track, pair_object)
    assert tracks.identity.tolist() == [5, 6, 9]
    assert tracks.n_points.tolist() == [4, 2, 1]
    assert tracks.n_matched.tolist() == [3, 0, 1]
    assert tracks.partner[[0, 2]].tolist() == [1, 2]
    assert tracks.n_dominant.tolist() == [2, 0, 1]
    assert tracks.share_dominant.tolist() == [0.5, 0.0, 1.0]
    # Object 1 exists at 4 scans, 2 at 2 (both of its tracks equally often: the smaller), 3 is never found.
    objects = of_objects(np.array([1, 2, 1, 2, 1, 1, 3]), pair_track, pair_object)
    assert objects.identity.tolist() == [1, 2, 3]
    assert objects.partner[:2].tolist() == [5, 5]
    assert objects.share_matched.tolist() == [0.75, 1.0, 0.0]
    assert objects.share_dominant.tolist() == [0.5, 0.5, 0.0]
    assert objects.n_partners.tolist() == [1, 2, 0]


def test_nothing():
    tracks = of_tracks(NOTHING, NOTHING, NOTHING)
    assert len(tracks.share_dominant) == 0
    objects = of_objects(np.array([4, 4]), NOTHING, NOTHING)
    assert objects.share_matched.tolist() == objects.share_dominant.tolist() == [0.0]


# One scan: {object: track that is matched to it, or None}
SCAN = st.dictionaries(st.integers(-3, 4), st.one_of(st.none(), st.integers(-1, 5)), max_size=5)


@settings(max_examples=100)
@given(scans=st.lists(SCAN, max_size=12), false=st.lists(st.integers(-1, 7), max_size=9))
def test_as_counted_one_by_one(scans, false):
    pairs = [(track, thing) for scan in scans for thing, track in scan.items() if track is not None]
    truth = [thing for scan in scans for thing in scan]
    label = [track for track, _ in pairs] + false
    pair_track, pair_object = (
        np.array(column, dtype=np.int64) for column in (zip(*pairs, strict=True) if pairs else ((), ()))
    )
    tracks = of_tracks(np.array(label, dtype=np.int64), pair_track, pair_object)
    assert tracks.identity.tolist() == sorted({track for track in label if track >= 0})
    for row, track in enumerate(tracks.identity.tolist()):
        count = Counter(thing for own, thing in pairs if own == track)
        assert tracks.n_points[row] == label.count(track)
        assert tracks.n_matched[row] == count.total()
        assert tracks.n_dominant[row] == max(count.values(), default=0)
        if count:
            best = min(thing for thing, times in count.items() if times == max(count.values()))
            assert tracks.partner[row] == best
    objects = of_objects(np.array(truth, dtype=np.int64), pair_track, pair_object)
    assert objects.identity.tolist() == sorted(set(truth))
    for row, thing in enumerate(objects.identity.tolist()):
        count = Counter(track for track, other in pairs if other == thing and track >= 0)
        assert objects.n_points[row] == truth.count(thing)
        assert objects.n_matched[row] == sum(other == thing for _, other in pairs)
        assert objects.n_partners[row] == len(count)
        assert objects.n_dominant[row] == max(count.values(), default=0)
        if count:
            best = min(track for track, times in count.items() if times == max(count.values()))
            assert objects.partner[row] == best
    assert ((objects.share_dominant <= objects.share_matched) & (objects.share_matched <= 1)).all()
    assert ((tracks.share_dominant >= 0) & (tracks.share_dominant <= 1)).all()
