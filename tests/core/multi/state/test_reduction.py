"""Mixture reduction against a naive version: pruning, merging within a chart, the cap, identities."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.multi.phd.update import PhdReduction, reduce_intensity
from stereophd.core.multi.state.mixture import GaussianMixture, concatenate
from tests.core.multi.phd.textbook import reduce
from tests.core.multi.scenes import make_mixture, random_mixture


def reduce_mixture(
    mixture: GaussianMixture, prune_weight: float, distance: float, most: int
) -> tuple[GaussianMixture, int]:
    """Reduce with the moments of the intensity."""
    return reduce_intensity(mixture, mixture.weights, PhdReduction(prune_weight, distance, most, False))


def by_chart(mixture: GaussianMixture) -> dict[tuple[int, float], list]:
    charts: dict[tuple[int, float], list] = {}
    for k in range(mixture.size):
        component = (mixture.weights[k], mixture.means[k], mixture.covariances[k])
        charts.setdefault((int(mixture.cameras[k]), float(mixture.times[k])), []).append(component)
    return charts


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("seed", range(5))
def test_against_the_naive_version_chart_by_chart(seed: int, size: int) -> None:
    mixture = random_mixture(np.random.default_rng(seed), 80, size, spread=1.2)
    found, _ = reduce_mixture(mixture, 1e-3, 7.0, 1000)
    assert 10 < found.size < (mixture.weights >= 1e-3).sum()
    found_charts = by_chart(found)
    for chart, components in by_chart(mixture).items():
        expected = reduce(components, 1e-3, 7.0, 1000)
        assert len(found_charts[chart]) == len(expected)
        for (w, m, p), (w_e, m_e, p_e) in zip(found_charts[chart], expected, strict=True):
            assert w == pytest.approx(w_e, rel=1e-12)
            np.testing.assert_allclose(m, m_e, rtol=1e-10, atol=1e-12)
            np.testing.assert_allclose(p, p_e, rtol=1e-10, atol=1e-12)


def test_a_known_place_stays_apart_from_a_vague_one() -> None:
    covariances = [np.eye(3) * 0.01, np.eye(3) * 4.0]
    mixture = make_mixture([0.9, 0.1], [[0.0, 0, 0], [1.0, 0, 0]], covariances, size=3)
    assert reduce_mixture(mixture, 1e-6, 7.0, 10)[0].size == 2


def test_only_the_same_chart_merges() -> None:
    mixture = make_mixture([0.5, 0.4, 0.3, 0.2], cameras=[0, 1, 0, 0], times=[1.0, 1.0, 2.0, 1.0])
    found, _ = reduce_mixture(mixture, 1e-6, 7.0, 10)
    assert found.weights.tolist() == pytest.approx([0.7, 0.4, 0.3])
    assert found.cameras.tolist() == [0, 1, 0]
    assert found.times.tolist() == [1.0, 1.0, 2.0]


def test_merging_keeps_mass_and_moments() -> None:
    mixture = random_mixture(np.random.default_rng(9), 40, charts=1, spread=0.5)
    mixture = make_mixture(mixture.weights, mixture.means, mixture.covariances)
    found, _ = reduce_mixture(mixture, 0.0, 1e6, 1000)
    assert found.size == 1
    assert found.weights[0] == pytest.approx(mixture.weights.sum(), rel=1e-12)
    share = mixture.weights / mixture.weights.sum()
    mean = share @ mixture.means
    second = np.einsum("k,kab->ab", share, mixture.covariances + np.einsum("ka,kb->kab", mixture.means, mixture.means))
    np.testing.assert_allclose(found.means[0], mean, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.covariances[0], second - np.outer(mean, mean), rtol=1e-10, atol=1e-12)


def test_shares_decide_moments_and_weights_decide_the_rest() -> None:
    mixture = make_mixture([0.2, 0.7], np.array([0.0, 1.0])[:, None] * np.ones(6), labels=[4, 5])
    found, _ = reduce_intensity(mixture, np.array([0.6, 0.2]), PhdReduction(1e-6, 7.0, 10, True))
    assert found.weights.tolist() == pytest.approx([0.9])
    assert found.labels.tolist() == [5]
    np.testing.assert_allclose(found.means[0], 0.25)
    expected = 0.75 * mixture.covariances[0] + 0.25 * mixture.covariances[1] + 0.75 * 0.25
    np.testing.assert_allclose(found.covariances[0], expected, atol=1e-12)


def test_a_merged_component_keeps_the_identity_of_its_heaviest_part() -> None:
    mixture = make_mixture([0.2, 0.7, 0.1], labels=[4, 5, 6], tracks=[1, -1, 2], reported=[True, False, True])
    found, _ = reduce_mixture(mixture, 1e-6, 7.0, 10)
    assert (found.labels.tolist(), found.tracks.tolist(), found.reported.tolist()) == ([5], [-1], [False])


def test_pruning_at_the_threshold() -> None:
    means = np.arange(4)[:, None] * 100.0 * np.ones(6)
    found, _ = reduce_mixture(make_mixture([1e-6, 0.999e-6, 0.5, 0.0], means), 1e-6, 7.0, 10)
    assert found.weights.tolist() == [0.5, 1e-6]


def test_the_cap_keeps_the_heaviest() -> None:
    rng = np.random.default_rng(3)
    weights = rng.uniform(0.1, 1.0, 30)
    means = np.arange(30)[:, None] * 100.0 * np.ones(6)
    found, _ = reduce_mixture(make_mixture(weights, means), 1e-6, 7.0, 12)
    assert found.weights.tolist() == sorted(weights, reverse=True)[:12]
    # a component that is heavy only after merging counts with all its weight
    weights = np.array([0.5, 0.4, 0.3, 0.3])
    means = np.array([0.0, 100.0, 200.0, 200.0])[:, None] * np.ones(6)
    found, _ = reduce_mixture(make_mixture(weights, means), 1e-6, 7.0, 2)
    assert sorted(found.weights) == pytest.approx([0.5, 0.6])


def test_no_merging_at_distance_zero() -> None:
    found, _ = reduce_mixture(make_mixture([0.5, 0.5, 0.5]), 1e-6, 0.0, 10)
    assert found.size == 3


@pytest.mark.parametrize("weights", [[], [1e-9, 0.0]])
def test_nothing_left(weights: list[float]) -> None:
    mixture = concatenate([make_mixture([0.1]).take(np.empty(0, dtype=np.intp)), make_mixture([0.1, 0.1])])
    mixture = mixture.take(np.arange(len(weights))).with_weights(np.array(weights))
    found, _ = reduce_mixture(mixture, 1e-6, 7.0, 10)
    assert found.size == 0
    assert found.means.shape == (0, 6)
