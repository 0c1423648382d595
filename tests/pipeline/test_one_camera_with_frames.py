"""How `init` compares cameras, and which of its settings the likelihood of the log decides."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.multi.state.estimates import Info
from stereophd.pipeline.checks.log.sample import CameraSample
from stereophd.pipeline.initial import acceleration
from stereophd.pipeline.initial import draft as drafts
from stereophd.pipeline.initial.acceleration import AccelerationEstimate
from stereophd.pipeline.initial.measured import SceneFigures
from stereophd.pipeline.initial.template import Choice, Draft, template
from stereophd.pipeline.stream import EventStream
from tests.scenes import build_camera


def _sample(camera: Camera, frames: int) -> CameraSample:
    times = np.arange(frames) / 10.0
    return CameraSample(camera, times, np.arange(frames), np.arange(frames + 1), np.full((frames, 2), 100.0))


def _loaded(draft: Draft, _name: str) -> SimpleNamespace:
    return SimpleNamespace(values=draft.choices, config=None, build_cameras=tuple)


@pytest.mark.parametrize(("frames", "speed", "is_doubted"), [(0, 0.0, False), (20, 0.0, True), (20, 1.0, False)])
def test_only_cameras_that_see_and_stand_still_contradict_each_other(
    frames: int, speed: float, is_doubted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras that look away from each other share no view: a doubt only where `calibrate` can find them."""
    monkeypatch.setattr(drafts, "_rough", lambda *_: None)
    away = Pose(rotation_from_vector(np.array([0.0, 3.0, 0.0])), np.zeros(3), np.array([speed, 0.0, 0.0]))
    cameras = [build_camera("a"), build_camera("b", pose=away)]
    samples = [_sample(camera, count) for camera, count in zip(cameras, (20, frames), strict=True)]
    _, why = drafts._with_tracks(Draft("m", {}, {}), samples, {}, "log.parquet")
    assert (why is not None) == is_doubted


@pytest.mark.parametrize(("gain", "is_wide"), [(1.0, False), (50.0, True)])
def test_depths_of_tracks_are_left_where_they_make_the_log_less_probable(
    gain: float, is_wide: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are those that several cameras see: what one alone sees may be nearer or farther."""

    def likelihoods(loaded: Any, _parts: object) -> Array:
        return np.array([gain if loaded.values["filter.birth.depth_range"].value == [0.5, 9.0] else 0.0])

    monkeypatch.setattr(drafts, "loaded_draft", _loaded)
    figures = SceneFigures(np.array([2.0, 3.0]), 0.5, 1.0, 4, 2, 10.0, 0, 40.0)
    monkeypatch.setattr(drafts, "log_likelihoods", likelihoods)
    monkeypatch.setattr(drafts, "measure_with_filter", lambda *_: figures)
    monkeypatch.setattr(drafts, "_with_damping", lambda draft, *_: draft)
    monkeypatch.setattr(drafts, "_with_acceleration", lambda draft, *_: draft)
    usual = template("m", {}, "lab")
    rough = usual.with_choices({"filter.birth.depth_range": Choice([0.5, 9.0], "from rays")})
    found = drafts._with_filter(rough, usual, {}, [[None] * 4], "log.parquet")  # type: ignore[list-item]
    assert found.choices["filter.birth.depth_range"].value == ([0.5, 9.0] if is_wide else [1.4, 4.5])
    assert ("region.depth" in found.choices) != is_wide
    assert found.choices["motion.max_speed"].value == 2.5


def test_cameras_agree_that_do_so_at_the_most_probable_acceleration(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is enough for every turn lets the tracks of two cameras wander from one another."""
    asked = []

    def likelihood(loaded: Any, _parts: object, group: range | list[int]) -> float:
        asked.append(loaded.values["motion.acceleration_std"].value)
        return -100.0 if asked[-1] == 8.0 and len(group) == 2 else 0.0

    monkeypatch.setattr(drafts, "loaded_draft", _loaded)
    estimate = AccelerationEstimate(8.0, 0.5, None, {}, 40)
    monkeypatch.setattr(drafts, "_log_likelihood", likelihood)
    monkeypatch.setattr(drafts, "estimate_acceleration", lambda *_: estimate)
    monkeypatch.setattr(drafts, "measure_with_filter", lambda *_: None)
    monkeypatch.setattr(drafts, "open_stream", lambda *_: None)
    monkeypatch.setattr(drafts, "stretches", lambda *_: [EventStream((), [])])
    monkeypatch.setattr(drafts, "LEAST_FRAMES", 0)
    draft = template("m", {}, "lab")
    monkeypatch.setattr(drafts, "_rough", lambda *_: {})
    samples = [_sample(build_camera(name), 20) for name in "ab"]
    found, why = drafts._with_tracks(draft, samples, {}, "log.parquet")
    assert why is None
    assert set(asked) == {8.0, 0.5}
    assert found.choices["motion.acceleration_std"].value == 8.0
    asked.clear()
    _, why = drafts._with_tracks(draft.with_given({"motion.acceleration_std": 8.0}), samples, {}, "log.parquet")
    assert why is not None
    assert asked == [8.0] * 3  # once: there is no other acceleration


def test_what_a_filter_forgets_speaks_against_no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a crowd, cameras that share objects would be less probable than those that each see their own."""
    event = SimpleNamespace(within=lambda _: None)
    info = Info(-3.0, 1.0, 1, forgotten=2.0)
    made = SimpleNamespace(rig=None, init=lambda: None, step=lambda *_: (None, info, None))
    monkeypatch.setattr(acceleration, "build_labelled_filter", lambda *_: made)
    loaded: Any = SimpleNamespace(config=None, path="", build_cameras=tuple)
    np.testing.assert_allclose(acceleration.log_likelihoods(loaded, [[event, event], [event]]), [-1.0] * 3)
