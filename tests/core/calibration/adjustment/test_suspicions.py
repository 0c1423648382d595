"""What is stated as known is tested, on problems whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from stereophd.core.calibration.adjustment.marginal import marginal_optimum
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment, adjust
from stereophd.core.calibration.adjustment.suspicions import (
    QuadraticPosterior,
    Suspicion,
    quadratic_posterior,
    suspect,
)
from stereophd.core.calibration.adjustment.track_moves import TrackMoves
from stereophd.core.calibration.unknowns.held import LENS_STD, EnlargedSet, HeldGroup, enlarge
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.quantities.base import IMAGES
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from tests.core.calibration.problems_of_unknowns import observe, problem_of, rig, unknowns

PERIODS = np.array([0.1, 1 / 7, 0.2])
POSES = ("center", "rotation")


def posed(lens: Lens, stated: Lens) -> tuple[Problem, Adjustment]:
    """Poses adjusted to detections by cameras of one lens, where another is stated."""
    true = tuple(replace(camera, lens=lens) for camera in rig())
    observations, _, points = observe(true, 1, 4, 8.0)
    cameras: tuple[Camera, ...] = tuple(replace(camera, lens=stated) for camera in true)
    problem, states = problem_of(unknowns(cameras, POSES), observations, points)
    return problem, marginal_optimum(problem, adjust(problem, np.zeros(problem.parameters.size), states))


def suspicions_of(problem: Problem, found: Adjustment) -> tuple[EnlargedSet, list[Suspicion]]:
    enlarged = enlarge(problem.parameters, 0, PERIODS)
    quadratic = quadratic_posterior(problem, enlarged, found)
    return enlarged, suspect(quadratic, enlarged, np.arange(problem.parameters.size))


def test_a_lens_that_was_stated_as_none_is_named_with_its_value() -> None:
    problem, found = posed(Lens("radial", k1=-0.1), Lens())
    enlarged, suspicions = suspicions_of(problem, found)
    worst = suspicions[0]
    assert worst.is_contradicted
    assert worst.group.quantity == "distortion"
    named = [enlarged.parameters.names[i] for i in worst.group.places]
    assert named == [f"cam{number}.{name}" for number in range(3) for name in LENS_STD]
    truth = np.where([name.endswith("k1") for name in named], -0.1, 0.0)
    assert (np.abs(worst.values - truth) < 5.0 * worst.stds).all()


def test_what_is_stated_right_is_not_contradicted() -> None:
    problem, found = posed(Lens(), Lens())
    _, suspicions = suspicions_of(problem, found)
    assert not any(suspicion.is_contradicted for suspicion in suspicions)
    assert max(suspicion.expected_move for suspicion in suspicions) < 1.0


@pytest.mark.parametrize(("quantity", "evidence", "unknown"), [
    (IMAGES, -4.0, True), (IMAGES, -5.0, False), ("focal", -4.0, False), ("focal", 11.0, False), ("focal", 12.0, True),
])  # fmt: skip
def test_images_that_nobody_measured_are_unknown_until_the_data_show_them(
    quantity: str, evidence: float, unknown: bool
) -> None:
    group = HeldGroup(quantity, ("left.focal",), np.arange(1), 1e-3, True)
    suspicion = Suspicion(group, np.zeros(1), np.ones(1), evidence, 0.0, 1.0, 1.0, np.zeros((1, 1)))
    assert suspicion.is_unknown == unknown


def test_the_evidence_is_that_of_a_gaussian_model() -> None:
    # y = A x + e with x ~ N(0, I): the last value is held at 0, or free
    rng = np.random.default_rng(3)
    matrix, data = rng.standard_normal((8, 3)), 2.0 * rng.standard_normal(8)
    held = multivariate_normal(np.zeros(8), np.eye(8) + matrix[:, :2] @ matrix[:, :2].T).logpdf(data)
    free = multivariate_normal(np.zeros(8), np.eye(8) + matrix @ matrix.T).logpdf(data)
    precision = matrix.T @ matrix + np.eye(3)
    optimum = np.append(np.linalg.solve(precision[:2, :2], matrix[:, :2].T @ data), 0.0)
    gradient = precision @ optimum - matrix.T @ data
    names = ParameterSet(rig()[:1], unknowns(rig(), ("principal_point", "focal")).parameters[:3])
    enlarged = EnlargedSet(names, (HeldGroup("focal", ("cam0.focal",), np.array([2]), 1e-3, is_unmeasured=False),))
    tracks = TrackMoves(np.ones((1, 3)), np.zeros((1, 3, 3)), np.zeros(3))
    (suspicion,) = suspect(QuadraticPosterior(gradient, precision, tracks), enlarged, np.array([0, 1]))
    assert suspicion.log_evidence == pytest.approx(free - held)
    value = np.linalg.solve(precision, matrix.T @ data)[2] * names.prior_std[2]
    assert suspicion.values == pytest.approx([value])
    # that of the residuals is half of the square of the value, in its standard deviations
    assert suspicion.gain == pytest.approx(0.5 * (value / suspicion.stds[0]) ** 2)
    certain = replace(suspicion, log_evidence=30.0, gain=33.0)
    assert [certain.is_contradicted_at(widening) for widening in (1.0, 1.5, 3.0)] == [True, True, False]


def test_a_move_of_tracks_is_counted_but_for_the_growth_of_the_cameras() -> None:
    points = np.array([[0.0, 0.0, 100.0], [10.0, 0.0, 120.0], [0.0, -5.0, 90.0]])
    # the first value moves points by their own depth; the second is the scale
    slopes = np.stack([points * [0.0, 0.0, 1.0], points], axis=2)
    moves = TrackMoves(points, slopes, np.array([0.0, 1.0]))
    assert moves.relative_move(np.array([0.03, 0.0])) == pytest.approx(0.03, rel=0.01)
    assert moves.relative_move(np.array([0.0, 0.5])) == 0.0
