"""The fits of the annealed method: what each associates, holds and finds; and when one disagrees with the data."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.marginal import MarginalPosterior
from stereophd.core.calibration.adjustment.problem import Problem
from stereophd.core.calibration.adjustment.solver import Adjustment
from stereophd.core.calibration.adjustment.track_moves import TrackMoves
from stereophd.core.calibration.adjustment.trajectories import OF_ALL
from stereophd.core.calibration.annealing import fits
from stereophd.core.calibration.annealing.fits import (
    HISTORY_PART,
    HISTORY_TIMES,
    adjusted_to,
    fit_from,
    history_of,
    marginal_fit,
    paired_fit,
    pairings_of,
    part_of,
    readjusted,
    refitted,
    tracked_fit,
)
from stereophd.core.calibration.annealing.method import (
    FREE,
    Calibrated,
    Choices,
    calibrated,
    may_be_freed,
    spread_remarks,
    statement_remarks,
    suspected,
    with_freed,
)
from stereophd.core.calibration.annealing.starts import (
    NOISE_AS_STATED,
    disagreement,
    evidence,
    explained,
    squared_residuals,
)
from stereophd.core.calibration.annealing.task import Fit, Task
from stereophd.core.calibration.pairing.track_pairs import make_pairs
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.calibration.unknowns.quantities.base import IMAGES
from stereophd.core.geometry.camera import Clock
from stereophd.core.geometry.lens import Lens
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.pairing.test_search import FRAMES, OBJECTS, begun, recording_of
from tests.core.calibration.problems import make_template
from tests.core.calibration.scenes import MadeUp, make_problem


@pytest.fixture(scope="module")
def made() -> MadeUp:
    return make_problem(5, OBJECTS, FRAMES)


@pytest.fixture(scope="module")
def task(made: MadeUp) -> Task:
    template = make_template(made.parameters.cameras, "pmb", ConstantVelocity([0.001] * 3, 12.0))
    assert isinstance(template, PmbFilter)
    recording = recording_of(made)
    return Task.of(made.parameters, 0, template, recording, None, AnnealedSettings())


@pytest.fixture(scope="module")
def paired(task: Task) -> Fit:
    return paired_fit(task, pairings_of(task, task.parameters.prior_mean, np.random.SeedSequence(1))[0])


@pytest.fixture(scope="module")
def right(task: Task) -> Calibrated:
    """The answer of one start, with the noise as it is."""
    starts = [begun(task)]
    return calibrated(replace(task, settings=AnnealedSettings(starts=1)), starts, Choices())


def objects_of(fit: Fit) -> list[set[int]]:
    """True objects of the detections of each trajectory: a log holds all objects of each frame in their order."""
    objects = fit.detections % OBJECTS
    return [set(objects[fit.observations.trajectories == j].tolist()) for j in range(fit.knots.count)]


def check_near_truth(made: MadeUp, fit: Fit) -> None:
    """The scale apart, which the data leave open, the values lie within four of their standard deviations."""
    error = fit.adjustment.values - made.truth
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(fit.adjustment.covariance))).all()


def test_a_fit_of_paired_tracks_has_one_object_in_each_trajectory(made: MadeUp, paired: Fit) -> None:
    assert sorted(map(sorted, objects_of(paired))) == [[j] for j in range(OBJECTS)]
    check_near_truth(made, paired)


def test_a_pair_is_fitted_while_both_its_tracks_last(made: MadeUp, task: Task) -> None:
    """Of the first camera two tracks go over to each other's object half-way; those of the second end there."""
    rows = np.arange(len(task.recording.pixels)).reshape(-1, 2, OBJECTS)
    half, swapped = len(rows) // 2, np.r_[1, 0, 2:OBJECTS]
    mixed = [(0, np.concatenate([rows[:half, 0, j], rows[half:, 0, swapped[j]]])) for j in range(OBJECTS)]
    tracks = (*mixed, *((1, rows[:half, 1, j]) for j in range(OBJECTS)))
    pairs = make_pairs(task.parameters, task.tracking, tracks)
    task = replace(task, tracks=tracks, pairs=pairs)
    fit = paired_fit(task, pairings_of(task, task.parameters.prior_mean, np.random.SeedSequence(1))[0])
    assert sorted(map(sorted, objects_of(fit))) == [[j] for j in range(OBJECTS)]
    check_near_truth(made, fit)


