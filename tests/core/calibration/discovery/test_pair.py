"""Two cameras refined: derivatives, optima that are one, and scores of hypotheses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.discovery.essential import essential_of
from stereophd.core.calibration.discovery.pair_fit import OFFSET, SIZE, PairPrior, PairProblem, PairState, distance_of
from stereophd.core.calibration.discovery.pair_search import (
    REFINED_TOLERANCES,
    TOLERANCE,
    PairSearch,
    log_gains,
    make_grid,
)
from stereophd.core.calibration.discovery.tracks import SlopeTracks, slope_tracks

from .rooms import cameras, straight, tracks_of, views_of

PRIOR = PairPrior(offset_is_known=False, rate_std=1e-3, focal_std=(0.05, 0.05), lens_unknown=(True, True))


def tracks() -> SlopeTracks:
    """Tracks of five straight objects before two cameras."""
    rng, true = np.random.default_rng(0), cameras()[:2]
    raw = tracks_of(true, [straight(rng) for _ in range(5)], np.random.default_rng(1))
    return slope_tracks([view.camera for view in views_of(true)], raw)


def truth() -> PairState:
    """The true state of the two cameras."""
    a, b = (camera.pose for camera in cameras()[:2])
    step = b.rotation @ (a.center - b.center)
    direction = step / np.linalg.norm(step)
    return PairState(b.rotation @ a.rotation.T, direction, 0.0, 1.0, 15.0, np.ones(2), np.zeros(2))


def moved(*parts: tuple[int, float]) -> PairState:
    step = np.zeros(SIZE)
    for component, size in parts:
        step[component] = size
    return truth().moved(step)


def test_derivatives_are_those_of_the_distances() -> None:
    problem = PairProblem(tracks(), (0, 1), PRIOR, 0.1)
    state = replace(moved((0, 0.02), (1, -0.03), (3, 0.04), (7, 0.02), (8, -0.03)), lenses=np.array([-0.1, 0.05]))
    rows = problem._paired(state, 20.0).rows
    free = np.array([k for k in range(SIZE) if k < OFFSET or k >= OFFSET + 2])
    distances, jacobian = problem._linearised(state, rows, free)
    assert len(distances) > 100
    for column, k in enumerate(free.tolist()):
        step = np.zeros(SIZE)
        step[k] = 1e-6
        other = state.moved(step)
        changed = problem.distances(other, other.rays(rows.slopes_a, 0), other.rays(rows.slopes_b, 1)).signed
        expected = (changed - distances) / 1e-6
        np.testing.assert_allclose(jacobian[:, column], expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(("component", "size"), [(1, 0.2), (1, 0.3), (2, 0.1), (3, 0.1)])
def test_starts_that_pair_other_tracks_first_end_at_one_optimum(component: int, size: float) -> None:
    problem = PairProblem(tracks(), (0, 1), replace(PRIOR, lens_unknown=(False, False)), 0.1)
    tolerances = (40.0, 20.0, 10.0, 5.0, 2.5)
    best = problem.fitted(truth(), tolerances)
    far = problem.fitted(moved((component, size)), tolerances)
    assert max(distance_of(best.state, far.state)) < np.deg2rad(0.5)
    assert far.gain == pytest.approx(best.gain, rel=0.01)


def test_scores_are_the_gains_of_the_distances() -> None:
    found = tracks()
    search = PairSearch(found, (0, 1), make_grid(found, (0, 1), 0.0))
    state = moved((0, 0.01), (4, 0.02))
    wrong = moved((1, 0.5))
    matrices = np.stack([essential_of(one.rotation, one.direction) for one in (state, wrong)])
    places, valid, slopes = search._samples(0)
    for matrix, score in zip(matrices, search.compared(0).scores(matrices, TOLERANCE), strict=True):
        table = np.zeros(valid.shape[:2])
        for i, j in np.ndindex(*table.shape):
            a, b = search.grid.first[i, places[i][valid[i, j]]], slopes[j, i, valid[i, j]]
            a, b = (np.column_stack([rays, np.ones(len(rays))]) for rays in (a, b))
            line_b, line_a = a @ matrix.T, b @ matrix
            squared = search.focal**2 * (b * line_b).sum(axis=1) ** 2
            squared /= (line_a[:, :2] ** 2).sum(axis=1) + (line_b[:, :2] ** 2).sum(axis=1)
            table[i, j] = log_gains(squared, TOLERANCE).mean() if len(a) else 0.0
        table = np.maximum(table * search._weights(valid.sum(axis=2)), 0.0)
        assert score == pytest.approx(0.5 * (table.max(axis=0).sum() + table.max(axis=1).sum()), rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("turned", [(0, 0.01), (1, 0.01), (2, 0.005), (4, 0.05)])
def test_hypotheses_that_are_refined_end_at_the_right_one(turned: tuple[int, float]) -> None:
    found = tracks()
    at = PairSearch(found, (0, 1), make_grid(found, (0, 1), 0.0)).compared(0)
    matrices = np.stack([essential_of(one.rotation, one.direction) for one in (truth(), moved(turned))])
    refined = matrices
    for tolerance in REFINED_TOLERANCES:
        refined = at.refined(refined, tolerance)
    right, found_again = at.scores(refined, REFINED_TOLERANCES[-1])
    assert found_again == pytest.approx(right, rel=1e-4)
    assert at.scores(matrices, REFINED_TOLERANCES[-1])[1] < 0.999 * right
