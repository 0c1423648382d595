"""A known distance or speed, found among many tracks."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.trajectories import fit_states, interpolation, place_knots
from stereophd.core.calibration.annealing.known_scale import (
    ObjectPairs,
    known_distance,
    known_speed,
    object_pairs,
)
from stereophd.core.calibration.annealing.method import at_known_scale
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.motion.constant_velocity import ConstantVelocity

MOTION = ConstantVelocity(0.5)


def fit_of(paths: list[tuple[np.ndarray, np.ndarray]], spacing: float = 0.2) -> Any:
    """A fit whose trajectories follow paths: times and positions."""
    knots = place_knots([times for times, _ in paths], spacing, MOTION)
    numbers = np.concatenate([np.full(len(times), j) for j, (times, _) in enumerate(paths)])
    times = np.concatenate([times for times, _ in paths])
    points = np.concatenate([points for _, points in paths])
    states = fit_states(knots, *interpolation(knots, numbers, times), points, np.full(len(times), 1e8))
    return SimpleNamespace(knots=knots, adjustment=SimpleNamespace(states=states))


def board_paths(seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Corners of a board that turns and moves, each seen for two or three of eight seconds, and four other objects."""
    rng = np.random.default_rng(seed)
    out = []
    for row in range(3):
        for column in range(4):
            begin = rng.uniform(0.0, 2.5)
            times = np.arange(begin, begin + rng.uniform(2.0, 3.0), 0.1)
            turn = 0.3 * times
            x, y = 0.06 * column * np.cos(turn), 0.06 * column * np.sin(turn)
            out.append((times, np.column_stack([x + 0.1 * times, y, 0.06 * row + 1.0 + 0.05 * np.sin(times)])))
    for _ in range(4):
        times = np.arange(0.0, 5.0, 0.1)
        start, velocity = rng.uniform(-0.3, 0.3, (2, 3))
        out.append((times, start + times[:, None] * velocity))
    return out


def crowd(seed: int, rod: bool, together: float) -> tuple[Any, float]:
    """Sixty objects, each seen for some of 30 s, a part of which move alike, and perhaps a rod of 15; log of the scale.

    The rod sways and turns by some 0.5 rad; all positions are as noisy as those of tracks (0.15).
    """
    rng = np.random.default_rng(seed)
    paths, scale = [], float(np.exp(rng.normal(0.0, 0.12)))
    if rod:
        times = np.arange(0.0, 30.0, 0.25)
        phases, periods = rng.uniform(0.0, 6.0, (5, 1)), rng.uniform(4.0, 12.0, (5, 1))
        waves = np.sin(2.0 * np.pi * times / periods + phases)
        middle, yaw, roll = (15.0 * waves[:3]).T + [0.0, 0.0, 150.0], 0.5 * waves[3], 0.5 * waves[4]
        arm = 7.5 * np.column_stack([np.cos(yaw) * np.cos(roll), np.cos(yaw) * np.sin(roll), np.sin(yaw)])
        paths += [(times, middle - arm), (times, middle + arm)]
    common = rng.normal(0.0, 3.0, 3)
    for _ in range(60):
        times = rng.uniform(0.0, 27.0) + np.arange(0.0, 2.0 + rng.exponential(8.0), 0.25)
        alike = rng.uniform() < together
        velocity = common + rng.normal(0.0, 0.3, 3) if alike else rng.normal(0.0, 3.0, 3)
        start = rng.uniform([-40.0, -30.0, 100.0], [40.0, 30.0, 220.0])
        paths.append((times, start + (times - times.mean())[:, None] * velocity))
    noisy = [(times, scale * (points + 0.15 * rng.standard_normal(points.shape))) for times, points in paths]
    return fit_of(noisy, 1.0), -float(np.log(scale))


def test_neighbouring_corners_are_found_among_many_tracks_seen_for_seconds() -> None:
    # the cameras' guess makes everything a tenth too large: 0.06 is found for a known 0.054
    pairs = object_pairs(fit_of(board_paths(1)))
    assert len(pairs.rigid()) > 30
    found = known_distance(pairs, 0.054, 0.0, 0.1)
    assert found is not None
    assert np.exp(found[0]) == pytest.approx(0.9, rel=0.003)
    assert found[1] < 0.005


