"""The bound on the hypotheses of all tracks: what it leaves out remains undecided."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event
from stereophd.core.multi.association.belief import propagate_beliefs
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.multi.pmb.hypotheses import LEAST_BOUND, choose_hypotheses
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.multi.state.outcomes import Outcomes
from stereophd.pipeline.checks.run_checks import MOST_UNDECIDED
from tests.core.multi.pmb.test_pmb import assert_sound, make_pmb
from tests.core.multi.scenes import PRIOR

OBJECTS = 60


def places() -> np.ndarray:
    """Still objects at different depths."""
    return np.random.default_rng(8).uniform([-20.0, -15.0, 90.0], [20.0, 15.0, 200.0], (OBJECTS, 3))


def crowd(multi_filter: PmbFilter, count: int, clutter: int = 20) -> list[Event]:
    """Frames of the cameras in turn: the objects, and clutter."""
    rng, events = np.random.default_rng(9), []
    for k in range(count):
        camera = k % len(multi_filter.rig.cameras)
        pixels = multi_filter.rig.cameras[camera].project(places())
        pixels = pixels + rng.standard_normal(pixels.shape)
        pixels = np.concatenate([pixels, rng.uniform([0.0, 0.0], [799.0, 599.0], (clutter, 2))])
        events.append(make_event(multi_filter.rig.cameras[camera], camera, 0.5 * k, pixels))
    return events


def existences(mixture: GaussianMixture) -> dict[int, float]:
    """Existence of each track by its label."""
    found: dict[int, float] = {}
    for label, weight in zip(mixture.labels.tolist(), mixture.weights.tolist(), strict=True):
        found[label] = found.get(label, 0.0) + weight
    return found


@pytest.mark.parametrize("most", [90, 200, 400])
def test_a_bound_keeps_existences(most: int) -> None:
    """The first event at which it acts: fewer hypotheses, of which each track has its existence.

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
    assert len(tracks) > OBJECTS
    assert tracks == pytest.approx(existences(whole.mixture), rel=1e-9)


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


def test_what_is_left_out_would_have_decided_the_squares_of_its_shares() -> None:
    """Two tracks and two detections, of which four outcomes stay: the miss of track 0 goes, and a detection of 1."""
    owned, made = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    weights = np.array([0.1, 0.11, 0.5, 0.2, 0.09, 0.4, 0.15, 0.05])
    labels = np.array([0, 1, 0, 0, 1, 1, 2, 3])
    outcomes = Outcomes(labels, weights, owned, made, np.zeros((2, 3)), np.zeros((2, 3, 3)))
    choice, tracks = choose_hypotheses(outcomes, make_pmb(max_hypotheses=4).reduction)
    np.testing.assert_allclose(tracks.existence, [0.8, 0.6, 0.15, 0.05])
    # the detection that track 1 does not get remains undecided; every new object stays
    assert dict(zip(choice.chosen.tolist(), choice.weights.tolist(), strict=True)) == pytest.approx(
        {1: 0.2, 2: 0.5, 3: 0.2, 5: 0.4, 6: 0.15, 7: 0.05}
    )
    assert (choice.left_out, choice.undecided) == (2, pytest.approx(0.1**2 / 0.8 + 0.09**2 / 0.6))


def test_a_bound_keeps_no_track_that_is_improbable() -> None:
    """Of four hypotheses of track 0 three stay, the lightest of which is lighter than the existence of track 1."""
    nothing = np.empty(0, dtype=np.int64)
    labels, weights = np.array([0, 0, 0, 0, 1]), np.array([0.7, 0.2, 2e-4, 1e-4, 5e-4])
    outcomes = Outcomes(labels, weights, nothing, nothing, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    choice, _ = choose_hypotheses(outcomes, make_pmb(max_hypotheses=3, least_share=1e-4).reduction)
    assert choice.chosen.tolist() == [0, 1, 2]


@pytest.mark.parametrize(("most", "is_harmed"), [(150, False), (30, True)])
def test_a_bound_harms_where_what_it_leaves_out_would_have_decided_much(most: int, is_harmed: bool) -> None:
    """States are sound at every event, and the objects are found in the end, but with a bound below their number."""
    multi_filter = make_pmb(max_hypotheses=most)
    state, acted, undecided, detections = multi_filter.init(), 0, 0.0, 0
    for event in crowd(multi_filter, 24):
        state, info, estimates = multi_filter.step(state, event)
        assert_sound((state, info, estimates))
        acted += info.hypotheses_left_out > 0
        undecided, detections = undecided + info.undecided_detections, detections + len(event.points)
    assert acted > 3
    apart = np.linalg.norm(estimates.states[:, None, :3] - places(), axis=2).min(axis=0)
    assert (np.count_nonzero(apart < 6.0) < 0.8 * OBJECTS) == is_harmed
    assert (undecided > MOST_UNDECIDED * detections) == is_harmed
    assert 0.9 * OBJECTS < len(estimates.track_ids) < 1.1 * OBJECTS or is_harmed


def test_sweeps_over_very_many_pairs_are_bounded() -> None:
    """Marginals remain probabilities; those of a few sweeps are near those of convergence."""
    rng = np.random.default_rng(4)
    count = 300
    tracks, detections = (one.ravel() for one in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    odds = rng.uniform(0.0, 3.0, count * count)
    pair, missed, unclaimed, _ = propagate_beliefs(tracks, detections, odds, count, count)
    np.testing.assert_allclose(np.bincount(tracks, pair) + missed, 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.bincount(detections, pair) + unclaimed, 1.0, rtol=0, atol=0.05)
