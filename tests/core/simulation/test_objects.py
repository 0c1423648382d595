"""How objects move and how they are drawn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.simulation import drawing as drawing_module
from stereophd.core.simulation.drawing import Drawing, draw_objects
from stereophd.core.simulation.objects import MovingObject, Path, state_windows
from stereophd.core.simulation.timing import Schedule, TimeGrid
from stereophd.errors import InputError
from tests.core.simulation.scenes import NO_NOISE, camera, moving_object

BOX = (np.array([-2.0, -2.0, 5.0]), np.array([2.0, 2.0, 9.0]))


def grid(duration_s: float, rate_hz: float = 10.0) -> TimeGrid:
    return TimeGrid((Schedule(rate_hz, 0.0, duration_s),))


def draw(
    drawing: Drawing,
    cameras: Sequence[Camera],
    duration_s: float = 20.0,
    acceleration_std: float = 0.0,
    seed: int = 3,
) -> tuple[MovingObject, ...]:
    noise = ConstantVelocity(acceleration_std)
    return draw_objects(drawing, cameras, grid(duration_s), noise, np.random.SeedSequence(seed))


def test_without_noise_the_path_is_a_straight_line() -> None:
    item = moving_object((1.0, 2.0, 3.0), (0.1, -0.2, 0.3), birth_s=2.0)
    times = np.array([2.0, 2.5, 7.25])
    states = Path(item, NO_NOISE).states(times)
    np.testing.assert_allclose(states[:, :3], item.position + (times - 2.0)[:, None] * item.velocity, atol=1e-14)
    np.testing.assert_array_equal(states[:, 3:], np.broadcast_to(item.velocity, (3, 3)))


@given(st.integers(0, 60), st.integers(0, 60), st.floats(0.0, 3.0))
def test_a_path_does_not_depend_on_how_it_is_asked_for(first: int, second: int, noise: float) -> None:
    times = np.cumsum(np.random.default_rng(1).exponential(0.1, 60))
    item = moving_object(velocity=(1.0, 0.0, 0.0))
    whole = Path(item, ConstantVelocity(noise)).states(times)
    path = Path(item, ConstantVelocity(noise))
    cuts = sorted((first, second))
    pieces = [path.states(part) for part in np.split(times, cuts)]
    np.testing.assert_array_equal(np.concatenate(pieces), whole)


def test_process_noise_has_the_covariance_of_integrated_white_acceleration() -> None:
    # 8000 objects, one uneven step each from rest: sample covariances are within 5 standard errors,
    # sqrt((c_ij^2 + c_ii c_jj) / n).
    number, step, deviations = 8000, 0.7, np.array([0.5, 1.0, 2.0])
    items = [moving_object((0.0, 0.0, 0.0), object_id=k, noise_seed=k) for k in range(number)]
    ends = np.stack([Path(item, ConstantVelocity(deviations)).states(np.array([step]))[0] for item in items])
    for axis, deviation in enumerate(deviations):
        expected = deviation**2 * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        found = np.cov(ends[:, axis], ends[:, axis + 3])
        error = np.sqrt((expected**2 + np.outer(expected.diagonal(), expected.diagonal())) / number)
        assert (np.abs(found - expected) < 5 * error).all()
    across = np.corrcoef(ends[:, :3].T)[~np.eye(3, dtype=bool)]
    assert (np.abs(across) < 5 / np.sqrt(number)).all()


def test_many_small_steps_gain_as_much_as_one_large_step() -> None:
    # Exact discretisation: the end after 1 s has variance q / 3 however fine the grid; 4000 objects,
    # 5 standard errors of a variance, sqrt(2 / n).
    times = np.sort(np.random.default_rng(2).uniform(0, 1, 50))
    times[-1] = 1.0
    ends = [
        Path(moving_object((0.0, 0.0, 0.0), noise_seed=k), ConstantVelocity(1.0)).states(times)[-1] for k in range(4000)
    ]
    for found, expected in ((np.var(ends, axis=0)[:3], 1 / 3), (np.var(ends, axis=0)[3:], 1.0)):
        assert (np.abs(found / expected - 1) < 5 * np.sqrt(2 / 4000)).all()


def test_state_windows_hold_each_object_only_while_it_lives() -> None:
    items = [
        moving_object(object_id=0, birth_s=-3.0, velocity=(1.0, 0.0, 0.0)),
        moving_object(object_id=1, birth_s=250.0, death_s=700.0),
        moving_object(object_id=2, birth_s=450.05, death_s=450.06),  # between two instants: never
        moving_object(object_id=3, birth_s=1500.0),  # after the end
    ]
    seen: dict[int, list[float]] = {0: [], 1: [], 2: [], 3: []}
    lengths = []
    for window in state_windows(items, grid(1000.0), NO_NOISE):
        lengths.append(window.times_s.size)
        for row, identifier in enumerate(window.object_id):
            seen[int(identifier)].extend(window.times_s[~np.isnan(window.states[row, :, 0])])
    assert len(lengths) > 1
    np.testing.assert_allclose(seen[0], np.arange(10000) / 10, atol=1e-9)
    np.testing.assert_allclose([seen[1][0], seen[1][-1]], [250.0, 700.0])
    assert len(seen[1]) == 4501
    assert seen[2] == seen[3] == []


@pytest.mark.parametrize("acceleration_std", [0.0, 0.05])
def test_drawn_objects_stay_in_view_of_all_cameras(acceleration_std: float) -> None:
    cameras = [camera("a", (-1.0, 0.0, 0.0)), camera("b", (1.0, 0.0, 0.0), velocity=(0.02, 0.0, 0.0))]
    items = draw(Drawing(5, *BOX, velocity_std=0.2), cameras, acceleration_std=acceleration_std)
    times = grid(20.0).times(0.0, 20.0)
    for item in items:
        assert (item.position >= BOX[0]).all()
        assert (item.position <= BOX[1]).all()
        points = Path(item, ConstantVelocity(acceleration_std)).states(times)[:, :3]
        for seen_by in cameras:
            assert all(seen_by.at(time).in_view(points[[k]])[0] for k, time in enumerate(times))


def test_any_camera_is_enough_when_asked_for() -> None:
    # Two cameras that look at different places: no object is in view of both.
    cameras = [camera("a", (-20.0, 0.0, 0.0)), camera("b", (20.0, 0.0, 0.0))]
    wide = (np.array([-25.0, -2.0, 5.0]), np.array([25.0, 2.0, 9.0]))
    items = draw(Drawing(20, *wide, velocity_std=0.01, stay_in_view="any"), cameras)
    seen = np.array([[c.in_view(item.position[None])[0] for c in cameras] for item in items])
    assert seen.any(axis=1).all()
    assert not seen.all(axis=1).any()
    assert seen.any(axis=0).all()
    with pytest.raises(InputError, match="in view of all cameras"):
        draw(Drawing(1, *wide, velocity_std=0.01), cameras)


def test_objects_need_not_stay_in_view() -> None:
    behind = (np.array([-1.0, -1.0, -9.0]), np.array([1.0, 1.0, -5.0]))
    assert len(draw(Drawing(4, *behind, 1.0, stay_in_view="none"), [camera()])) == 4
    with pytest.raises(InputError, match=r"simulate\.objects: expected a box .* cameras camera"):
        draw(Drawing(1, *behind, 1.0), [camera()])


def test_births_are_poisson_and_lifetimes_exponential() -> None:
    # 2 births a second for 500 s: 1000 +- 5 * 32; lifetimes of mean 3 s: +- 5 standard errors.
    drawing = Drawing(7, *BOX, 0.1, stay_in_view="none", births_per_s=2.0, mean_lifetime_s=3.0)
    items = draw(drawing, [camera()], duration_s=500.0)
    births = np.array([item.birth_s for item in items])
    lives = np.array([item.death_s - item.birth_s for item in items])
    assert (births[:7] == 0.0).all()
    assert abs(births.size - 7 - 1000) < 5 * np.sqrt(1000)
    assert (np.diff(births) >= 0).all()
    assert abs(births[7:].mean() - 250) < 5 * 500 / np.sqrt(12 * 1000)
    assert abs(lives.mean() - 3.0) < 5 * 3.0 / np.sqrt(lives.size)
    assert abs(lives.std() - 3.0) < 5 * 3.0 * np.sqrt(2 / lives.size)
    assert [item.object_id for item in items] == list(range(len(items)))


@settings(max_examples=10)
@given(st.integers(0, 1000))
def test_positions_fill_the_box_and_velocities_have_their_spread(seed: int) -> None:
    # 400 objects: mean within 5 standard errors, spread within 5 standard errors.
    drawing = Drawing(400, *BOX, velocity_std=1.5, stay_in_view="none")
    items = draw(drawing, [camera()], seed=seed)
    positions = np.array([item.position for item in items])
    velocities = np.array([item.velocity for item in items])
    uniform_std = (BOX[1] - BOX[0]) / np.sqrt(12)
    assert (np.abs(positions.mean(axis=0) - (BOX[0] + BOX[1]) / 2) < 5 * uniform_std / 20).all()
    assert (np.abs(velocities.std(axis=0) / 1.5 - 1) < 5 / np.sqrt(2 * 400)).all()


def test_later_objects_do_not_change_earlier_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    few = draw(Drawing(3, *BOX, 0.2), [camera()])
    many = draw(Drawing(6, *BOX, 0.2), [camera()])
    for left, right in zip(few, many[:3], strict=True):
        np.testing.assert_array_equal(left.position, right.position)
    monkeypatch.setattr(drawing_module, "MAX_BATCHES", 0)
    with pytest.raises(InputError):
        draw(Drawing(1, *BOX, 0.2), [camera()])