def test_pairs_that_hardly_move_do_not_count() -> None:
    times = np.arange(0.0, 4.0, 0.1)
    slow = 0.01 * times[:, None] * [1.0, 0.0, 0.0]
    pairs = object_pairs(fit_of([(times, slow), (times, slow + [0.0, 0.1, 0.0])]))
    assert not len(pairs.rigid())
    assert known_distance(pairs, 0.1, 0.0, 0.1) is None
    fast = 10.0 * slow
    pairs = object_pairs(fit_of([(times, fast), (times, fast + [0.0, 0.1, 0.0])]))
    np.testing.assert_allclose(pairs.distances, 0.1, rtol=1e-3)
    assert pairs.spreads[0] < 1e-3


@pytest.mark.parametrize(("seconds", "taken"), [(20.0, True), (0.2, False)])
def test_where_the_prior_allows_no_distance_a_pair_that_chance_does_not_make_is_taken(
    seconds: float, taken: bool
) -> None:
    """Of four pairs one keeps its distance of 3 to 0.1 %, for 20 s or for so short a time that any would."""
    spreads, members = np.array([0.3, 0.001, 0.3, 0.3]), np.array([[0, 1], [0, 2], [1, 2], [0, 3]])
    times = np.array([20.0, seconds, 20.0, 20.0])
    pairs = ObjectPairs(np.array([1.0, 3.0, 2.0, 4.0]), spreads, np.array([10.0, 2.0, 10.0, 10.0]), times, members)
    found = known_distance(pairs, 30.0, 0.0, 0.05)
    assert found == (pytest.approx((np.log(10.0), 0.001)) if taken else None)


def test_the_ends_of_a_wand_need_no_other_objects() -> None:
    rod = crowd(3, True, 0.0)[0]
    pairs = object_pairs(rod)
    alone = np.flatnonzero((pairs.members == [0, 1]).all(axis=1))
    pairs = ObjectPairs(*(values[alone] for values in vars(pairs).values()))
    found = known_distance(pairs, 15.0, 0.0, 0.12)
    assert found is not None
    assert np.exp(found[0]) * pairs.distances[0] == pytest.approx(15.0)


@pytest.mark.parametrize("together", [0.0, 0.5])
def test_pairs_that_keep_their_distance_by_chance_are_not_taken_for_the_known_one(together: float) -> None:
    """Of 16 scenes of objects that move alike, the most frequent distance was a wrong one in nine."""
    answers = 0
    for seed in range(8):
        fit, true = crowd(seed, True, together)
        found = known_distance(object_pairs(fit), 15.0, 0.0, 0.12)
        if found is not None:
            answers += 1
            assert abs(found[0] - true) < 0.02
            assert found[1] < 0.02
    assert answers >= (6 if together == 0.0 else 1)


@cache
def pairs_without_a_rod(seed: int, together: float) -> ObjectPairs:
    """The pairs of a crowd, which two tests ask."""
    return object_pairs(crowd(seed, False, together)[0])


@pytest.mark.parametrize("together", [0.0, 0.5])
def test_without_a_rod_a_distance_is_seldom_found(together: float) -> None:
    """One distance was always found before."""
    pairs = [pairs_without_a_rod(seed, together) for seed in range(8)]
    # some pairs do keep their distance
    assert sum(len(one.rigid()) for one in pairs) > 6
    assert sum(known_distance(one, 15.0, 0.0, 0.12) is not None for one in pairs) <= 2


def test_chance_makes_as_many_rigid_pairs_as_expected() -> None:
    """The expected number of pairs as rigid as the k-th is about k, whatever moves alike."""
    for together in (0.0, 0.5):
        ratios = []
        for seed in range(6):
            pairs = pairs_without_a_rod(seed, together)
            expected = np.sort(pairs.by_chance(pairs.moving)[pairs.moving])
            ratios.append(expected[:30] / np.arange(1.0, 31.0))
        assert 0.6 < np.median(ratios) < 1.5