def test_a_pair_is_fitted_to_its_first_and_last_common_detections(made: MadeUp, paired: Fit) -> None:
    """The clock of a log takes true times to its own and back, which rounding changes."""
    clock, last = Clock(1.43, 1.03), FRAMES - 1.0
    assert clock.to_true(clock.to_log(last)) < last
    clocked = made.parameters.about([replace(camera, clock=clock) for camera in made.parameters.cameras])
    template = make_template(clocked.cameras, "pmb", ConstantVelocity([0.001] * 3, 12.0))
    assert isinstance(template, PmbFilter)
    recording = recording_of(replace(made, parameters=clocked))
    task = Task.of(clocked, 0, template, recording, None, AnnealedSettings())
    fit = paired_fit(task, pairings_of(task, clocked.prior_mean, np.random.SeedSequence(1))[0])
    np.testing.assert_array_equal(np.sort(fit.detections), np.sort(paired.detections))


def test_knots_are_as_near_as_the_noise_of_the_motion_that_was_found_asks_for(task: Task, paired: Fit) -> None:
    """The motion strays with the noise, and with the power of 1.5 of the time."""
    held = np.ones(task.parameters.size, dtype=np.bool_)
    seen, found = paired.observations, []
    for noise in (0.0, 3.0):
        begun = replace(paired, adjustment=replace(paired.adjustment, motion_noise=noise * OF_ALL), held=held)
        found.append(adjusted_to(task, begun, seen, paired.detections))
    spacings = [float(np.median(np.diff(fit.knots.times)[fit.knots.links()])) for fit in found]
    assert spacings[1] < 0.5 * spacings[0]


