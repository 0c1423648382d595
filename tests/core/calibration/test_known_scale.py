"""A known distance, found among many tracks."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.calibration.known_scale import known_distance, rigid_pairs
from stereophd.core.calibration.trajectories import fit_states, interpolation, place_knots
from stereophd.core.motion.constant_velocity import ConstantVelocity

MOTION = ConstantVelocity(0.5)


def fit_of(paths: list[tuple[np.ndarray, np.ndarray]]) -> Any:
    """A fit whose trajectories follow paths: times and positions."""
    knots = place_knots([(times[0], times[-1]) for times, _ in paths], 0.2, MOTION)
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


def test_neighbouring_corners_are_found_among_many_tracks_seen_for_seconds() -> None:
    # the cameras' guess makes everything a tenth too large: 0.06 is found for a known 0.054
    distances, spreads, _ = rigid_pairs(fit_of(board_paths(1)))
    assert len(distances) > 30
    ratio, error = known_distance(distances, spreads, 0.054, 0.0, 0.1)
    assert np.exp(ratio) == pytest.approx(0.9, rel=0.003)
    assert error < 0.005


def test_pairs_that_hardly_move_do_not_count() -> None:
    times = np.arange(0.0, 4.0, 0.1)
    slow = 0.01 * times[:, None] * [1.0, 0.0, 0.0]
    distances, _, _ = rigid_pairs(fit_of([(times, slow), (times, slow + [0.0, 0.1, 0.0])]))
    assert not len(distances)
    fast = 10.0 * slow
    distances, spreads, _ = rigid_pairs(fit_of([(times, fast), (times, fast + [0.0, 0.1, 0.0])]))
    np.testing.assert_allclose(distances, 0.1, rtol=1e-3)
    assert spreads[0] < 1e-3


def test_where_the_prior_allows_no_distance_the_steadiest_pair_is_taken() -> None:
    ratio, error = known_distance(np.array([1.0, 3.0]), np.array([0.01, 0.001]), 30.0, 0.0, 0.05)
    assert ratio == pytest.approx(np.log(10.0))
    assert error == pytest.approx(0.001)
