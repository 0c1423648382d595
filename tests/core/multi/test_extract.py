"""Which components are reported: thresholds with hysteresis, identities in order, splitting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.disparity.moments import world_moments
from stereophd.core.multi.extract import Report, Selection, select_objects
from stereophd.core.multi.filter_settings.common import Hysteresis
from stereophd.core.multi.state.mixture import GaussianMixture, empty_mixture
from tests.core.multi.scenes import make_filter, make_mixture, random_mixture

HALF = Hysteresis(confirm=0.5, release=0.5)
SLOW = Hysteresis(confirm=0.8, release=0.1, tentative=0.8)


def select(mixture: GaussianMixture, levels: Hysteresis, next_label: int, next_track: int) -> Selection:
    """`select_objects` of a PHD filter, 0.5 s after the components; those without a disparity get one."""
    multi_filter = make_filter()
    if not mixture.means.any():
        mixture = mixture._replace(means=mixture.means + np.array([400.0, 300.0, 7.0, 0.0, 0.0, 0.0]))
    homes = multi_filter.rig.spaces(mixture.cameras, mixture.times)
    motion, samples = multi_filter.motion.arrays(np.full(mixture.size, 0.5)), multi_filter.sets.turn(0)
    report = Report(levels.confirm, levels.release, levels.tentative, True, next_label, next_track)
    return select_objects(mixture, report, np.arange(mixture.size), homes, motion, samples)


def identities(selection: Selection) -> list[int]:
    return selection.mixture.tracks[selection.components].tolist()


def test_reported_from_the_threshold_on() -> None:
    chosen = select(make_mixture([0.4999, 0.5, 0.9]), HALF, 3, 0)
    assert chosen.components.tolist() == [1, 2]
    assert chosen.existence.tolist() == [0.5, 0.9]
    assert chosen.mixture.reported.tolist() == [False, True, True]


def test_the_components_of_a_label_are_one_object() -> None:
    mixture = make_mixture([0.3, 0.4, 0.2, 0.05], labels=[7, 7, 7, 8])
    chosen = select(mixture, HALF, 9, 4)
    assert chosen.components.tolist() == [1]  # the heaviest gives the estimate
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
        chosen = select(mixture.with_weights(np.array([weight])), SLOW, 1, next_track)
        mixture, next_track = chosen.mixture, chosen.next_track
        assert (len(chosen.components) == 1) == expected
        assert mixture.reported.tolist() == [expected]
        if expected:
            assert identities(chosen) == [0]
    assert next_track == 1


def test_identities_in_order_of_confirmation() -> None:
    mixture = make_mixture([0.4, 0.9, 0.3, 0.6], labels=[10, 11, 12, 13])
    first = select(mixture, HALF, 14, 0)
    assert first.mixture.tracks.tolist() == [-1, 0, -1, 1]
    second = select(first.mixture.with_weights(np.array([0.45, 0.9, 0.7, 0.2])), HALF, 14, first.next_track)
    assert second.mixture.tracks.tolist() == [-1, 0, 2, 1]
    assert identities(second) == [0, 2]
    third = select(second.mixture.with_weights(np.full(4, 0.9)), HALF, 14, second.next_track)
    assert third.mixture.tracks.tolist() == [3, 0, 2, 1]
    assert third.next_track == 4


def test_a_second_heavy_component_of_a_label_is_another_object() -> None:
    mixture = make_mixture(
        [0.9, 0.7, 0.2, 0.6, 0.95], labels=[3, 3, 3, 3, 5], tracks=[2, 2, 2, 2, 1], reported=[True] * 5
    )
    chosen = select(mixture, HALF, 6, 3)
    # in order of weight: 0.7 gets label 6 and 0.6 label 7, both with new identities; 0.2 stays with 0.9
    assert chosen.mixture.labels.tolist() == [3, 6, 3, 7, 5]
    assert chosen.mixture.tracks.tolist() == [2, 3, 2, 4, 1]
    assert sorted(identities(chosen)) == [1, 2, 3, 4]
    assert (chosen.next_label, chosen.next_track) == (8, 5)
    existence = dict(zip(identities(chosen), chosen.existence, strict=True))
    assert existence == pytest.approx({2: 1.1, 3: 0.7, 4: 0.6, 1: 0.95})


def test_an_identity_survives_a_heavier_newborn_of_its_label() -> None:
    mixture = make_mixture([0.6, 0.3], labels=[3, 3], tracks=[-1, 8], reported=[False, True])
    chosen = select(mixture, HALF, 4, 9)
    assert chosen.components.tolist() == [0]
    assert identities(chosen) == [8]
    assert chosen.next_track == 9


def test_tentative_objects_keep_their_identity_when_they_are_confirmed() -> None:
    levels = Hysteresis(confirm=0.9, release=0.1, tentative=0.6)
    mixture, next_track = make_mixture([0.0, 0.95], labels=[4, 5]), 0
    found = []
    for weight in (0.5, 0.6, 0.89, 0.9, 0.5, 0.09, 0.7):
        chosen = select(mixture.with_weights(np.array([weight, 0.95])), levels, 6, next_track)
        mixture, next_track = chosen.mixture, chosen.next_track
        found.append({track: row >= chosen.confirmed for row, track in enumerate(identities(chosen))})
    # Object 0 is the one of label 5; the other is 1, and released once it falls below 0.1.
    assert found == [
        {0: False},
        *[{0: False, 1: unsure} for unsure in (True, True, False, False)],
        {0: False},
        *found[1:2],
    ]
    assert next_track == 2


def test_empty_mixture() -> None:
    chosen = select(empty_mixture(6), HALF, 5, 2)
    assert len(chosen.components) == len(chosen.existence) == chosen.confirmed == 0
    assert (chosen.next_label, chosen.next_track) == (5, 2)


def test_objects_are_placed_and_confirmed_ones_come_first() -> None:
    """Against `world_moments`; what is at infinity has an identity and no row."""
    levels = Hysteresis(confirm=0.9, release=0.9, tentative=0.6)
    weights = np.array([0.7, 0.95, 0.92, 0.2, 0.8, 0.99])
    drawn = random_mixture(np.random.default_rng(3), 6, charts=2)
    means = drawn.means + np.array([400.0, 300.0, 20.0, 0.0, 0.0, 0.0])
    means[2, 2] = -1.0
    mixture = make_mixture(weights, means, drawn.covariances, drawn.cameras)
    chosen = select(mixture, levels, 6, 0)
    assert chosen.components.tolist() == [1, 5, 0, 4]
    assert chosen.confirmed == 2
    assert chosen.mixture.tracks.tolist() == [0, 1, 2, -1, 3, 4]
    assert chosen.existence.tolist() == weights[chosen.components].tolist()
    multi_filter, index = make_filter(), chosen.components
    means, covariances = world_moments(
        mixture.means[index], mixture.covariances[index], multi_filter.rig.spaces(mixture.cameras[index], np.zeros(4)),
        np.full(4, 0.5), multi_filter.motion, multi_filter.sets, 0,
    )  # fmt: skip
    assert np.isfinite(means).all()
    np.testing.assert_array_equal(chosen.means, means)
    np.testing.assert_array_equal(chosen.covariances, covariances)


def test_alternatives_count_in_the_covariance_and_not_in_the_estimate() -> None:
    """P = sum_k w_k (P_k + (m_k - m) (m_k - m)^T) / sum_k w_k about the heaviest; one at infinity does not count."""
    rng = np.random.default_rng(8)
    drawn = random_mixture(rng, 5, charts=2)
    means = drawn.means + np.array([400.0, 300.0, 20.0, 0.0, 0.0, 0.0])
    means[:, 2] += [0.0, 4.0, -4.0, 0.0, 0.0]
    means[3, 2] = -1.0
    mixture = make_mixture([0.2, 0.45, 0.1, 0.15, 0.9], means, drawn.covariances, drawn.cameras, labels=[4, 4, 4, 4, 2])
    chosen = select(mixture, HALF, 5, 0)
    assert chosen.components.tolist() == [4, 1]
    multi_filter, finite = make_filter(), [0, 1, 2, 4]
    placed, covariances = world_moments(
        mixture.means[finite], mixture.covariances[finite],
        multi_filter.rig.spaces(mixture.cameras[finite], np.zeros(4)), np.full(4, 0.5), multi_filter.motion,
        multi_filter.sets, 0,
    )  # fmt: skip
    np.testing.assert_array_equal(chosen.means, placed[[3, 1]])
    np.testing.assert_array_equal(chosen.covariances[0], covariances[3])  # it has no alternative
    shares = np.array([0.2, 0.45, 0.1]) / 0.75
    apart = placed[:3] - placed[1]
    expected = np.einsum("k,kij->ij", shares, covariances[:3] + apart[:, :, None] * apart[:, None, :])
    np.testing.assert_allclose(chosen.covariances[1], expected, rtol=1e-12)
    # between two places the errors of the heaviest are far beyond its own covariance
    assert np.trace(chosen.covariances[1, :3, :3]) > 2.0 * np.trace(covariances[1, :3, :3])


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32), count=st.integers(1, 12))
def test_order_of_components_does_not_matter(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 4, count)
    tracks = np.where(rng.random(4) < 0.5, rng.permutation(4), -1)[labels]
    mixture = make_mixture(rng.random(count), labels=labels, tracks=tracks, reported=(tracks >= 0))
    order = rng.permutation(count)
    one = select(mixture, SLOW, 4, 10)
    other = select(mixture.take(order), SLOW, 4, 10)
    np.testing.assert_array_equal(one.mixture.tracks[order], other.mixture.tracks)
    np.testing.assert_array_equal(one.mixture.labels[order], other.mixture.labels)
    np.testing.assert_array_equal(one.components, order[other.components])
    # mass is only counted once, and every reported identity once
    assert one.existence.sum() <= mixture.weights.sum() + 1e-12
    assert len(set(identities(one))) == len(one.components)
    assert (one.mixture.tracks[one.components] >= 0).all()