def test_an_optimum_that_the_prior_rules_out_does_not_count(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    pairing, adjusted = pairings_of(task, task.parameters.prior_mean, np.random.SeedSequence(1))[0], fits.adjust

    def run_away(problem: Problem, *rest: Any, **options: Any) -> Adjustment:
        joint = adjusted(problem, *rest, **options)
        return replace(joint, values=joint.values + 20.0 * problem.parameters.prior_std)

    shown = MarginalPosterior.with_shown_motion

    def best_of_all(posterior: MarginalPosterior, values: Array, states: Array, noise: Array) -> Any:
        if np.abs(values / task.parameters.prior_std).max() > 10.0:
            return SimpleNamespace(objective=-np.inf, unknowns=np.append(values, noise))
        return shown(posterior, values, states, noise)

    monkeypatch.setattr(fits, "adjust", run_away)
    monkeypatch.setattr(MarginalPosterior, "with_shown_motion", best_of_all)
    found = paired_fit(task, pairing).adjustment
    assert task.parameters.prior_disagreement(found.values) is None


def test_tracks_of_too_few_detections_are_no_fit(task: Task, paired: Fit) -> None:
    settings = AnnealedSettings(min_detections=FRAMES + 1)
    assert tracked_fit(replace(task, settings=settings), paired.adjustment.values, 1.0) is None


def test_trajectories_choose_all_their_detections_and_no_others(made: MadeUp, task: Task, paired: Fit) -> None:
    # a tenth of the detections in the wrong trajectory
    wrong = paired.observations.trajectories.copy()
    wrong[::10] = (wrong[::10] + 1) % OBJECTS
    mixed = replace(paired, observations=replace(paired.observations, trajectories=wrong))
    again = refitted(task, mixed)
    assert again is not None
    assert sorted(map(sorted, objects_of(again))) == [[j] for j in range(OBJECTS)]
    # three of a thousand detections lie beyond the gate of 3.7 standard deviations
    assert len(again.detections) > 0.98 * 2 * FRAMES * OBJECTS
    check_near_truth(made, again)


def test_the_history_ends_at_the_answer_and_is_wider_before(made: MadeUp, task: Task, paired: Fit) -> None:
    answer = marginal_fit(task, paired)
    *rows, last = history_of(task, answer, answer)
    np.testing.assert_array_equal(last.mean, answer.adjustment.values)
    assert np.all(np.diff([row.time_s for row in (*rows, last)]) > 0.0)
    shares = (np.array([row.time_s for row in (*rows, last)]) - task.recording.times[0]) / np.ptp(task.recording.times)
    np.testing.assert_allclose(shares, HISTORY_PART ** np.arange(HISTORY_TIMES)[::-1])
    at = task.recording.times[-1] * np.array([0.3, 0.6])
    asked = history_of(replace(task, history_times=at), answer, answer)
    assert [row.time_s for row in asked] == [*at, last.time_s]
    half, std = rows[-2], np.sqrt(np.diag(answer.adjustment.covariance))
    assert (np.diag(half.covariance)[1:] > 1.2 * std[1:] ** 2).all()  # the first is the scale, which nothing shows
    assert (np.abs(half.mean - made.truth) < 4.0 * np.sqrt(np.diag(half.covariance))).all()


def test_each_row_of_the_history_is_the_optimum_of_the_log_so_far(task: Task, paired: Fit) -> None:
    answer = marginal_fit(task, paired)
    for row in history_of(task, answer, answer)[:-1:3]:
        part = part_of(task, answer, np.flatnonzero(answer.observations.times <= row.time_s))
        assert part is not None
        alone = marginal_fit(task, adjusted_to(task, part, part.observations, part.detections)).adjustment
        error = row.mean - alone.values
        assert error @ np.linalg.solve(alone.covariance, error) < 0.1 * len(error)
    assert part_of(task, answer, np.flatnonzero(answer.observations.times < -1.0)) is None


def test_detections_that_share_errors_count_less_and_show_the_noise_at_full_weight(task: Task, paired: Fit) -> None:
    counted = task.with_noise(np.ones(2), np.array([0.0, 0.5]))
    cameras = task.parameters.build(paired.adjustment.values)
    observations = counted.observations(cameras, paired.observations.trajectories, paired.detections)
    assert observations.weights is not None
    np.testing.assert_array_equal(observations.weights[observations.cameras == 0], 1.0)
    assert np.median(observations.weights[observations.cameras == 1]) < 0.5
    still = refitted(counted, paired, still=True)
    assert still is not None
    assert still.observations.weights is None
    np.testing.assert_array_equal(still.adjustment.values, paired.adjustment.values)


def test_a_fit_from_the_truth_explains_the_log(made: MadeUp, task: Task) -> None:
    fit = fit_from(task, made.truth)
    assert fit is not None
    check_near_truth(made, fit)
    assert disagreement(task, fit) is None
    # without a tenth of its detections it explains as much less
    fewer = replace(fit, detections=fit.detections[: len(fit.detections) * 9 // 10])
    assert explained(task, fewer) == pytest.approx(0.9 * explained(task, fit), rel=0.01)


def test_what_disagrees_is_named(made: MadeUp, task: Task) -> None:
    fit = fit_from(task, made.truth)
    assert fit is not None
    adjustment = fit.adjustment
    few = disagreement(task, replace(fit, detections=fit.detections[:10]))
    assert few is not None
    assert few.startswith("shared tracks explain only")
    large = replace(fit, adjustment=replace(adjustment, distances=np.full_like(adjustment.distances, 32.0)))
    assert disagreement(task, large) == "residuals are 4.0 times the detector's noise"
    far = replace(fit, adjustment=replace(adjustment, values=9.0 * task.parameters.prior_std))
    assert str(disagreement(task, far)).endswith("standard deviations from the prior")


def test_core_alone_calibrates(made: MadeUp, task: Task, right: Calibrated) -> None:
    check_near_truth(made, right.fit)
    assert right.doubt == ""
    assert (right.believed.noise == 1.0).all()
    assert right.believed.given_up == ()
    assert not any(remark.is_reservation for remark in right.remarks)
    # of an answer that is doubted no values are said
    first = next(one for one in right.believed.held if one.group.quantity == "principal_point")
    contradicted = replace(first, log_evidence=1e3, values=np.full(len(first.values), 2.67e6))
    for statements in ({"held": (contradicted,)}, {"given_up": (contradicted,)}):
        believed = replace(right.believed, **statements)
        said, doubted = (statement_remarks(believed, is_doubted=one)[0].text for one in (False, True))
        assert "+2.67e+06 +- " in said
        assert "+" not in doubted
        assert f"stated: another {contradicted.group.names[0]}" in doubted
    # images that the data do not show to be exact are estimated, which contradicts nothing
    images = replace(first, group=replace(first.group, quantity=IMAGES), log_evidence=-3.0)
    (said,) = statement_remarks(replace(right.believed, given_up=(images,), held=()), False)
    assert said.text.startswith("the data do not show that images are as stated: ")
    # what errors that last may do as well is no contradiction
    for log_evidence, widening, is_sure in ((20.0, 1.0, True), (20.0, 2.6, False), (200.0, 2.6, True)):
        believed = replace(right.believed, held=(replace(first, log_evidence=log_evidence, gain=log_evidence + 5.0),))
        text = statement_remarks(believed, False, widening)[0].text
        assert text.startswith("the data contradict what is stated: ") == is_sure
        assert ("may fit better, or errors of detections last; " in text) != is_sure
    # two cameras do not show their focal lengths
    focal = next(one for one in right.believed.held if one.group.quantity == "focal")
    wrong = replace(focal, log_evidence=1e3)
    assert not may_be_freed(wrong, Choices(model=FREE), task.parameters)
    (said,) = (one for one in statement_remarks(replace(right.believed, held=(wrong,)), False) if one.topic == "model")
    assert said.text.endswith(f"another {', '.join(focal.group.names)} fits; measure it: two cameras do not show it")
    assert may_be_freed(first, Choices(model=FREE), task.parameters)
    # and where tracks depend on these, a warning says so
    for moves, count in ((2.5, 1), (0.5, 0)):
        held = (replace(focal, moves=moves, expected_move=0.1, log_evidence=-5.0),)
        remarks = statement_remarks(replace(right.believed, given_up=(), held=held), False)
        assert [one.is_reservation for one in remarks] == [False] * count
        assert all("off by 2.5 of their stated standard deviations" in one.text for one in remarks)


def test_cameras_that_leave_tracks_uncertain_by_a_large_part_of_their_distance_are_partly_determined() -> None:
    moves = TrackMoves(np.array([[0.0, 0.0, 10.0]]), np.eye(3)[None, :, :], np.zeros(3))  # the point is the values
    few, many = (spread_remarks(moves, std**2 * np.eye(3)) for std in (0.5, 1.0))  # of a distance of 10, times sqrt(3)
    assert few == ()
    assert [one.is_reservation for one in many] == [True]
    assert "by 17 % of their distance" in many[0].text


def test_a_noise_that_is_stated_too_small_lets_a_start_succeed(made: MadeUp, task: Task) -> None:
    small = task.with_noise(np.array([0.5, 0.5]))
    fit = fit_from(small, made.truth)
    assert fit is not None
    assert squared_residuals(fit).mean() > NOISE_AS_STATED
    assert disagreement(small, fit) is None
    # the evidence is that at the noise of the residuals
    assert evidence(small, fit) == pytest.approx(evidence(task, fit), abs=30.0)


def test_noise_that_is_stated_wrong_is_replaced(made: MadeUp, task: Task, right: Calibrated) -> None:
    stated = task.with_noise(np.array([3.0, 3.0]))
    starts = [begun(stated)]
    result = calibrated(stated, starts, Choices())
    np.testing.assert_allclose(result.believed.noise, 1.0 / 3.0, rtol=0.2)
    assert [remark.topic for remark in result.remarks].count("noise") == 2
    check_near_truth(made, result.fit)
    stds, expected = (np.sqrt(np.diag(r.fit.adjustment.covariance)) for r in (result, right))
    np.testing.assert_allclose(stds, expected, rtol=0.25)


def test_a_lens_is_freed_as_it_is_stated_and_found_from_there(made: MadeUp, task: Task) -> None:
    seen, pixels = made.observations, np.empty_like(made.observations.points)
    for number, plain in enumerate(made.parameters.build(made.truth)):
        here, bent = seen.cameras == number, replace(plain, lens=Lens("radial", k1=-0.3))
        noise = seen.points[here] - plain.project(made.positions[here])
        pixels[here] = bent.project(made.positions[here]) + 0.05 * noise
    log = recording_of(replace(made, observations=replace(seen, points=pixels)))
    loose = replace(task, recording=log)
    exact, fit = loose.with_noise(np.full(2, 0.05)), fit_from(loose, made.truth)
    assert fit is not None
    answer = marginal_fit(exact, readjusted(exact, fit, still=True))
    enlarged, suspicions = suspected(exact, answer)
    lenses = next(one for one in suspicions if one.group.quantity == "distortion" and len(one.values) == 8)
    freed, begin = with_freed(exact, answer, enlarged, lenses)
    more = freed.parameters.size - len(answer.adjustment.values)
    assert begin.adjustment.values.tolist() == [*answer.adjustment.values, *np.zeros(more)]
    found = marginal_fit(freed, begin).adjustment
    first = [number for number, name in enumerate(freed.parameters.names) if name.endswith(".k1")]
    values, stds = found.values[first], np.sqrt(np.diag(found.covariance))[first]
    assert found.converged
    assert (stds < 0.1).all()
    assert (np.abs(values + 0.3) < 3.0 * stds).all()
    # all else that nobody measured is freed with it: a clock, and the rest of images that makers state, which have not
    # two focal lengths
    square = replace(loose, parameters=loose.parameters.about([replace(c, fy=c.fx) for c in loose.parameters.cameras]))
    for stated, expected in ((loose, 12), (square, 20)):
        enlarged, suspicions = suspected(stated, answer)
        lenses = next(one for one in suspicions if one.group.quantity == "distortion" and len(one.values) == 8)
        assert len(enlarged.unmeasured_with(lenses.group)) == expected
