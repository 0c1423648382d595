"""Rigid bodies of a scene: points that keep their distances, velocities that fit, and the stated sway."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereophd.config.loading import load_config
from stereophd.core.geometry.pose import rotation_from_vector
from stereophd.core.geometry.rotations import rotations
from stereophd.core.simulation import bodies
from stereophd.core.simulation.bodies import Body, BodyPoint
from stereophd.core.simulation.objects import state_windows
from stereophd.core.simulation.timing import Schedule, TimeGrid
from stereophd.errors import InputError
from stereophd.pipeline.simulation import build_scene
from tests.core.simulation.scenes import NO_NOISE

POINTS = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.4, 0.1]])
CENTER = np.array([1.0, -2.0, 5.0])
STD = np.array([0.1, 0.2, 0.3, 0.4, 0.2, 0.1])


def body(seed: int = 4, period_s: tuple[float, float] = (2.0, 6.0), std: np.ndarray = STD) -> Body:
    turn = rotation_from_vector([0.3, -1.2, 0.5])
    return Body.drawn(POINTS, CENTER, turn, std, period_s, 1.0, np.random.default_rng(seed))


def test_points_of_a_body_keep_their_distances_while_they_move() -> None:
    times = np.linspace(1.0, 20.0, 300)
    paths = np.stack([body().states(k, times)[:, :3] for k in range(3)])
    assert np.ptp(paths, axis=1).min() > 0.1
    for i, j in ((0, 1), (0, 2), (1, 2)):
        expected = np.linalg.norm(POINTS[i] - POINTS[j])
        np.testing.assert_allclose(np.linalg.norm(paths[i] - paths[j], axis=1), expected, rtol=1e-12)


@pytest.mark.parametrize("size", [1.0, 1e-4, 0.0], ids=["turns", "hardly turns", "does not turn"])
def test_velocities_are_the_derivatives_of_positions(size: float) -> None:
    moving = body(std=STD * [1.0, 1.0, 1.0, size, size, size])
    times, step = np.linspace(1.0, 9.0, 40), 1e-5
    for k in range(3):
        before, after = moving.states(k, times - step)[:, :3], moving.states(k, times + step)[:, :3]
        np.testing.assert_allclose(moving.states(k, times)[:, 3:], (after - before) / (2.0 * step), atol=1e-8)


def test_a_body_sways_by_its_standard_deviation_about_its_middle() -> None:
    # 200 bodies over many periods: the mean square of a sum of harmonics is exact but for products of harmonics of
    # nearly one frequency; the point at the origin of the axes does not turn
    times = np.arange(0.0, 400.0, 0.5)
    paths = np.stack([body(seed).states(0, times)[:, :3] - CENTER for seed in range(200)])
    np.testing.assert_allclose(np.sqrt((paths**2).mean(axis=(0, 1))), STD[:3], rtol=0.02)
    np.testing.assert_allclose(paths.mean(axis=(0, 1)), 0.0, atol=0.01)


def test_the_pose_of_a_body_is_computed_once_for_all_of_its_points(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[int] = []

    def counted(vectors: np.ndarray) -> np.ndarray:
        computed.append(len(vectors))
        return rotations(vectors)

    monkeypatch.setattr(bodies, "rotations", counted)
    grid = TimeGrid((Schedule(7.0, 0.0, 1500.0),))
    first, second = body(), body(7)
    items = [BodyPoint(3 * k + point, one, point, 0.0) for k, one in enumerate((first, second)) for point in range(3)]
    windows = list(state_windows(items, grid, NO_NOISE))
    assert computed == [window.times_s.size for window in windows for _ in (first, second)]
    for window in windows:
        for item, states in zip(items, window.states, strict=True):
            # a body that was never asked before gives the same states
            np.testing.assert_array_equal(states, replace(item.body).states(item.point, window.times_s))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        pytest.param(["acceleration_std=0.1"], r"simulate.acceleration_std: expected objects or given", id="noise"),
        pytest.param(
            ["acceleration_std=[0.0, 0.0, 0.1]"],
            r"simulate.acceleration_std: expected .*, found bodies only",
            id="axis",
        ),
        pytest.param(
            ["motion={model: damped_velocity, time_constant_s: 2.0}"],
            r"simulate.motion: expected objects or given, .*, found bodies only",
            id="motion",
        ),
        pytest.param(
            ["motion={max_speed: 2.0}", "given=[{position: [0, 0, 1]}]"],
            "simulate.motion: expected no max_speed, .*, found 2",
            id="limit of speed",
        ),
        pytest.param(
            ["motion={acceleration_std: estimate}", "given=[{position: [0, 0, 1]}]"],
            "simulate.motion: expected a number as acceleration_std, .*, found estimate",
            id="estimate",
        ),
        pytest.param(["acceleration_std=0.0"], None, id="no noise"),
        pytest.param(["motion=null"], None, id="no motion"),
        pytest.param(["acceleration_std=0.1", "given=[{position: [0, 0, 1]}]"], None, id="noise of another object"),
        pytest.param(
            ["motion={acceleration_std: 0.1}", "given=[{position: [0, 0, 1]}]"], None, id="motion of another object"
        ),
    ],
)
def test_keys_of_a_scene_that_would_do_nothing_are_refused(changes: list[str], message: str | None) -> None:
    overrides = [f"simulate.{change}" for change in changes]
    if message is None:
        assert load_config("configs/board_calibration.yaml", overrides).config.simulate is not None
        return
    with pytest.raises(InputError, match=message):
        load_config("configs/board_calibration.yaml", overrides)


@pytest.mark.parametrize("other", ["objects={count: -3}", "given=[{velocity: [0, 0, 1]}]"])
@pytest.mark.parametrize("moves", ["acceleration_std=0.1", "motion={model: damped_velocity, time_constant_s: 2.0}"])
def test_objects_that_are_refused_themselves_are_not_said_to_be_missing(other: str, moves: str) -> None:
    with pytest.raises(InputError, match=rf"simulate.{other.partition('=')[0]}") as caught:
        load_config("configs/board_calibration.yaml", [f"simulate.{other}", f"simulate.{moves}"])
    assert "bodies only" not in str(caught.value)


def test_the_place_of_a_key_that_would_do_nothing_is_named(tmp_path: Path) -> None:
    text = Path("configs/board_calibration.yaml").read_text(encoding="utf-8")
    path = tmp_path / "config.yaml"
    path.write_text(text.replace("simulate:\n", "simulate:\n  acceleration_std: 0.5\n"), encoding="utf-8")
    line = path.read_text(encoding="utf-8").splitlines().index("  acceleration_std: 0.5") + 1
    with pytest.raises(InputError, match=rf"config.yaml:{line}: simulate.acceleration_std: expected"):
        load_config(path)


def test_a_scene_asks_points_window_by_window() -> None:
    grid = TimeGrid((Schedule(7.0, 0.0, 1500.0),))
    item = BodyPoint(5, body(), 1, 0.0)
    windows = list(state_windows([item], grid, NO_NOISE))
    assert len(windows) > 1
    for window in windows:
        assert window.object_id.tolist() == [5]
        np.testing.assert_array_equal(window.states[0], item.body.states(1, window.times_s))


def test_bodies_of_a_configuration_follow_other_objects_and_leave_them_as_they_are() -> None:
    path = "configs/board_calibration.yaml"
    other = "simulate.given=[{position: [0, 0, 1]}]"
    scenes = []
    for changes in ([other, "simulate.bodies=[]"], [other]):
        loaded = load_config(path, changes)
        cameras = [camera.build(name) for name, camera in loaded.cameras.items()]
        scenes.append(build_scene(loaded.config, cameras, np.random.SeedSequence(1)))
    alone, both = scenes
    assert [item.object_id for item in both.objects] == list(range(13))
    assert both.objects[0].noise_seed == alone.objects[0].noise_seed  # type: ignore[attr-defined]


def test_periods_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(InputError, match="period_s: expected shortest <= longest, found"):
        load_config("configs/board_calibration.yaml", ["simulate.bodies.0.period_s=[5, 2]"])
