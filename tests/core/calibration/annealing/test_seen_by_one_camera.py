"""Stretches of trajectories that joint optima put into the only camera that sees them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import LinAlgError

from stereophd.core.calibration.adjustment.problem import Observations
from stereophd.core.calibration.adjustment.solver import adjust
from stereophd.core.calibration.annealing import fits
from stereophd.core.calibration.annealing.fits import FITTED_LOSS, adjusted_to, part_of
from stereophd.core.calibration.annealing.known_scale import rescaled
from stereophd.core.calibration.annealing.rejected import collapsed
from stereophd.core.calibration.annealing.task import Fit
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement, log_scale

from ..problems_of_unknowns import MOTION, observe, problem_of, rig, unknowns


def found(cameras: list[int], distances: list[float], far: float = 9.0) -> list[bool]:
    """Which detections of one trajectory, in order of time, have collapsed.

    The distances are those from the camera of each detection; the object is far from the other camera.
    """
    count = len(cameras)
    both = np.full((count, 2), far)
    both[np.arange(count), cameras] = distances
    return collapsed(np.zeros(count, dtype=np.int64), np.arange(count, dtype=float), np.array(cameras), both).tolist()


@pytest.mark.parametrize(
    ("cameras", "distances", "expected"),
    [
        # at the end, at the start, and between what two cameras see
        ([0, 1, 0, 1, 0, 0, 0], [8, 9, 8, 9, 4, 2, 0.01], [False] * 4 + [True] * 3),
        ([0, 0, 1, 0, 1, 0], [0.01, 4, 9, 8, 9, 8], [True] * 2 + [False] * 4),
        ([0, 1, 0, 1, 1, 1, 0, 1, 0], [8, 9, 8, 9, 0.01, 9, 8, 9, 8], [False] * 3 + [True] * 3 + [False] * 3),
        # most of the detections, but one stretch
        ([0, 1, 0, 1] + [0] * 20, [8, 9, 8, 9] + [0.01] * 20, [False] * 4 + [True] * 20),
        # an object that comes near
        ([0, 1, 0, 1, 0, 0, 0], [8, 9, 8, 9, 4, 2, 1], [False] * 7),
        ([0], [8], [False]),
        ([], [], []),
    ],
)
def test_a_stretch_that_ends_in_its_camera_has_collapsed(
    cameras: list[int], distances: list[float], expected: list[bool]
) -> None:
    assert found(cameras, distances) == expected


def test_a_camera_that_is_near_the_objects_stays_beside_others_far_away() -> None:
    """Camera 0 is 0.1 from the object all the time, cameras 1 and 2 at 9: most stretches are of those."""
    distances = np.tile([0.1, 9.0, 9.0], (9, 1))
    cameras = np.array([1, 2, 0, 1, 2, 1, 0, 0, 0])
    assert not collapsed(np.zeros(9, dtype=np.int64), np.arange(9.0), cameras, distances).any()
    distances[8, 0] = 0.001
    assert (
        collapsed(np.zeros(9, dtype=np.int64), np.arange(9.0), cameras, distances).tolist() == [False] * 6 + [True] * 3
    )


def test_trajectories_are_apart_and_their_order_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    trajectories = np.repeat([0, 1, 2], 7)
    times = np.tile(np.arange(7.0), 3)
    cameras = np.tile([0, 1, 0, 1, 0, 0, 0], 3)
    distances = np.full((21, 2), 9.0)
    distances[np.arange(21), cameras] = np.tile([8.0, 9.0, 8.0, 9.0, 4.0, 2.0, 0.01], 3)
    distances[:7] *= 100.0
    distances[7:14] = 0.1
    expected = np.concatenate([np.zeros(4), np.ones(3), np.zeros(7), np.zeros(4), np.ones(3)]).astype(bool)
    for order in (np.arange(21), rng.permutation(21)):
        out = collapsed(trajectories[order], times[order], cameras[order], distances[order])
        np.testing.assert_array_equal(out, expected[order])


def of_rows(observations: Observations, rows: np.ndarray) -> Observations:
    """Some of the observations."""
    columns = {one.name: getattr(observations, one.name) for one in fields(observations)}
    return replace(observations, **{name: one if one is None else one[rows] for name, one in columns.items()})


def nearest(fit: Fit, camera: int, task: Any) -> float:
    """The least distance of a knot from the camera, length."""
    center = task.parameters.build(fit.adjustment.values)[camera].pose.center
    return float(np.linalg.norm(fit.adjustment.states[:, 0] - center, axis=1).min())


@dataclass(frozen=True)
class SomeTask:
    """What adjustments need of a task."""

    parameters: ParameterSet
    seen: Observations
    scale: ScaleMeasurement | None = None
    reference: int = 0
    filter: Any = field(default_factory=lambda: SimpleNamespace(motion=MOTION))

    def observations(self, _: object, trajectories: np.ndarray, detections: np.ndarray) -> Observations:
        return replace(of_rows(self.seen, detections), trajectories=trajectories)


def one_alone() -> tuple[Any, Fit, np.ndarray]:
    """Two objects that all cameras see, and one that after three seconds camera 0 alone sees; and the true values."""
    true = unknowns(rig(), ("center", "rotation"))
    drawn = true.sample(np.random.default_rng(100), 1)[0]
    observations, _, points = observe(true.cameras, 1, 3, 15.0)
    seen = np.isfinite(observations.points).all(axis=1) & (np.abs(observations.points - [400, 300]) < [600, 500]).all(1)
    rows = np.flatnonzero(seen & ((observations.trajectories > 0) | (observations.cameras == 0) |
                                  (observations.times < 3.0)))  # fmt: skip
    observations, points = of_rows(observations, rows), points[rows]
    guess = true.about(true.guess(drawn))
    problem, states = problem_of(guess, observations, points, FITTED_LOSS)
    joint = Fit(adjust(problem, drawn, states), problem.knots, observations, np.arange(len(observations)))
    return SomeTask(guess, observations), joint, drawn


def test_an_object_that_one_camera_alone_sees_for_long_is_not_put_into_the_camera() -> None:
    task, joint, drawn = one_alone()
    assert nearest(joint, 0, task) < 0.2  # the fault of the joint optimum

    observations = joint.observations
    fit = adjusted_to(task, joint, observations, joint.detections)
    assert nearest(fit, 0, task) > 1.0
    np.testing.assert_array_equal(fit.detections, joint.detections)
    error = fit.adjustment.values - drawn
    assert error @ np.linalg.solve(fit.adjustment.covariance, error) < 4.0 * len(drawn)


def test_a_stretch_from_which_the_marginal_search_does_not_come_back_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So it is for four cameras of unknown lenses and twenty objects; here the search finds nothing."""

    def fails(*_: object) -> None:
        raise LinAlgError

    task, joint, _ = one_alone()
    monkeypatch.setattr(fits, "marginal_optimum", fails)
    observations = joint.observations
    fit = adjusted_to(task, joint, observations, joint.detections)
    assert nearest(fit, 0, task) > 1.0
    left = np.setdiff1d(joint.detections, fit.detections)
    assert len(left)
    assert (observations.trajectories[left] == 0).all()
    assert (observations.cameras[left] == 0).all()
    assert (observations.times[left] > 3.0 - 0.2).all()  # what two cameras see stays


