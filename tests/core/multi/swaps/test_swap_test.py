"""Crosswise pairs: the test that swaps detections, against plain NumPy, and the history that it reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.disparity.moments import move
from stereophd.core.disparity.moved import Sources
from stereophd.core.disparity.rolling import NO_READINGS
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.multi.state.inputs import with_newborns
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.core.multi.swaps import swap_test as swap_module
from stereophd.core.multi.swaps.epipolar_pairs import NewObjects, Past, swap_candidates
from stereophd.core.multi.swaps.history import (
    KEPT_EVENTS,
    ClaimedDetections,
    ClaimedRows,
    DeferredPairs,
    History,
    no_deferred_pairs,
)
from stereophd.core.multi.swaps.swap_test import SwapTest
from stereophd.io.outputs.saved import decoder, encode
from tests.core.multi.pmb.test_pmb import Frames, Step, gaussian, make_pmb, run
from tests.core.multi.scenes import make_mixture

# Two objects in one epipolar plane (y = 0), whose crosswise intersections also lie before both cameras.
PLACES = np.array([[-6.0, 0.0, 120.0], [6.0, 0.0, 120.0]])
VELOCITIES = np.array([[0.3, 0.03, 0.5], [-0.2, -0.03, 0.7]])


def frames_of(multi_filter: PmbFilter, seconds: int = 14) -> Frames:
    """Detections of both objects, without misses and clutter, by both cameras every second."""
    rng, out = np.random.default_rng(5), []
    for time_s in range(seconds):
        for camera in range(2):
            pixels = multi_filter.rig.cameras[camera].project(PLACES + time_s * VELOCITIES)
            out.append((float(time_s), camera, pixels + rng.standard_normal(pixels.shape)))
    return out


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    """A run of a filter that swaps nothing."""
    return run(make_pmb(exchange_above=1e9), frames_of(make_pmb()))


def crosswise(steps: list[Step], multi_filter: PmbFilter) -> tuple[History, tuple[int, int]]:
    """The history of the run as if both objects had been paired crosswise."""
    state, _, estimates = steps[-1]
    assert state.history is not None
    assert len(estimates.labels) == 2
    first, second = sorted(estimates.labels.tolist())
    return state.history.swapped(first, second, 1), (first, second)


def swap_test_of(multi_filter: PmbFilter) -> SwapTest:
    return multi_filter.swap_test


def test_the_kernel_is_compiled_beforehand_for_the_types_of_a_run(
    steps: list[Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    types: list[tuple[Any, ...]] = []
    called = swap_module.explain_rows

    def noted(*arguments: Any) -> Any:
        types.append(tuple(map(numba.typeof, arguments)))
        return called(*arguments)

    monkeypatch.setattr(swap_module, "explain_rows", noted)
    multi_filter = make_pmb()
    swap_test_of(multi_filter).compile()
    beforehand = set(types)
    types.clear()
    history, (first, second) = crosswise(steps, multi_filter)
    test = swap_test_of(multi_filter)
    test.explain(history, first, second, 1, test.prior(multi_filter.rig.views(0.0)))
    assert len(types) > 0
    assert set(types) == beforehand


def test_the_odds_of_a_swap_are_those_of_its_reverse(steps: list[Step]) -> None:
    multi_filter = make_pmb()
    wrong, (first, second) = crosswise(steps, multi_filter)
    test = swap_test_of(multi_filter)
    prior = test.prior(multi_filter.rig.packed)
    right = wrong.swapped(first, second, 1)
    for_right, _ = test.explain(wrong, first, second, 1, prior)
    for_wrong, _ = test.explain(right, first, second, 1, prior)
    # the swap of the detections of camera 0 is the same but for the names
    by_other, _ = test.explain(wrong, first, second, 0, prior)
    assert for_right > 20.0
    assert for_wrong == pytest.approx(-for_right, rel=1e-12) == -by_other


def fitting(test: SwapTest, history: History, label: int, prior: NewObjects) -> ClaimedRows:
    """Detections of a label without those that it claimed before it had settled."""
    rows = history.rows_of(label, label)
    rows = rows.take(np.arange(len(rows.times))[::-1])
    return rows.take(np.flatnonzero(test.filter_again(rows, prior).fits)[::-1])


def test_filtering_again_is_what_a_plain_filter_does(steps: list[Step]) -> None:
    """Log-likelihood and Gaussian against moves one by one and Kalman updates in NumPy."""
    multi_filter = make_pmb()
    state, _, estimates = steps[-1]
    test, label = swap_test_of(multi_filter), int(estimates.labels[0])
    assert state.history is not None
    prior = test.prior(multi_filter.rig.packed)
    rows = fitting(test, state.history, label, prior)
    assert len(rows.times) > 20
    found = test.filter_again(rows, prior)

    space = multi_filter.rig.packed[rows.cameras[0]]
    (mean,), (covariance,) = with_newborns(*multi_filter.detections(_event(multi_filter, rows)), 6)[4:6]
    expected = 0.0
    for k in range(1, len(rows.times)):
        destination = multi_filter.rig.packed[rows.cameras[k]]
        intervals = multi_filter.motion.arrays(np.diff(rows.times[k - 1 : k + 1]))
        moved = move(
            Sources(mean[None], covariance[None], space[None], intervals),
            destination, replace(multi_filter.sets, sets=multi_filter.sets.sets[:1]), 0, 0.0,
        )  # fmt: skip
        mean, covariance, space = moved.means[0], moved.covariances[0], destination
        residual, spread = rows.points[k] - mean[:2], covariance[:2, :2] + rows.noises[k]
        expected += np.log(gaussian(residual, spread))
        gain = covariance[:, :2] @ np.linalg.inv(spread)
        mean, covariance = mean + gain @ residual, covariance - gain @ spread @ gain.T
    # the density below which a detection is left out is added to each
    assert found.log_likelihood == pytest.approx(expected, abs=1e-3)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-8)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-6, atol=1e-9)
    assert (found.camera, found.time_s) == (rows.cameras[-1], rows.times[-1])


def _event(multi_filter: PmbFilter, rows: ClaimedRows) -> Event:
    camera = int(rows.cameras[0])
    event = make_event(multi_filter.rig.cameras[camera], camera, float(rows.times[0]), rows.points[:1])
    return replace(event, covariances=rows.noises[:1])


def put_right(
    test: SwapTest, mixture: GaussianMixture, history: History, camera: int, time_s: float, event: int
) -> tuple[GaussianMixture, History]:
    """Return a mixture after an event of a camera, and the history, with the swaps that `PmbFilter.step` makes."""
    if camera == 0:
        return mixture, history
    rows, homes = np.arange(mixture.size), test.rig.spaces(mixture.cameras, mixture.times)
    pairs = swap_candidates(mixture, rows, homes, *test.search(history, camera, time_s, event)[0])
    return test.swap(mixture, history, pairs, camera, time_s, event) if len(pairs) else (mixture, history)


def test_a_crosswise_pair_is_put_right(steps: list[Step]) -> None:
    """Tracks on the two ghosts are back on the objects, under their labels, and the next test waits."""
    multi_filter = make_pmb()
    wrong, (first, second) = crosswise(steps, multi_filter)
    state, test = steps[-1][0], swap_test_of(multi_filter)
    prior = test.prior(multi_filter.rig.packed)
    ghosts = [test.filter_again(fitting(test, wrong, label, prior), prior) for label in (first, second)]
    mixture = make_mixture(
        [0.99, 0.98], [one.mean for one in ghosts], [one.covariance for one in ghosts],
        [one.camera for one in ghosts], [one.time_s for one in ghosts], [first, second], [0, 1], [True, True],
    )  # fmt: skip
    assert state.time_s is not None
    before, _ = put_right(test, mixture, state.history or History(), 1, state.time_s, 100)
    np.testing.assert_array_equal(before.means, mixture.means)
    after, history = put_right(test, mixture, wrong, 1, state.time_s, 100)
    np.testing.assert_array_equal(after.labels, mixture.labels)
    np.testing.assert_array_equal(after.weights, mixture.weights)
    _, estimates = multi_filter.extract(replace(state, mixture=after))
    _, off = multi_filter.extract(replace(state, mixture=mixture))
    # each label is as near as may be to where it was, and has the detections of the object that it follows now
    here, there = (one.states[np.argsort(one.labels), :3] for one in (off, estimates))
    moves = np.linalg.norm(here[:, None] - there, axis=2)
    assert np.trace(moves) <= np.trace(moves[:, ::-1])
    for label in (first, second):
        rows = history.rows_of(label, label)
        owners = [own for own in (first, second) if np.array_equal(rows.points, _own(state.history, own).points)]
        assert len(owners) == 1
    truth = PLACES + state.time_s * VELOCITIES
    errors = np.linalg.norm(estimates.states[:, None, :3] - truth, axis=2)
    assert errors.min(axis=1).max() < 2.0
    assert set(errors.argmin(axis=1).tolist()) == {0, 1}
    assert len(history.deferred.due) == 1
    again, same = put_right(test, after, history, 1, state.time_s, 101)
    np.testing.assert_array_equal(again.means, after.means)
    assert len(same.deferred.due) == 1


def _own(history: History | None, label: int) -> ClaimedRows:
    assert history is not None
    rows = history.rows_of(label, label)
    return rows


def test_an_infinite_threshold_keeps_no_history() -> None:
    multi_filter = make_pmb(exchange_above=np.inf)
    assert run(multi_filter, frames_of(multi_filter, 3))[-1][0].history is None


def test_pairs_in_one_epipolar_plane_are_found() -> None:
    """Random places against distances of points from epipolar lines by plain projection."""
    multi_filter, rng = make_pmb(), np.random.default_rng(4)
    rig = multi_filter.rig
    places = rng.uniform([-20.0, -15.0, 90.0], [20.0, 15.0, 200.0], (40, 3))
    spaces = list(rig.packed)
    space = DisparitySpace(rig.cameras[0], rig.baseline, rig.rectification)
    means = space.from_world(np.concatenate([places, np.zeros_like(places)], axis=1))
    mixture = make_mixture(np.ones(40), means, reported=np.ones(40, dtype=bool))
    prior = NewObjects(np.full(2, 7.0), np.full(2, 1e3), 1.5, np.empty(0))
    homes, nothing = rig.spaces(mixture.cameras, mixture.times), no_deferred_pairs()

    def pairs(deferred: DeferredPairs, most: int, event: int = 5) -> list[tuple[int, int]]:
        found = swap_candidates(
            mixture, np.arange(40), homes, (0, 1), np.stack(spaces), prior, 8.0, Past(0.0, 0.0), deferred, event, most
        )
        return [(first, second) for first, second in found.tolist()]

    found = pairs(nothing, 1000)
    expected = set()
    for i in range(40):
        for j in range(i + 1, 40):
            near = max(_off_plane(rig.cameras, places, i, j), _off_plane(rig.cameras, places, j, i)) <= 8.0
            apart = np.linalg.norm(np.subtract(*rig.cameras[1].project(places[[i, j]]))) > 8.0
            if near and apart and _ghost(rig.cameras, places, i, j) and _ghost(rig.cameras, places, j, i):
                expected.add((i, j))
    assert len(expected) > 5
    assert len(found) == len(expected)
    assert set(found) == expected
    assert pairs(nothing, 2) == found[:2]
    # until an event, and with the second camera
    assert pairs(nothing.add((*found[0], 1), 6).add((*found[1], 0), 6).add((*found[2], 1), 5), 2) == found[1:3]
    # the pairs take turns: another event lists the same ones from another beginning
    beginnings = set()
    for event in range(40):
        turned = pairs(nothing, 1000, event)
        start = found.index(turned[0])
        assert turned == found[start:] + found[:start]
        beginnings.add(start)
    assert len(beginnings) > 5


@pytest.mark.parametrize(
    ("velocity", "third", "expected"),
    [
        ((0.0, 0.0, 0.0), None, True),
        ((0.5, 0.0, -0.5), None, True),  # within the plane
        ((0.0, 1.0, 0.0), None, False),  # into the plane
        ((0.0, 0.0, 0.0), (0.0, 30.0, 0.0), False),  # a third camera sees both tracks where the ghosts are not
        ((0.0, 0.0, 0.0), (0.0, -1000.0, 0.0), True),  # it has neither in view
        ((0.0, 0.0, 0.0), (-20.0, 0.0, 0.0), True),  # it has them on the rays of the first camera
    ],
)
def test_pairs_that_were_in_one_plane_and_that_no_third_camera_tells_apart(
    velocity: tuple[float, float, float], third: tuple[float, float, float] | None, expected: bool
) -> None:
    multi_filter = make_pmb()
    cameras = list(multi_filter.rig.cameras)
    if third is not None:
        pose = cameras[0].pose if third[1] == 0.0 else Pose(np.eye(3), np.array(third))
        cameras.append(replace(cameras[0], name="third", pose=pose))
    rig = make_rig(cameras, multi_filter.rig.baseline, "horizontal")
    space = DisparitySpace(rig.cameras[0], rig.baseline, rig.rectification)
    states = np.concatenate([PLACES, np.zeros((2, 3))], axis=1)
    states[1, 3:] = velocity
    mixture = make_mixture(np.ones(2), space.from_world(states), [1e-6 * np.eye(6)] * 2, reported=[True, True])
    count = len(cameras)
    found = swap_candidates(
        mixture, np.arange(2), rig.spaces(mixture.cameras, mixture.times), (0, 1), rig.packed,
        NewObjects(np.full(count, 7.0), np.full(count, 1e3), 1.5, np.empty(0)), 8.0, Past(10.0, 0.01),
        no_deferred_pairs(), 0, 1,
    )  # fmt: skip
    assert found.tolist() == ([[0, 1]] if expected else [])


def _off_plane(cameras: Sequence[Camera], places: np.ndarray, i: int, j: int) -> float:
    """Distance, in units of pixels of camera 1, of place j from the epipolar plane of place i."""
    first, second = cameras[0].pose.center, cameras[1].pose.center
    # angle between the planes, seen at the distance of place j from the axis
    one, other = (np.cross(second - first, places[k] - first) for k in (i, j))
    angle = np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other)
    base = (second - first) / np.linalg.norm(second - first)
    apart = places[j] - second
    radius = np.linalg.norm(apart - (apart @ base) * base)
    return float(angle * radius * cameras[1].fx / cameras[1].pose.to_camera(places[j][None])[0, 2])


def _ghost(cameras: Sequence[Camera], places: np.ndarray, i: int, j: int) -> bool:
    """Whether the ray of camera 0 to place i and that of camera 1 to place j meet before both cameras."""
    first, second = cameras[0].pose.center, cameras[1].pose.center
    rays = np.stack([places[i] - first, second - places[j]], axis=1)
    return bool((np.linalg.lstsq(rays, second - first, rcond=None)[0] > 0.0).all())


def test_the_history_is_bounded_and_keeps_every_camera() -> None:
    history = History()
    for k in range(500):
        history = history.add(_sighting(k, k % 3, [7]))
    assert KEPT_EVENTS < len(history.sightings) <= 2 * KEPT_EVENTS
    times = [one.time_s for one in history.sightings]
    assert times == sorted(times)
    assert times[-1] == 499.0
    assert {one.camera for one in history.sightings[:KEPT_EVENTS]} == {0, 1, 2}
    assert history.add(_sighting(500, 0, [])) is history


def _sighting(time_s: float, camera: int, labels: list[int]) -> ClaimedDetections:
    count = len(labels)
    return ClaimedDetections(
        camera, float(time_s), np.array(labels, dtype=np.int64), np.arange(count), np.zeros((count, 2)),
        np.zeros((count, 2, 2)), NO_READINGS,
    )  # fmt: skip


def test_a_kept_state_holds_the_history(steps: list[Step]) -> None:
    multi_filter = make_pmb()
    frames = frames_of(multi_filter)
    state = run(multi_filter, frames)[-1][0]
    found = decoder(type(state))(encode(state))
    assert state.history is not None
    assert found.history.deferred.due.tolist() == state.history.deferred.due.tolist()
    for one, other in zip(found.history.sightings, state.history.sightings, strict=True):
        assert (one.camera, one.time_s) == (other.camera, other.time_s)
        np.testing.assert_array_equal(one.readings, other.readings)
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.detections, other.detections)
