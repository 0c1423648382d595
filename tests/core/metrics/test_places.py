"""Where objects are scored, and the figures of CLEAR MOT."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.geometry.region import box_half_spaces
from stereophd.core.metrics.distances.ospa import score_scans
from stereophd.core.metrics.identities import clear_mot_figures
from stereophd.core.metrics.matching.clear_mot import match_within
from stereophd.core.metrics.scans import PointSets
from stereophd.core.metrics.summary import pair_errors
from stereophd.core.metrics.truth.scored import leave_out_outside, on_plane
from tests.core.metrics.test_tgospa import point_sets


def test_heights_do_not_count_on_the_ground() -> None:
    points = PointSets(
        np.array([0, 1]), np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 5.0, 6.0]]), np.array([0]), np.eye(3)[None]
    )
    flat = on_plane(points, np.array([0.0, 0.0, 2.0]))
    assert flat.position.tolist() == [[1.0, 2.0, 0.0]]
    assert flat.velocity.tolist() == [[4.0, 5.0, 0.0]]
    assert flat.covariance is None
    slanted = on_plane(points, np.array([1.0, 0.0, 1.0]))
    assert slanted.position[0] == pytest.approx([-1.0, 2.0, 1.0])


def test_what_is_outside_a_region_is_left_out() -> None:
    truth = point_sets([{0: 1.0, 1: 8.0}, {1: 8.0}])
    # of the first object, although outside; near it, but not its estimate; of the second object; of none; inside
    estimates = point_sets([{5: -0.2, 9: -0.5, 6: 8.1, 7: 20.0, 8: 4.0}, {6: 8.1}])
    estimates, truth, emptied = leave_out_outside(estimates, truth, box_half_spaces({"x": (0.0, 5.0)}), 2.0, 2.0)
    assert truth.label.tolist() == [0]
    assert estimates.label.tolist() == [5, 8]
    assert emptied.tolist() == [False, True]


def test_figures_of_clear_mot_by_hand() -> None:
    """Ten true points: one missed, two false estimates, one switch."""
    truth = point_sets([{0: 0.0, 1: 5.0}] * 5)
    tracks = [{7: 0.5, 8: 5.0}, {7: 0.5, 8: 5.0, 9: 20.0}, {7: 0.5}, {6: 0.5, 8: 5.0, 9: 20.0}, {6: 0.5, 8: 5.0}]
    estimates = point_sets(tracks)
    scores, _ = match_within(
        estimates, truth, score_scans(estimates, truth, 2.0, 2.0, mahalanobis=False), 2.0, 2.0, 2.0
    )
    errors = pair_errors(estimates, truth, scores)
    found = clear_mot_figures(estimates, truth, scores, errors.switched, np.linalg.norm(errors.position, axis=1))
    assert found == pytest.approx({"mota": 1 - 4 / 10, "motp": 5 * 0.5 / 9, "mostly_tracked": 2, "mostly_lost": 0})
    nothing = point_sets([{}] * 5)
    scores = score_scans(nothing, truth, 2.0, 2.0, mahalanobis=False)
    found = clear_mot_figures(nothing, truth, scores, np.zeros(0, dtype=bool), np.zeros(0))
    assert (found["mota"], found["mostly_lost"]) == (0.0, 2)