def test_a_stretch_that_lets_no_knots_settle_is_left_out_before_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four cameras and twenty objects half of the search for a start's optimum was spent with such a stretch."""
    task, joint, _ = one_alone()
    begun, search = list[int](), fits.marginal_optimum

    def searched(problem: Any, *more: Any) -> Any:
        begun.append(len(problem.observations))
        return search(problem, *more)

    monkeypatch.setattr(fits, "marginal_optimum", searched)
    for limit, stays in ((fits.KNOTS_NEAR, True), (1e-3, False)):
        begun.clear()
        monkeypatch.setattr(fits, "KNOTS_NEAR", limit)
        adjusted_to(task, joint, joint.observations, joint.detections)
        assert (begun[0] == len(joint.detections)) == stays
        assert len(begun) == 1


def test_a_known_scale_holds_where_a_stretch_had_collapsed() -> None:
    task, joint, _ = one_alone()
    size, _ = log_scale(task.parameters, task.reference, joint.adjustment.values)
    fit = rescaled(task, joint, ScaleMeasurement("log_scale", size + 0.1, 1e-3))
    assert nearest(fit, 0, task) > 1.0
    found, gradient = log_scale(task.parameters, task.reference, fit.adjustment.values)
    assert found == pytest.approx(size + 0.1, abs=3e-3)
    assert gradient @ fit.adjustment.covariance @ gradient <= 1.01e-3**2


def test_a_part_without_the_second_camera_of_an_object_leaves_the_object_out() -> None:
    task, joint, _ = one_alone()
    seen = joint.observations
    part = part_of(task, joint, np.flatnonzero((seen.trajectories > 0) | (seen.cameras == 0)))
    assert part is not None
    assert set(part.observations.trajectories) == set(seen.trajectories[part.detections]) == {1, 2}
    assert part_of(task, joint, np.flatnonzero(seen.cameras == 0)) is None
