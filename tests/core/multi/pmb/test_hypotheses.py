"""The bound on the hypotheses of all tracks: what it leaves out remains undecided."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event
from stereophd.core.multi.association.belief import propagate_beliefs
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.multi.pmb.hypotheses import LEAST_BOUND, RECYCLE_BELOW
from stereophd.core.multi.state.mixture import UNLABELLED, GaussianMixture
from tests.core.multi.pmb.test_pmb import assert_sound, make_pmb
from tests.core.multi.scenes import PRIOR

OBJECTS = 60


def crowd(multi_filter: PmbFilter, count: int, clutter: int = 20) -> list[Event]:
    """Frames of the cameras in turn: still objects at different depths, and clutter."""
    rng = np.random.default_rng(8)
    places = rng.uniform([-20.0, -15.0, 90.0], [20.0, 15.0, 200.0], (OBJECTS, 3))
    events = []
    for k in range(count):
        camera = k % len(multi_filter.rig.cameras)
        pixels = multi_filter.rig.cameras[camera].project(places)
        pixels = pixels + rng.standard_normal(pixels.shape)
        pixels = np.concatenate([pixels, rng.uniform([0.0, 0.0], [799.0, 599.0], (clutter, 2))])
        events.append(make_event(multi_filter.rig.cameras[camera], camera, 0.5 * k, pixels))
    return events


def existences(mixture: GaussianMixture) -> dict[int, float]:
    """Existence of each track by its label."""
    found: dict[int, float] = {}
    for label, weight in zip(mixture.labels.tolist(), mixture.weights.tolist(), strict=True):
        if label != UNLABELLED:
            found[label] = found.get(label, 0.0) + weight
    return found


@pytest.mark.parametrize("most", [90, 200, 400])
def test_a_bound_keeps_existences(most: int) -> None:
    """The first event at which it acts: fewer hypotheses, of which each track that is not recycled has its existence.

    Tracks are not joined here, because which of them agree depends on their hypotheses.
    """
    free = make_pmb(birth=PRIOR, merge_distance=0.0)
    bounded = make_pmb(birth=PRIOR, merge_distance=0.0, max_hypotheses=most)
    first, second = crowd(free, 2)
    before, _, _ = bounded.step(bounded.init(), first)
    whole, info, _ = free.step(before, second)
    assert info.hypotheses_left_out == 0
    after, limited, _ = bounded.step(before, second)
    tracks = existences(after.mixture)
    # each track keeps its heaviest hypothesis, whatever the bound
    assert after.mixture.size <= most + 2 * len(np.unique(whole.mixture.labels)) < whole.mixture.size
    assert limited.hypotheses_left_out >= 0.5 * (whole.mixture.size - after.mixture.size)
    assert limited.log_likelihood == info.log_likelihood
    expected = {label: value for label, value in existences(whole.mixture).items() if value >= RECYCLE_BELOW}
    assert len(expected) > OBJECTS
    assert tracks == pytest.approx(expected, rel=1e-9)


def test_a_bound_that_does_not_act_changes_nothing() -> None:
    runs = []
    for most in (None, LEAST_BOUND, 10**9):
        multi_filter = make_pmb(max_hypotheses=most)
        state = multi_filter.init()
        for event in crowd(multi_filter, 6):
            state, info, _ = multi_filter.step(state, event)
            assert info.hypotheses_left_out == 0
        runs.append(state.mixture)
    for one, other in zip(runs[0], runs[1], strict=True):
        np.testing.assert_array_equal(one, other)
    for one, other in zip(runs[0], runs[2], strict=True):
        np.testing.assert_array_equal(one, other)


def test_objects_are_found_within_a_bound() -> None:
    """States are sound at every event, and the objects are found in the end, some of them later."""
    multi_filter = make_pmb(max_hypotheses=150)
    state, acted = multi_filter.init(), 0
    for event in crowd(multi_filter, 24):
        state, info, estimates = multi_filter.step(state, event)
        assert_sound((state, info, estimates))
        acted += info.hypotheses_left_out > 0
    assert acted > 3
    assert 0.9 * OBJECTS < len(estimates.track_ids) < 1.1 * OBJECTS


def test_sweeps_over_very_many_pairs_are_bounded() -> None:
    """Marginals remain probabilities; those of a few sweeps are near those of convergence."""
    rng = np.random.default_rng(4)
    count = 300
    tracks, detections = (one.ravel() for one in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    odds = rng.uniform(0.0, 3.0, count * count)
    pair, missed, unclaimed, _ = propagate_beliefs(tracks, detections, odds, count, count)
    np.testing.assert_allclose(np.bincount(tracks, pair) + missed, 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.bincount(detections, pair) + unclaimed, 1.0, rtol=0, atol=0.05)
