"""Likelihoods of pairs and Kalman updates against SciPy and NumPy; densities over the distorted image."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.rolling import NO_READINGS
from stereophd.core.multi.association.likelihoods import (
    ALL_PAIRS,
    REACH_SIGMAS,
    kalman_updates,
    pair_likelihoods,
)
from tests.core.disparity.cases import LENSES, make_camera, random_covariance


def pairs_of(rng: np.random.Generator, size: int, components: int = 20, count: int = 30) -> tuple[np.ndarray, ...]:
    """Components, which of them are seen, and detections with noises and areas of their own, ordered by u."""
    means = rng.uniform(0.0, 100.0, (components, size))
    covariances = np.stack([random_covariance(rng, rng.uniform(0.5, 8.0, size)) for _ in range(components)])
    seen = rng.random(components) < 0.7
    points = rng.uniform(0.0, 100.0, (count, 2))
    points = points[np.argsort(points[:, 0])]
    noises = np.stack([random_covariance(rng, rng.uniform(0.5, 3.0, 2)) for _ in range(count)])
    return means, covariances, seen, points, noises, rng.uniform(0.5, 2.0, count)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("noise", ["own", "some common", "common"])
def test_pair_likelihoods(size: int, seed: int, noise: str) -> None:
    means, covariances, seen, points, noises, areas = pairs_of(np.random.default_rng(seed), size)
    if noise != "own":
        noises[:: 1 if noise == "common" else 3] = noises[0]
        noises[1 :: 1 if noise == "common" else 3] = noises[0]
    components, detections, densities = pair_likelihoods(
        means, covariances, seen, points, noises, areas, NO_READINGS, ALL_PAIRS
    )
    found = np.zeros((len(means), len(points)))
    found[components, detections] = densities
    assert len(set(zip(components.tolist(), detections.tolist(), strict=True))) == len(components)
    order = np.lexsort((detections, components))
    assert order.tolist() == list(range(len(order)))
    for k in range(len(means)):
        for j in range(len(points)):
            covariance = covariances[k, :2, :2] + noises[j]
            difference = points[j] - means[k, :2]
            distance = np.sqrt(difference @ np.linalg.solve(covariance, difference))
            if seen[k] and distance <= REACH_SIGMAS:
                density = areas[j] * multivariate_normal.pdf(points[j], means[k, :2], covariance)
                assert found[k, j] == pytest.approx(density, rel=1e-9)
            else:
                assert found[k, j] == 0.0
    assert 20 < np.count_nonzero(found) < seen.sum() * len(points)


@pytest.mark.parametrize("most", [1, 7])
def test_of_many_pairs_the_densest_are_kept(most: int) -> None:
    """Of each component, in the order of the detections."""
    means, covariances, seen, points, noises, areas = pairs_of(np.random.default_rng(3), 6, 6, 400)
    covariances[:3] *= 400.0
    whole = pair_likelihoods(means, covariances, seen, points, noises, areas, NO_READINGS, ALL_PAIRS)
    found = pair_likelihoods(means, covariances, seen, points, noises, areas, NO_READINGS, most)
    assert np.bincount(whole[0]).max() > 100
    expected = []
    for k in np.unique(whole[0]):
        here = np.flatnonzero(whole[0] == k)
        expected += sorted(here[np.argsort(-whole[2][here])[:most]].tolist())
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_array_equal(one, other[expected])


def test_what_is_left_out_is_below_rounding() -> None:
    assert np.exp(-0.5 * REACH_SIGMAS**2) < 1e-17


@pytest.mark.parametrize("size", [3, 6])
def test_kalman_updates(size: int) -> None:
    rng = np.random.default_rng(5)
    means, covariances, _, points, noises, _ = pairs_of(rng, size)
    components, detections = rng.integers(0, 20, 50), rng.integers(0, 30, 50)
    found_means, found, rows = kalman_updates(means, covariances, components, detections, points, noises, NO_READINGS)
    found_covariances = found[rows]
    h = np.eye(2, size)
    for i, (k, j) in enumerate(zip(components, detections, strict=True)):
        gain = covariances[k] @ h.T @ np.linalg.inv(h @ covariances[k] @ h.T + noises[j])
        joseph = np.eye(size) - gain @ h
        expected = joseph @ covariances[k] @ joseph.T + gain @ noises[j] @ gain.T
        np.testing.assert_allclose(found_means[i], means[k] + gain @ (points[j] - h @ means[k]), rtol=1e-10)
        np.testing.assert_allclose(found_covariances[i], expected, rtol=1e-9, atol=1e-10)
        assert np.array_equal(found_covariances[i], found_covariances[i].T)
        np.linalg.cholesky(found_covariances[i])


@pytest.mark.parametrize("read", [False, True])
@pytest.mark.parametrize("size", [3, 6])
def test_updates_share_covariances(size: int, read: bool) -> None:
    """The same bits as one by one; one covariance for pairs that follow one another and have equal ones."""
    rng = np.random.default_rng(6)
    means, covariances, _, points, noises, _ = pairs_of(rng, size)
    noises[10:20] = noises[10]
    components, detections = np.repeat(np.arange(20), 30), np.tile(np.arange(30), 20)
    readings = rng.uniform(0.0, 0.03, (30, 3)) if read else NO_READINGS
    arguments = means, covariances, components, detections, points, noises, readings
    found_means, found, rows = kalman_updates(*arguments)
    for i, pair in enumerate(zip(components, detections, strict=True)):
        one = kalman_updates(means, covariances, *(np.array([each]) for each in pair), points, noises, readings)
        np.testing.assert_array_equal(found_means[i], one[0][0])
        np.testing.assert_array_equal(found[rows[i]], one[1][0])
    assert len(found) == 20 * (30 if read else 21)


@pytest.mark.parametrize("components", [0, 3])
@pytest.mark.parametrize("count", [0, 4])
def test_nothing_to_pair(components: int, count: int) -> None:
    arguments = (
        np.zeros((components, 6)), np.tile(np.eye(6), (components, 1, 1)), np.ones(components, dtype=bool),
        np.zeros((count, 2)), np.tile(np.eye(2), (count, 1, 1)), np.ones(count),
        NO_READINGS, ALL_PAIRS,
    )  # fmt: skip
    found, detections, densities = pair_likelihoods(*arguments)
    assert len(found) == len(detections) == len(densities) == components * count


@pytest.mark.parametrize("lens", list(LENSES))
def test_densities_are_per_distorted_pixel(lens: str) -> None:
    """Summed over the pixels of the distorted image the density of one component is 1, whatever the lens."""
    camera = make_camera(lens=LENSES[lens], sigma=(1.0, 1.0))
    # near a corner of the image, where a lens magnifies or shrinks most
    mean = np.array([[680.0, 520.0, 5.0]])
    center = camera.distort_pixels(mean[:, :2])[0][0]
    grid = np.stack(np.meshgrid(*[np.arange(-30.0, 31.0)] * 2), axis=-1).reshape(-1, 2)
    event = make_event(camera, 0, 0.0, np.round(center) + grid)
    covariance = np.diag([16.0, 9.0, 1.0])[None]
    _, _, densities = pair_likelihoods(
        mean, covariance, np.ones(1, dtype=bool), event.points, event.covariances, event.areas, NO_READINGS, ALL_PAIRS
    )
    # 1 %: the noise, carried through the lens, varies a little over the component
    assert densities.sum() == pytest.approx(1.0, abs=0.01)
    # the lenses do change areas here: without `areas` the sum would be off
    assert (abs(event.areas.mean() - 1.0) > 0.03) == (lens != "none")
