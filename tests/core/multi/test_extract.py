"""Which components are reported: thresholds with hysteresis, identities in order, splitting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.multi.extract import Selection, select_objects
from stereophd.core.multi.filter_settings.common import Hysteresis
from stereophd.core.multi.mixture import empty_mixture
from tests.core.multi.scenes import make_mixture

HALF = Hysteresis(confirm=0.5, release=0.5)
SLOW = Hysteresis(confirm=0.8, release=0.1, tentative=0.8)


def identities(selection: Selection) -> list[int]:
    return selection.mixture.tracks[selection.index].tolist()


def test_reported_from_the_threshold_on() -> None:
    chosen = select_objects(make_mixture([0.4999, 0.5, 0.9]), HALF, 3, 0)
    assert chosen.index.tolist() == [1, 2]
    assert chosen.existence.tolist() == [0.5, 0.9]
    assert chosen.mixture.reported.tolist() == [False, True, True]


def test_the_components_of_a_label_are_one_object() -> None:
    mixture = make_mixture([0.3, 0.4, 0.2, 0.05], labels=[7, 7, 7, 8])
    chosen = select_objects(mixture, HALF, 9, 4)
    assert chosen.index.tolist() == [1]  # the heaviest gives the estimate
    assert chosen.existence.tolist() == pytest.approx([0.9])
    assert chosen.mixture.tracks.tolist() == [4, 4, 4, -1]
    assert chosen.mixture.reported.tolist() == [True, True, True, False]
    assert (chosen.next_label, chosen.next_track) == (9, 5)


@pytest.mark.parametrize(
    ("weights", "shown"),
    [
        ([0.79, 0.9, 0.2, 0.1, 0.09, 0.5, 0.79, 0.8], [False, True, True, True, False, False, False, True]),
        ([0.05, 0.79, 0.8, 0.11, 0.1], [False, False, True, True, True]),
    ],
)
def test_hysteresis(weights: list[float], shown: list[bool]) -> None:
    """Reported from 0.8 until it falls below 0.1, then from 0.8 again, under the same identity."""
    mixture, next_track = make_mixture([0.0]), 0
    for weight, expected in zip(weights, shown, strict=True):
        chosen = select_objects(mixture.with_weights(np.array([weight])), SLOW, 1, next_track)
        mixture, next_track = chosen.mixture, chosen.next_track
        assert (len(chosen.index) == 1) == expected
        assert mixture.reported.tolist() == [expected]
        if expected:
            assert identities(chosen) == [0]
    assert next_track == 1


def test_identities_in_order_of_confirmation() -> None:
    mixture = make_mixture([0.4, 0.9, 0.3, 0.6], labels=[10, 11, 12, 13])
    first = select_objects(mixture, HALF, 14, 0)
    assert first.mixture.tracks.tolist() == [-1, 0, -1, 1]
    second = select_objects(first.mixture.with_weights(np.array([0.45, 0.9, 0.7, 0.2])), HALF, 14, first.next_track)
    assert second.mixture.tracks.tolist() == [-1, 0, 2, 1]
    assert identities(second) == [0, 2]
    third = select_objects(second.mixture.with_weights(np.full(4, 0.9)), HALF, 14, second.next_track)
    assert third.mixture.tracks.tolist() == [3, 0, 2, 1]
    assert third.next_track == 4


def test_a_second_heavy_component_of_a_label_is_another_object() -> None:
    mixture = make_mixture(
        [0.9, 0.7, 0.2, 0.6, 0.95], labels=[3, 3, 3, 3, 5], tracks=[2, 2, 2, 2, 1], reported=[True] * 5
    )
    chosen = select_objects(mixture, HALF, 6, 3)
    # in order of weight: 0.7 gets label 6 and 0.6 label 7, both with new identities; 0.2 stays with 0.9
    assert chosen.mixture.labels.tolist() == [3, 6, 3, 7, 5]
    assert chosen.mixture.tracks.tolist() == [2, 3, 2, 4, 1]
    assert sorted(identities(chosen)) == [1, 2, 3, 4]
    assert (chosen.next_label, chosen.next_track) == (8, 5)
    existence = dict(zip(identities(chosen), chosen.existence, strict=True))
    assert existence == pytest.approx({2: 1.1, 3: 0.7, 4: 0.6, 1: 0.95})


def test_an_identity_survives_a_heavier_newborn_of_its_label() -> None:
    mixture = make_mixture([0.6, 0.3], labels=[3, 3], tracks=[-1, 8], reported=[False, True])
    chosen = select_objects(mixture, HALF, 4, 9)
    assert chosen.index.tolist() == [0]
    assert identities(chosen) == [8]
    assert chosen.next_track == 9


def test_tentative_objects_keep_their_identity_when_they_are_confirmed() -> None:
    levels = Hysteresis(confirm=0.9, release=0.1, tentative=0.6)
    mixture, next_track = make_mixture([0.0, 0.95], labels=[4, 5]), 0
    found = []
    for weight in (0.5, 0.6, 0.89, 0.9, 0.5, 0.09, 0.7):
        chosen = select_objects(mixture.with_weights(np.array([weight, 0.95])), levels, 6, next_track)
        mixture, next_track = chosen.mixture, chosen.next_track
        found.append(dict(zip(identities(chosen), chosen.tentative.tolist(), strict=True)))
    # Object 0 is the one of label 5; the other is 1, and released once it falls below 0.1.
    assert found == [
        {0: False},
        *[{0: False, 1: unsure} for unsure in (True, True, False, False)],
        {0: False},
        *found[1:2],
    ]
    assert next_track == 2


def test_empty_mixture() -> None:
    chosen = select_objects(empty_mixture(6), HALF, 5, 2)
    assert len(chosen.index) == len(chosen.existence) == len(chosen.tentative) == 0
    assert (chosen.next_label, chosen.next_track) == (5, 2)


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 12))
def test_order_of_components_does_not_matter(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 4, count)
    tracks = np.where(rng.random(4) < 0.5, rng.permutation(4), -1)[labels]
    mixture = make_mixture(rng.random(count), labels=labels, tracks=tracks, reported=(tracks >= 0))
    order = rng.permutation(count)
    one = select_objects(mixture, SLOW, 4, 10)
    other = select_objects(mixture.take(order), SLOW, 4, 10)
    np.testing.assert_array_equal(one.mixture.tracks[order], other.mixture.tracks)
    np.testing.assert_array_equal(one.mixture.labels[order], other.mixture.labels)
    np.testing.assert_array_equal(one.index, order[other.index])
    # mass is only counted once, and every reported identity once
    assert one.existence.sum() <= mixture.weights.sum() + 1e-12
    assert len(set(identities(one))) == len(one.index)
    assert (one.mixture.tracks[one.index] >= 0).all()
