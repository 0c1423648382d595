"""The filter of bodies on simulated people."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from stereophd.config.loading import load_config
from stereophd.core.bodies.filter import BodyFilter, BodyState
from stereophd.core.bodies.shapes.ellipsoid import EllipsoidSettings
from stereophd.core.disparity.events import Event, make_event, make_rig
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.state.estimates import Estimates
from stereophd.core.simulation.detections import simulate_frames, truth_rows
from stereophd.errors import InputError
from stereophd.io.outputs.saved import decode, decoder, encode
from stereophd.pipeline.simulation import build_scene

SECONDS, PEOPLE = 8.0, 8


@cache
def scene() -> tuple[BodyFilter, tuple[Event, ...], dict[float, np.ndarray]]:
    """Return a filter, the events of a scene, and the true places by time."""
    loaded = load_config("configs/crowd.yaml", [f"simulate.duration_s={SECONDS}", f"simulate.walkers.count={PEOPLE}"])
    cameras = loaded.build_cameras()
    assert isinstance(loaded.config.object, EllipsoidSettings)
    assert isinstance(loaded.config.filter, PmbSettings)
    built = build_scene(loaded.config, cameras, np.random.SeedSequence(3))
    events = tuple(
        make_event(cameras[f.camera], f.camera, f.log_time_s, f.pixels, None, f.frame, f.sizes)
        for f in simulate_frames(built, np.random.SeedSequence(4))
    )
    truth = {}
    for times, labels, states in truth_rows(built):
        for time_s in np.unique(times):
            here = times == time_s
            truth[float(time_s)] = states[here][np.argsort(labels[here]), :3]
    rig = make_rig(cameras, 1.0, "horizontal")
    return BodyFilter(rig, ConstantVelocity(0.8), loaded.config.object, loaded.config.filter), events, truth


def run(body_filter: BodyFilter, events: tuple[Event, ...]) -> list[tuple[float, Estimates, float]]:
    """Return time, estimates and log-likelihood of each event."""
    state, out = body_filter.init(), []
    for event in events:
        state, info, estimates = body_filter.step(state, event)
        out.append((event.time_s, estimates, info.log_likelihood))
    return out


def test_people_are_found_and_kept() -> None:
    body_filter, events, truth = scene()
    nees, identities = [], [set() for _ in range(PEOPLE)]
    for time_s, estimates, _ in run(body_filter, events)[40::4]:
        places = truth[min(truth, key=lambda known: abs(known - time_s))]
        assert len(estimates.track_ids) == PEOPLE
        distance = np.linalg.norm(places[:, None] - estimates.states[None, :, :3], axis=2)
        nearest = distance.argmin(axis=1)
        assert len(set(nearest.tolist())) == PEOPLE
        assert distance.min(axis=1).max() < 0.6
        off = estimates.states[nearest, :2] - places[:, :2]
        covariances = estimates.covariances[nearest, :2, :2]
        nees.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off).mean())
        for person, row in enumerate(nearest.tolist()):
            identities[person].add(int(estimates.track_ids[row]))
        assert estimates.extents is not None
        assert (np.abs(estimates.extents[:, 0] - 1.7) < 0.5).all()
    assert all(len(one) == 1 for one in identities)
    # two dimensions; a model of walking people is not exact
    assert 0.8 < np.mean(nees) < 3.5


def test_results_do_not_depend_on_the_order_of_detections() -> None:
    body_filter, events, _ = scene()
    turned = tuple(
        make_event(body_filter.rig.cameras[e.camera], e.camera, e.time_s, e.pixels[::-1], None, e.frame, e.sizes[::-1])
        for e in events[:40]
        if e.pixels is not None and e.sizes is not None
    )
    for one, other in zip(run(body_filter, events[:40]), run(body_filter, turned), strict=True):
        assert one[2] == other[2]
        assert np.array_equal(one[1].states, other[1].states)


def test_a_person_who_is_hidden_from_all_cameras_is_not_forgotten_at_once() -> None:
    body_filter, events, _ = scene()
    without = replace(body_filter, shape=replace(body_filter.shape, hidden_loss=0.0))
    likelihood = sum(one[2] for one in run(body_filter, events))
    assert likelihood > sum(one[2] for one in run(without, events))


def test_forecasts_move_and_fade() -> None:
    body_filter, events, _ = scene()
    state, info = body_filter.init(), None
    for event in events[:60]:
        state, info, estimates = body_filter.step(state, event)
    assert info is not None
    assert state.time_s is not None
    later, ahead = body_filter.forecast(state, info, state.time_s + 0.5)
    assert later.log_likelihood == 0.0
    assert later.cardinality_mean < info.cardinality_mean
    assert ahead.track_ids.tolist() == estimates.track_ids.tolist()
    expected = estimates.states[:, :2] + 0.5 * estimates.states[:, 3:5]
    assert ahead.states[:, :2] == pytest.approx(expected)


def test_a_run_continues_from_its_saved_state(tmp_path: Path) -> None:
    body_filter, events, _ = scene()
    state = body_filter.init()
    for event in events[:40]:
        state, _, _ = body_filter.step(state, event)
    kept = decode(encode(state), decoder(BodyState), tmp_path / "state")
    for event in events[40:60]:
        state, info, estimates = body_filter.step(state, event)
        kept, same_info, same = body_filter.step(kept, event)
        assert info == same_info
        assert np.array_equal(estimates.states, same.states)
        assert np.array_equal(estimates.track_ids, same.track_ids)


def test_a_detection_without_a_box_is_refused() -> None:
    body_filter, events, _ = scene()
    with pytest.raises(InputError, match=r"expected a box \(width_px, height_px\) for each detection"):
        body_filter.step(body_filter.init(), replace(events[0], sizes=None))