def body_pairs(seed: int, points: int) -> tuple[ObjectPairs, float, float]:
    """All pairs of the points of a rigid body, the distance of the first two, and the logarithm of the scene's size."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, (points, 3))
    members = np.array([(j, i) for i in range(points) for j in range(i)])
    distances = np.linalg.norm(corners[members[:, 0]] - corners[members[:, 1]], axis=1)
    size, count = float(rng.normal(0.0, 0.3)), len(members)
    spreads = rng.uniform(1e-3, 3e-3, count)
    pairs = ObjectPairs(distances * np.exp(size), spreads, np.full(count, 10.0), np.full(count, 20.0), members)
    return pairs, float(distances[0]), size


def test_a_rigid_body_of_irregular_distances_seldom_gives_a_wrong_scale() -> None:
    """Four and six points: 23 and 33 of 60 were wrong while the number of pairs of other lengths was not compared."""
    for points in (4, 6):
        wrong = 0
        for seed in range(60):
            pairs, length, size = body_pairs(seed, points)
            found = known_distance(pairs, length, 0.0, 0.3)
            wrong += found is not None and abs(found[0] + size) > 0.02
        assert wrong < 15


@pytest.mark.parametrize("prior_std", [0.1, 0.3])
def test_a_board_is_measured_where_its_diagonals_are_possible_too(prior_std: float) -> None:
    found = [known_distance(object_pairs(fit_of(board_paths(seed))), 0.054, 0.0, prior_std) for seed in range(6)]
    assert sum(one is not None for one in found) >= 5
    assert all(one is None or abs(one[0] - np.log(0.9)) < 0.005 for one in found)


def test_where_the_prior_leaves_no_scale_free_no_distance_is_looked_for() -> None:
    pairs, length, _ = body_pairs(0, 4)
    assert known_distance(pairs, length, 0.0, 0.0) is None


def test_where_two_centres_are_known_neither_speeds_nor_lengths_measure_the_scale() -> None:
    cameras = tuple(
        SimpleNamespace(name=name, pose=SimpleNamespace(center=np.array([x, 0.0, 0.0])))
        for name, x in (("a", 0.0), ("b", 1.0))
    )
    parameters = SimpleNamespace(cameras=cameras, index=lambda _name, _quantity: np.full(3, -1))
    task: Any = SimpleNamespace(parameters=parameters, reference=0)
    fit = fit_of(board_paths(1))
    for known in (ScaleMeasurement("length", 0.06, 0.001), ScaleMeasurement("speed", 0.1, 0.001)):
        same, again, (remark,) = at_known_scale(task, fit, known)
        assert same is task
        assert again is fit
        assert f"the known {known.kind} was not used" in remark.text


def test_objects_of_another_speed_do_not_move_the_scale() -> None:
    """Errors over their standard deviations, a quarter of the objects having any speed; the mean would be 20 off."""
    rng = np.random.default_rng(4)
    errors, means = [], []
    for _ in range(300):
        speeds = 3.0 * np.exp(0.05 * rng.standard_normal(12))
        odd = rng.uniform(size=12) < 0.25
        speeds[odd] *= np.exp(rng.normal(0.0, 1.5, odd.sum()))
        found = known_speed(speeds, 3.0, 0.15)
        if found is not None:
            errors.append(found[0] / found[1])
            means.append(np.log(3.0 / speeds).mean() / (0.05 / np.sqrt(12.0)))
    assert len(errors) > 250
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.6
    assert np.sqrt(np.mean(np.square(means))) > 10.0


def test_two_groups_of_speeds_are_no_known_speed() -> None:
    rng = np.random.default_rng(5)
    speeds = np.repeat([1.0, 5.0], 6) * np.exp(0.02 * rng.standard_normal(12))
    assert known_speed(speeds, 1.0, 0.05) is None
    found = known_speed(speeds[:9], 1.0, 0.05)
    assert found is not None
    assert found[0] == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("factor", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("half", [3, 6, 20, 100])
def test_equal_groups_of_speeds_give_no_scale_and_two_to_one_the_larger(factor: float, half: int) -> None:
    equal, larger = 0, 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        one, other = (speed * np.exp(0.03 * rng.standard_normal(half)) for speed in (10.0, 10.0 * factor))
        equal += known_speed(np.concatenate([one, other]), 10.0, 0.1) is None
        found = known_speed(np.concatenate([one, other[: half // 2]]), 10.0, 0.1)
        larger += found is not None and abs(found[0]) < 0.05
    assert equal >= 19
    assert larger >= (10 if half == 3 else 16)


def test_three_equal_groups_of_speeds_give_no_scale() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        speeds = np.repeat([10.0, 14.0, 20.0], 20) * np.exp(0.01 * rng.standard_normal(60))
        assert known_speed(speeds, 10.0, 0.1) is None


def test_few_scales_are_wrong_where_a_quarter_of_the_speeds_is_odd() -> None:
    """At most 24 of 500 draws of 12 speeds are beyond three stated standard deviations."""
    for std in (0.05, 0.15):
        rng = np.random.default_rng(4)
        wrong = 0
        for _ in range(500):
            speeds = 3.0 * np.exp(std * rng.standard_normal(12))
            odd = rng.uniform(size=12) < 0.25
            speeds[odd] *= np.exp(rng.normal(0.0, 1.5, odd.sum()))
            found = known_speed(speeds, 3.0, 3.0 * std)
            wrong += found is not None and abs(found[0]) > 3.0 * found[1]
        assert wrong <= 24
