"""Still objects: tracks as one measurement, pairs of one row, relative poses from minimal sets of unlabelled points."""

import numpy as np
import pytest

from stereophd.core.calibration import still_points
from stereophd.core.calibration.pairing import make_pairs
from stereophd.core.calibration.parameters import Parameter, ParameterSet
from stereophd.core.calibration.quantities.center import CENTER
from stereophd.core.calibration.quantities.rotation import ROTATION
from stereophd.core.calibration.recording import Recording, Scans
from stereophd.core.calibration.still_points import StillTracks, minimal_set_draws, still_tracks

from .scenes import STDS, MadeUp, make_problem


def recorded(problem: MadeUp) -> tuple[Scans, list[tuple[int, np.ndarray]]]:
    """The detections of a problem as scans, and the true one-camera tracks among them."""
    seen = problem.observations
    order = np.lexsort((seen.trajectories, seen.cameras, seen.times))
    keys = np.column_stack([seen.times, seen.cameras])[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(keys, axis=0) != 0).any(axis=1)])
    ends = np.r_[starts[1:], len(order)]
    frames = [
        (int(keys[a, 1]), float(keys[a, 0]), seen.points[order[a:b]], None) for a, b in zip(starts, ends, strict=True)
    ]
    recording = Recording.of(problem.parameters.cameras, frames)
    of, camera = seen.trajectories[order], seen.cameras[order]
    tracks = [(c, np.flatnonzero((camera == c) & (of == j))) for c in np.unique(camera) for j in np.unique(of)]
    return Scans.of(recording, problem.parameters.cameras), tracks


@pytest.mark.parametrize("still", [True, False])
def test_what_stands_still_is_one_measurement(still: bool) -> None:
    problem = make_problem(1, objects=7, frames=20, still=still)
    scans, tracks = recorded(problem)
    found = still_tracks(scans, tracks)
    assert found.mostly == still
    pairs = make_pairs(problem.parameters, scans, tracks)
    assert len(pairs.cameras) == 49
    whole = np.bincount(pairs.pair, weights=pairs.weights)
    rows = np.bincount(pairs.pair)
    both = found.still[pairs.tracks].all(axis=1)
    np.testing.assert_allclose(whole, np.where(both, 1.0, rows))
    assert both.mean() == (1.0 if still else pytest.approx(0.0, abs=0.05))
    assert rows.min() > 6


def points_of(cameras: tuple, count: int, seed: int) -> StillTracks:
    """Unlabelled means of points before two cameras, a tenth of a pixel off."""
    rng = np.random.default_rng(seed)
    world = rng.uniform([-25, -20, 100], [25, 20, 220], (count, 3))
    pixels = [camera.project(world)[rng.permutation(count)] for camera in cameras]
    numbers = np.repeat(np.arange(len(cameras)), count)
    points = np.concatenate(pixels) + 0.1 * rng.standard_normal((len(numbers), 2))
    return StillTracks(numbers, points, np.full(len(numbers), 0.1), np.ones(len(numbers), dtype=bool))


def test_minimal_sets_find_the_camera_among_unlabelled_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(still_points, "HYPOTHESES", 3000)
    monkeypatch.setattr(still_points, "IMPROVED", 100)
    problem = make_problem(3, still=True)
    true = problem.parameters.build(problem.truth)
    found = points_of(true, 20, 4)
    draws = minimal_set_draws(problem.parameters, found, 0, (1 / 150, 1 / 400), np.random.default_rng(5))
    assert draws.shape[1] == 6
    assert 0 < len(draws) <= still_points.KEPT
    rotation = np.array([name in ROTATION for name in (p.name for p in problem.parameters.parameters)])
    errors = np.degrees(np.linalg.norm((draws - problem.truth)[:, rotation], axis=1))
    off = np.degrees(np.linalg.norm(problem.truth[rotation]))
    # half of the prior's error at most: from there the adjustment of all tracks goes on
    assert errors.min() < 0.5 * off


def test_components_that_are_known_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(still_points, "HYPOTHESES", 500)
    monkeypatch.setattr(still_points, "IMPROVED", 50)
    cameras = make_problem(6).parameters.cameras
    names = dict(zip(CENTER + ROTATION, STDS, strict=True))
    parameters = ParameterSet(cameras, tuple(Parameter(n, "right", 0.0, names[n]) for n in ("center_z", "rotation_y")))
    draws = minimal_set_draws(parameters, points_of(cameras, 15, 7), 0, (1 / 150, 1 / 400), np.random.default_rng(8))
    assert draws.shape[1] == 2
    assert np.degrees(abs(draws[0, 1])) < 0.5


@pytest.mark.parametrize("count", [0, 4])
def test_fewer_points_than_a_minimal_set_give_nothing(count: int) -> None:
    parameters = make_problem(9).parameters
    few = points_of(parameters.cameras, count, 1)
    assert len(minimal_set_draws(parameters, few, 0, (1 / 150, 1 / 400), np.random.default_rng(1))) == 0
    assert not few.mostly or count > 2
