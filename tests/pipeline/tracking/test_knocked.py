"""A camera that is turned in the middle of a recording is named, with its time; without one there is no alarm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

from stereophd.config.loading import LoadedConfig, load_config
from stereophd.core.disparity.events import Event, make_event
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.numerics.random_streams import RUN_FRAMES, RUN_OBJECTS
from stereophd.core.simulation.detections import Scene, simulate_frames
from stereophd.core.two_views import turns
from stereophd.core.two_views.responses import find_change
from stereophd.core.two_views.turns import all_turns
from stereophd.pipeline.build import build_filter
from stereophd.pipeline.checks.finding import Finding
from stereophd.pipeline.checks.run_checks import check_knocks
from stereophd.pipeline.simulation import build_scene
from stereophd.pipeline.tracking import knocked as test_of_knocks
from stereophd.pipeline.tracking.knocked import BLOCKS, LOOKS_A_QUESTION, Knock, _added, _threshold
from stereophd.pipeline.tracking.loop import run_estimator
from stereophd.pipeline.tracking.run_figures import RunFigures

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "quickstart.yaml"
KNOCK_S = 5.0
# One part in a hundred of the distance.
FORWARD = (0.0, 0.0, 0.08)


def of_objects(count: int, duration_s: float = 8.0, changes: Sequence[str] = ()) -> LoadedConfig:
    alone = [f"simulate.objects.{each}" for each in (f"count={count}", "births_per_s=0", "mean_lifetime_s=null")]
    return load_config(CONFIG, [f"simulate.duration_s={duration_s}", *alone, *changes])


@pytest.fixture(scope="module")
def loaded() -> LoadedConfig:
    return of_objects(6)


def turned(camera: Camera, turn_deg: tuple[float, float, float], shift: tuple[float, float, float]) -> Camera:
    pose = camera.pose
    return replace(
        camera, pose=Pose(rotation_from_vector(np.deg2rad(turn_deg)) @ pose.rotation, pose.center + np.array(shift))
    )


def events(
    loaded: LoadedConfig, name: str, turn_deg: tuple[float, ...], shift: tuple[float, ...], from_s: float = KNOCK_S
) -> list[Event]:
    """Return the events of the scene; the named camera is turned and shifted from a time on, unknown to anybody."""
    cameras = loaded.build_cameras()
    seed = loaded.config.seed
    scene = build_scene(loaded.config, cameras, RUN_OBJECTS.seed(seed, 0))
    knocked: Scene = replace(
        scene, cameras=tuple(turned(c, turn_deg, shift) if c.name == name else c for c in cameras)  # type: ignore[arg-type]
    )  # fmt: skip
    frames = [f for f in simulate_frames(scene, RUN_FRAMES.seed(seed, 0)) if f.log_time_s < from_s]
    frames += [f for f in simulate_frames(knocked, RUN_FRAMES.seed(seed, 0)) if f.log_time_s >= from_s]
    return [make_event(cameras[f.camera], f.camera, f.log_time_s, f.pixels, frame=f.frame) for f in frames]


def knocks(loaded: LoadedConfig, of_scene: list[Event]) -> tuple[list[Knock], RunFigures]:
    cameras = loaded.build_cameras()
    figures, by_name = RunFigures(), {camera.name: camera for camera in cameras}
    found = []
    for record in run_estimator(build_filter(loaded.config, cameras, loaded.path, 1), of_scene):
        figures.add(record, by_name)
        found += [record.knock] if record.knock is not None else []
    return found, figures


@pytest.mark.parametrize(
    ("name", "turn_deg", "shift"),
    [
        ("left", (0.5, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ("right", (0.0, 2.0, 0.0), (0.0, 0.0, 0.0)),
        ("middle", (0.0, 0.0, 0.0), (0.09, 0.0, 0.0)),
    ],
)
def test_a_knocked_camera_is_named(
    name: str, turn_deg: tuple[float, ...], shift: tuple[float, ...], loaded: LoadedConfig
) -> None:
    (knock,), figures = knocks(loaded, events(loaded, name, turn_deg, shift))
    assert knock.camera == name
    assert KNOCK_S <= knock.time_s < KNOCK_S + 1.0
    assert knock.since_s == pytest.approx(KNOCK_S, abs=0.3)
    assert np.sum(turn_deg) == 0.0 or knock.turn_deg == pytest.approx(np.sum(turn_deg), rel=0.3)
    (finding,) = check_knocks(figures.report({}, 0, 0), ())
    assert finding.status == "warning"
    assert finding.camera == name
    # a clock that is off from then on makes rays meet again if times jump, and hardly if the camera was turned
    before = Finding("geometry.rays", "ok", "", 0.8, 0.9)
    for met, late, cause in ((0.7, name, "times_jump"), (0.3, name, "knocked"), (0.7, "another", "knocked")):
        clock = Finding("geometry.cause", "warning", "its clock is off", 0.2, met, late, None, "clock_offset")
        (finding,) = check_knocks(figures.report({}, 0, 0), (before,), {knock.time_s: (clock,)}.__getitem__)
        assert finding.cause == cause
    # a wrong noise or clock looks the same, and so does the wrong pose of another camera; wrong clutter does not
    for doubt, cause, of, status in (
        ("detector.sigma", "sigma", None, "not checked"),
        ("detector.clutter", "clutter", None, "warning"),
        ("detector.clutter", "clutter", "another", "warning"),
        ("log.pixels", "pixels", None, "warning"),
        ("geometry.residuals", "pose_inaccurate", name, "warning"),
        ("geometry.residuals", "pose_inaccurate", "another", "not checked"),
        ("geometry.cause", "rays_do_not_meet", "another", "not checked"),
    ):
        before = Finding(doubt, "warning", "it is wrong", camera=of, cause=cause)
        (finding,) = check_knocks(figures.report({}, 0, 0), (before,))
        assert finding.status == status


@pytest.mark.parametrize(
    ("name", "turn_deg", "shift"), [("right", (0.0, 0.0, 0.5), (0.0, 0.0, 0.0)), ("middle", (0.0, 0.0, 0.0), FORWARD)]
)
def test_a_knock_that_tracks_follow_is_noticed_and_named(
    name: str, turn_deg: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    """Residuals are larger by a fraction of the noise: no single frame shows it."""
    long = of_objects(6, 20.0)
    (knock,), _ = knocks(long, events(long, name, turn_deg, shift, 15.0))
    assert knock.camera == name
    assert 15.0 <= knock.time_s < 20.0
    assert knock.since_s == pytest.approx(15.0, abs=1.1)
    assert knock.turn_deg == pytest.approx(0.5, abs=0.2)


def test_a_slow_camera_is_asked_about_by_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """At one frame a second every block has one: a question after each would cost as much as the filter."""
    questions = []
    monkeypatch.setattr(test_of_knocks, "find_change", lambda *given: questions.append(given) or find_change(*given))
    slow = of_objects(6, 45.0, [f"cameras.{name}.frame_rate_hz=1" for name in ("left", "right", "middle")])
    of_scene = events(slow, "right", (0.0, 0.5, 0.0), (0.0, 0.0, 0.0), 30.0)
    (knock,), _ = knocks(slow, of_scene)
    assert knock.camera == "right"
    assert knock.time_s <= 35.0
    # while the noise is learnt every block is asked, and for the sake of the one that was knocked all cameras are
    learning = 3 * BLOCKS
    frames = sum(event.time_s <= knock.time_s for event in of_scene)
    assert 0 < len(questions) <= frames / LOOKS_A_QUESTION + learning + 3 < frames / 2


def test_a_slow_camera_is_known_before_long() -> None:
    """A knock after 18 s is noticed at one frame a second as soon as one after 30."""
    slow = of_objects(6, 40.0, [f"cameras.{name}.frame_rate_hz=1" for name in ("left", "right", "middle")])
    (knock,), _ = knocks(slow, events(slow, "right", (0.0, 0.5, 0.0), (0.0, 0.0, 0.0), 18.5))
    assert knock.time_s <= 25.0


def test_one_look_is_no_knock_however_loud() -> None:
    """A board that jumps: the first camera to see it had turned by two corners, and the real board was called so."""
    ratios = np.full((12, len(all_turns().spread) + 1), 50.0)
    ratios[:, 1:] = -1.0
    likely = np.tile(np.arange(12)[:, None], ratios.shape[1])  # each has a detection of its own
    sums, since_s = _added(None, None, ratios, likely, 1.0, 7.0)
    assert sums is not None
    assert sums.argmax() == 0
    assert 0.5 * _threshold() < sums.max() < _threshold()
    sums, since_s = _added(sums, since_s, ratios, likely, 1.0, 7.2)
    assert sums is not None
    assert since_s is not None
    assert (sums[0] > _threshold(), since_s[0]) == (True, 7.0)


def test_cameras_that_stay_raise_no_alarm(loaded: LoadedConfig) -> None:
    found, figures = knocks(loaded, events(loaded, "left", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert found == []
    assert not list(check_knocks(figures.report({}, 0, 0), ()))


@pytest.mark.parametrize("name", ["look_at_frame", "turn_ratios", "frame_ratios"])
def test_the_kernels_of_the_test_are_loaded_before_the_first_frame(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A form for other types of arguments would be loaded, or compiled, while frames wait."""
    kinds, kernel = [], getattr(turns, name)

    def spy(*arguments: object) -> object:
        kinds.append(tuple(map(numba.typeof, arguments)))
        return kernel(*arguments)

    for module in (turns, test_of_knocks):
        monkeypatch.setattr(module, name, spy)
    turns.prepare_turns()
    prepared = len(kinds)
    few = of_objects(3)
    knocks(few, events(few, "right", (0.0, 0.0, 0.9), (0.0, 0.0, 0.0)))
    assert prepared == 1 < len(kinds)
    assert len(set(kinds)) == 1
