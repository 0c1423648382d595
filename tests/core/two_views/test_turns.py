"""The likelihood ratios of turns against their definition in NumPy."""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal

from stereophd.core.two_views.responses import Pinhole
from stereophd.core.two_views.turns import all_turns, frame_ratios, turn_ratios


def test_ratios_are_those_of_the_mixture_of_detections() -> None:
    rng = np.random.default_rng(4)
    points, detections = rng.uniform(100.0, 500.0, (3, 2)), rng.uniform(100.0, 500.0, (6, 2))
    detections[:3] = points + rng.normal(0.0, 3.0, (3, 2))
    roots = rng.normal(0.0, 2.0, (3, 2, 2))
    covariances = roots @ np.swapaxes(roots, 1, 2) + np.eye(2)
    fx, fy, cx, cy = 650.0, 640.0, 320.0, 240.0
    turns, missed, weight = all_turns(), 0.1, 4e4
    camera = Pinhole(np.eye(3), np.zeros(3), fx, fy, cx, cy)
    found, likely = turn_ratios(points, covariances, detections, camera, turns, missed, weight)

    def likelihood(point: np.ndarray, covariance: np.ndarray) -> float:
        return missed + weight * sum(multivariate_normal.pdf(each, point, covariance) for each in detections)

    for h in (0, 17, 100, len(turns.spread) - 70, len(turns.spread) - 1):
        for i in range(3):
            away = (points[i] - (cx, cy)) / (fx, fy)
            moved = points[i] + (turns.shifts[h] + away @ turns.linear[h]) * (fx, fy)
            widened = covariances[i] + (turns.spread[h] * fx) ** 2 * np.eye(2)
            expected = np.log(likelihood(moved, widened) / likelihood(points[i], covariances[i]))
            # what is beyond seven standard deviations is left out
            np.testing.assert_allclose(found[i, h], expected, atol=1e-6)
            densities = [multivariate_normal.pdf(each, moved, widened) for each in detections]
            assert likely[i, h] == (int(np.argmax(densities)) if max(densities) > 1e-12 else likely[i, h])
            still = likelihood(points[i], covariances[i])
            np.testing.assert_allclose(found[i, -1], -np.log(still), atol=1e-6)


def test_a_detection_speaks_for_one_track() -> None:
    """Of objects that hid together, one false detection near all of them, after some turn, spoke for all."""
    turns, camera = all_turns(), Pinhole(np.eye(3), np.zeros(3), 650.0, 650.0, 320.0, 240.0)
    points, covariances = (
        np.array([[300.0, 200.0], [305.0, 200.0], [300.0, 206.0]]),
        np.tile(9.0 * np.eye(2), (3, 1, 1)),
    )
    turn = int(np.argmin(np.linalg.norm(turns.shifts - [0.1, 0.0], axis=1)))
    moved = points + turns.shifts[turn] * 650.0
    one, all_three = (
        frame_ratios(*turn_ratios(points, covariances, seen, camera, turns, 0.1, 4e5), 2.0)[turn]
        for seen in (moved[:1], moved)
    )
    assert one <= 0.0
    assert all_three > 10.0
    # what hides all of them is as probable as a turn without detections
    ratios, _ = turn_ratios(points, covariances, moved, camera, turns, 0.1, 4e5)
    np.testing.assert_allclose(all_three, ratios[:, turn].sum() + 3.0 * np.log(0.1))
