"""The adaptive choice between a low-order rule and samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import IN_VIEW, PARTLY_IN_VIEW
from stereophd.core.geometry.region import box_half_spaces, pack_region
from stereophd.core.numerics.samples import SampleSets, cubature_points
from tests.core.disparity.moves import Case, figure_7, nearly_linear, sample_sets


def nonlinearity(case: Case) -> float:
    """The measure of `stereophd.core.disparity.rule_move` in plain NumPy."""
    rows = 12 if len(case.mean) == 6 else 3
    points, _ = case.trip(np.concatenate([cubature_points(rows), np.zeros((rows, 1))], axis=1))
    images, center = points[:-1], points[-1]
    even = (images[:rows] + images[rows:]) / 2.0 - center
    covariance = np.cov(images.T, bias=True)
    return float(np.sqrt(np.sum(even * np.linalg.solve(covariance, even.T).T)) / rows)


def limited(sets: SampleSets, limit: float) -> SampleSets:
    return replace(sets, max_nonlinearity=limit)


@pytest.mark.parametrize("size", [3, 6])
@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_the_limit_decides_between_the_rule_and_samples(size: int, scale: float) -> None:
    """Just above the measure a component is moved by the rule, just below it by samples."""
    case = nearly_linear(size)
    case = replace(case, covariance=case.covariance * scale**2)
    measure = nonlinearity(case)
    assert 1e-5 < measure < 0.1
    sets = sample_sets("adaptive", 64, case.motion)
    by_rule = case.move(limited(sets, measure * 1.0001))
    by_samples = case.move(limited(sets, measure * 0.9999))
    rule, samples = (case.move(sample_sets(method, 64, case.motion)) for method in ("unscented", "qmc"))
    np.testing.assert_array_equal(by_rule.means, rule.means)
    np.testing.assert_array_equal(by_rule.covariances, rule.covariances)
    np.testing.assert_array_equal(by_samples.means, samples.means)
    np.testing.assert_array_equal(by_samples.covariances, samples.covariances)


def test_the_measure_grows_with_the_spread() -> None:
    """To second order the curvature of a standard deviation is proportional to it."""
    case = nearly_linear(3)
    small, large = (nonlinearity(replace(case, covariance=case.covariance * s**2)) for s in (0.1, 0.2))
    assert large / small == pytest.approx(2.0, rel=0.01)


def test_wide_components_are_sampled() -> None:
    """Figure 7: disparity known to 40 %; the whole of it is far from linear."""
    case = figure_7()
    assert nonlinearity(case) > 0.03
    adaptive, samples = (case.move(sample_sets(method, 64, case.motion)) for method in ("adaptive", "qmc"))
    np.testing.assert_array_equal(adaptive.means, samples.means)
    assert adaptive.status[0] in (IN_VIEW, PARTLY_IN_VIEW)


def test_across_the_border_of_the_image_components_are_sampled() -> None:
    case = nearly_linear(3)
    for _ in range(4):
        image = case.trip(np.zeros((3, 1)))[0][0]
        case = replace(case, mean=case.mean + [799.4 - image[0], 0.0, 0.0])
    adaptive, samples = (case.move(sample_sets(method, 64, case.motion), 0, 0.9) for method in ("adaptive", "qmc"))
    assert 0.0 < adaptive.fraction[0] < 1.0
    np.testing.assert_array_equal(adaptive.means, samples.means)
    np.testing.assert_array_equal(adaptive.missed_covariances, samples.missed_covariances)


def test_outside_the_region_components_are_sampled() -> None:
    case = nearly_linear(6)
    region = pack_region((0.0, np.inf), box_half_spaces({"x": (-50.0, 50.0), "y": (-50.0, 50.0), "z": (0.0, 110.0)}))
    moved = [
        move(
            case.sources, case.destination.packed(), sample_sets(method, 64, case.motion), 0, region=region
        )
        for method in ("adaptive", "qmc")
    ]  # fmt: skip
    assert 0.0 < moved[0].inside[0] < 1.0
    np.testing.assert_array_equal(moved[0].means, moved[1].means)
