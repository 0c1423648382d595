"""What the alternatives for a label count when they merge: against enumeration, and the covariances that follow."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from stereophd.core.disparity.events import make_event
from stereophd.core.disparity.prior import DisparityPrior
from stereophd.core.motion.static import Static
from stereophd.core.multi.base import FilterState
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.phd.update import label_shares
from tests.core.disparity.cases import make_camera
from tests.core.multi.scenes import make_filter, make_mixture

P_DETECT = 0.7


def enumerated(
    labels: np.ndarray, weights: np.ndarray, pairs: list[tuple[int, int]], joint: np.ndarray, others: np.ndarray
) -> np.ndarray:
    """Label by label: the odds of each alternative if the label is one object among Poisson others."""
    shares = weights.copy()
    for label in {one for one in labels.tolist() if one >= 0}:
        mine = [i for i, one in enumerate(labels) if one == label]
        rows = [p for p, (i, _) in enumerate(pairs) if i in mine]
        odds = {i: weights[i] for i in mine}
        for p in rows:
            rest = others[pairs[p][1]] - sum(joint[q] for q in rows if pairs[q][1] == pairs[p][1])
            odds[len(labels) + p] = joint[p] / rest
        whole = sum(weights[k] for k in odds)
        for k, value in odds.items():
            shares[k] = value * whole / sum(odds.values())
    return shares


@pytest.mark.parametrize("seed", range(10))
def test_against_enumeration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 5, 12)
    pairs = [(i, j) for i in range(12) for j in range(6) if rng.uniform() < 0.3]
    components, detections = np.array(pairs).T
    joint = rng.uniform(0.1, 2.0, len(pairs))
    least = 0.05
    others = least + np.bincount(detections, joint, 6)
    missed, newborn = rng.uniform(0.0, 0.3, 12), rng.uniform(0.0, 0.1, 6)
    weights = np.concatenate([missed, joint / others[detections], newborn])
    shares = label_shares(labels, weights, components, detections, joint, others, least)
    np.testing.assert_allclose(shares, enumerated(labels, weights, pairs, joint, others), rtol=1e-9)
    for label in range(5):
        rows = np.concatenate([labels == label, labels[components] == label, np.zeros(6, dtype=bool)])
        assert shares[rows].sum() == pytest.approx(weights[rows].sum(), rel=1e-12)


def test_without_clutter_and_births_nothing_else_made_the_detection() -> None:
    """Nothing is divided by zero, and the label was not missed."""
    labels, one = np.array([3]), np.array([0])
    shares = label_shares(labels, np.array([0.3, 1.0]), one, one, np.array([0.02]), np.array([0.02]), 0.0)
    np.testing.assert_allclose(shares, [0.0, 1.3], atol=1e-9)


def one_camera(**settings: object) -> PhdFilter:
    """A camera before still objects: everything is linear."""
    birth = BirthPrior(disparity=DisparityPrior(mean_px=7.0, std_px=3.0), velocity_std=1.0)
    camera = make_camera(p_detect=P_DETECT, sigma=(1.0, 1.0))
    return make_filter([camera], Static(), birth=birth, births=1e-12, survival_per_s=1.0, **settings)


def seen(multi_filter: PhdFilter, state: FilterState, pixels: np.ndarray, time_s: float = 0.0) -> FilterState:
    """The state after an event."""
    event = make_event(multi_filter.rig.cameras[0], 0, time_s, pixels)
    return multi_filter.step(state, event)[0]


def test_moments_are_those_of_one_object_that_may_be_missed() -> None:
    """Two alternatives for an object, one detection and clutter: all parts merged, by hand."""
    multi_filter = one_camera(merge_distance=1e6)
    means = np.array([[400.0, 300.0, 7.0], [402.0, 299.0, 7.5]])
    covariances = np.array([np.diag([4.0, 4.0, 1.0]), np.diag([9.0, 9.0, 2.0])])
    mixture = make_mixture([0.5, 0.4], means, covariances, labels=[3, 3], size=3)
    point = np.array([401.5, 301.0])
    after = seen(multi_filter, FilterState(mixture, 0.0, 1, 9, 9), point[None]).mixture
    parts = []
    clutter = 10.0 / (800.0 * 600.0)
    for weight, mean, covariance in zip(mixture.weights, means, covariances, strict=True):
        innovation = covariance[:2, :2] + np.eye(2)
        gain = covariance[:, :2] @ np.linalg.inv(innovation)
        density = multivariate_normal(mean[:2], innovation).pdf(point)
        parts.append((weight * (1.0 - P_DETECT), mean, covariance))
        updated = (mean + gain @ (point - mean[:2]), covariance - gain @ covariance[:2])
        parts.append((weight * P_DETECT * density / clutter, *updated))
    odds = np.array([part[0] for part in parts]) / sum(part[0] for part in parts)
    mean = sum(share * part[1] for share, part in zip(odds, parts, strict=True))
    second = sum(share * (part[2] + np.outer(part[1], part[1])) for share, part in zip(odds, parts, strict=True))
    assert after.size == 1
    np.testing.assert_allclose(after.means[0], mean, rtol=1e-10)
    np.testing.assert_allclose(after.covariances[0], second - np.outer(mean, mean), rtol=1e-8, atol=1e-9)


def test_covariances_are_as_large_as_the_errors_though_detections_are_missed() -> None:
    """NEES of the image position of still objects over 150 runs of 15 frames: 2; below 1.6 with textbook moments."""
    nees = {}
    for moments in ("label", "intensity"):
        multi_filter = one_camera(merge_moments=moments)
        rng, found = np.random.default_rng(11), []
        for _ in range(150):
            truth = np.array([400.0, 300.0])
            mean = np.append(rng.normal(truth, 3.0), 7.0)
            mixture = make_mixture([1.0], mean[None], np.diag([9.0, 9.0, 1.0])[None], size=3)
            state = FilterState(mixture, 0.0, 1, 9, 9)
            for k in range(1, 16):
                own = rng.normal(truth, 1.0)[None] if rng.uniform() < P_DETECT else np.empty((0, 2))
                false = rng.uniform([0.0, 0.0], [800.0, 600.0], (rng.poisson(10.0), 2))
                state = seen(multi_filter, state, np.concatenate([own, false]), float(k))
            best = int(np.argmax(state.mixture.weights))
            error = state.mixture.means[best, :2] - truth
            found.append(error @ np.linalg.solve(state.mixture.covariances[best, :2, :2], error))
        nees[moments] = float(np.mean(found))
    # the standard error of the mean of 150 values of variance 4 is 0.16
    assert nees["label"] == pytest.approx(2.0, abs=0.5)
    assert nees["intensity"] < 1.6
