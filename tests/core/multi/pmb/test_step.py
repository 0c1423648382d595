"""One compiled call for an event against its stages, one by one: equal to the bit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.geometry.pose import Pose
from stereophd.core.geometry.region import box_half_spaces, pack_region
from stereophd.core.motion.static import Static
from stereophd.core.multi.base import FilterState
from stereophd.core.multi.pmb.filter import PmbFilter
from stereophd.core.multi.state.estimates import Estimates, Info
from stereophd.core.multi.swaps.swap_test import SwapTest
from tests.core.disparity.cases import make_camera
from tests.core.multi.pmb.test_pmb import made_up_frames, make_pmb, run
from tests.core.multi.scenes import make_mixture
from tests.core.multi.swaps.test_swap_test import PLACES, VELOCITIES, crosswise, fitting, frames_of, put_right

Outcome = tuple[FilterState, Info, Estimates]


def arrays_of(value: Any) -> list[Any]:
    """All numbers and arrays of nested states, in order."""
    if hasattr(value, "__dict__"):
        value = tuple(vars(value).values())
    return [each for part in value for each in arrays_of(part)] if isinstance(value, tuple) else [value]


def assert_same(one: Outcome, other: Outcome) -> None:
    first, second = arrays_of(one), arrays_of(other)
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)


def filter_of(case: str) -> PmbFilter:
    """A filter that expects births as the frames show them."""
    turned = [make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0)), make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0))]
    if case == "moving":
        pose = turned[1].pose
        turned[1] = replace(turned[1], pose=Pose(pose.rotation, pose.center, (0.3, 0.0, 0.1), (0.0, 0.002, 0.0)))
    motion = Static() if case == "static" else None
    method = case if case in ("adaptive", "particle") else "qmc"
    made = make_pmb(
        turned, motion, method, 64 if case != "threads" else 4096, threads=2 if case == "threads" else 1,
        exchange_above=np.inf if case == "no exchange" else 5.0,
    )  # fmt: skip
    region = pack_region((40.0, 400.0), box_half_spaces({"z": (60.0, 190.0)})) if case == "region" else None
    return replace(made, rig=make_rig(turned, 1.0, "horizontal", region), claims=case == "claims")


def stages(multi_filter: PmbFilter, state: FilterState, event: Event) -> Outcome:
    """Prediction, update, swaps and extraction, each a call."""
    after, info = multi_filter.update(state, multi_filter.predict(state, event), event)
    if after.history is not None:
        mixture, history = put_right(
            multi_filter.swap_test, after.mixture, after.history, event.camera, event.time_s, state.n_events
        )
        after = replace(after, mixture=mixture, history=history)
    after, estimates = multi_filter.extract(after)
    return after, info, estimates


@pytest.mark.parametrize(
    "case", ["two cameras", "moving", "static", "adaptive", "particle", "threads", "no exchange", "claims", "region"]
)
def test_one_call_is_its_stages(case: str) -> None:
    multi_filter = filter_of(case)
    state, reported, stayed = multi_filter.init(), 0, 0
    for time_s, camera, pixels in made_up_frames(multi_filter, missed=(9, 10)):
        event = make_event(multi_filter.rig.cameras[camera].at(time_s), camera, time_s, pixels)
        one = multi_filter.step(state, event)
        assert_same(one, stages(multi_filter, state, event))
        state, reported = one[0], reported + len(one[2].track_ids)
        stayed += int(np.count_nonzero(state.mixture.times != time_s))
    assert reported > 0
    assert stayed > 0


def test_a_swap_within_the_call() -> None:
    """Tracks on the two ghosts are put right by the next event, and the objects are extracted after that."""
    multi_filter = make_pmb()
    steps = run(make_pmb(exchange_above=1e9), frames_of(multi_filter))
    wrong, labels = crosswise(steps, multi_filter)
    prior = multi_filter.swap_test.prior(multi_filter.rig.packed)
    ghosts = [
        multi_filter.swap_test.filter_again(fitting(multi_filter.swap_test, wrong, label, prior), prior)
        for label in labels
    ]
    mixture = make_mixture(
        [0.99, 0.98], [one.mean for one in ghosts], [one.covariance for one in ghosts],
        [one.camera for one in ghosts], [one.time_s for one in ghosts], labels, [0, 1], [True, True],
    )  # fmt: skip
    state = replace(steps[-1][0], mixture=mixture, history=wrong, n_events=100)
    time_s, camera, pixels = frames_of(multi_filter, 15)[-1]
    event = make_event(multi_filter.rig.cameras[camera], camera, time_s, pixels)
    multi_filter = replace(multi_filter)
    one = multi_filter.step(state, event)
    assert_same(one, stages(multi_filter, state, event))
    without = replace(multi_filter, settings=replace(multi_filter.settings, exchange_above=1e9)).step(state, event)
    assert len(one[2].states) == len(without[2].states) == 2
    truth = PLACES + time_s * VELOCITIES
    off = [np.linalg.norm(each[2].states[:, None, :3] - truth, axis=2).min(axis=1).max() for each in (one, without)]
    assert off[0] < 2.0 < off[1]


def test_no_swap_is_tested_without_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """`update` finds no pairs, and a first event has none."""

    def refuse(*_: object) -> None:
        raise AssertionError("a swap was tested")

    monkeypatch.setattr(SwapTest, "swap", refuse)
    multi_filter = filter_of("two cameras")
    state = multi_filter.init()
    for time_s, camera, pixels in made_up_frames(multi_filter)[:6]:
        event = make_event(multi_filter.rig.cameras[camera].at(time_s), camera, time_s, pixels)
        state, _ = multi_filter.update(state, multi_filter.predict(state, event), event)
    assert state.history is not None
    multi_filter.step(multi_filter.init(), event)
