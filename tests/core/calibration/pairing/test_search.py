"""Pairings of one-camera tracks, and the scale at which a filter tracks while that of the cameras is free."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.annealing.starts import paired, run_start
from stereophd.core.calibration.annealing.task import PAIRING, WIDE, Start, Task
from stereophd.core.calibration.annealing.tracking_scale import depth_ratio
from stereophd.core.calibration.pairing.refinement import behind
from stereophd.core.calibration.pairing.search import distinct_pairings
from stereophd.core.calibration.pairing.track_pairs import TrackPairs, make_pairs
from stereophd.core.calibration.settings import AnnealedSettings
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import enlarged, reduced
from stereophd.core.geometry.pose import Pose, rotation_from_vector
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.problems import make_template
from tests.core.calibration.scenes import MadeUp, make_problem

FRAMES, OBJECTS = 40, 4


def begun(task: Task) -> Start:
    """The first start of a task."""
    values = task.parameters.prior_mean
    return run_start(task, 0, values, paired(task, 0, values, np.random.SeedSequence(1)))


def recording_of(made: MadeUp) -> Recording:
    """Log of a problem: every frame has the detections of all objects."""
    seen = made.observations
    frames = []
    for time_s in np.unique(seen.times).tolist():
        for camera in range(len(made.parameters.cameras)):
            here = (seen.times == time_s) & (seen.cameras == camera)
            frames.append((camera, time_s, seen.points[here], None))
    return Recording.of(made.parameters.cameras, frames)


def pairs_of(made: MadeUp) -> TrackPairs:
    """Pairs of the true one-camera tracks: track number is camera times objects plus object."""
    recording = recording_of(made)
    scans = Scans.of(recording, made.parameters.cameras)
    rows = np.arange(len(recording.pixels)).reshape(-1, 2, OBJECTS)
    tracks = [(camera, rows[:, camera, j]) for camera in range(2) for j in range(OBJECTS)]
    return make_pairs(made.parameters, scans, tracks)


@pytest.fixture(scope="module")
def made() -> MadeUp:
    return make_problem(5, OBJECTS, FRAMES)


def test_the_best_pairing_is_right_and_all_are_distinct(made: MadeUp) -> None:
    pairs = pairs_of(made)
    draws = made.parameters.sample(np.random.default_rng(1), 64)
    found = distinct_pairings(made.parameters, pairs, draws)
    best = pairs.tracks[found[0].chosen]
    assert (best[:, 1] - best[:, 0] == OBJECTS).all()
    assert len(best) == OBJECTS
    assert np.abs(found[0].values - made.truth)[3:].max() < 0.02
    gains = [pairing.gain for pairing in found]
    assert gains == sorted(gains, reverse=True)
    for k, one in enumerate(found):
        assert made.parameters.prior_disagreement(one.values) is None
        for other in found[:k]:
            near = (np.abs(one.values - other.values) <= 0.25 * made.parameters.prior_std).all()
            assert not (near and set(one.chosen.tolist()) == set(other.chosen.tolist()))


@pytest.mark.parametrize("yaw", [0.0, 0.2, -0.6])
def test_pairs_behind_a_camera_are_those_whose_triangulated_points_are(made: MadeUp, yaw: float) -> None:
    pairs = pairs_of(made)
    values = made.truth + np.array([0.0, 0.0, 0.0, 0.0, yaw, 0.0])
    a, b = made.parameters.build(values)
    wrong = np.zeros(len(pairs.cameras))
    count = np.zeros(len(pairs.cameras))
    for pair, (ray_a, ray_b) in zip(pairs.pair, pairs.rays.rays, strict=True):
        along = np.column_stack([a.pose.rotation.T @ ray_a, -(b.pose.rotation.T @ ray_b)])
        depths = np.linalg.lstsq(along, b.pose.center - a.pose.center, rcond=None)[0]
        wrong[pair] += depths.min() < 0.0
        count[pair] += 1
    expected = wrong > 0.5 * count
    assert (behind(made.parameters, pairs, values) == expected).all()
    if yaw == 0.0:
        same = pairs.tracks[:, 1] - pairs.tracks[:, 0] == OBJECTS
        assert not expected[same].any()
    if yaw < 0.0:
        assert expected.any()


def test_enlarged_cameras_see_enlarged_points_in_the_same_pixels(made: MadeUp) -> None:
    left, right = made.parameters.build(made.truth)
    moving = replace(right, pose=Pose(right.pose.rotation, right.pose.center, [0.3, 0.1, 0.0], [0.0, 0.01, 0.0]))
    points = np.array([[3.0, -4.0, 120.0], [-10.0, 5.0, 180.0]])
    large = enlarged((left, moving), 0, 2.5)
    far = left.pose.center + 2.5 * (points - left.pose.center)
    for time_s in (0.0, 7.0):
        assert large[1].at(time_s).project(far) == pytest.approx(moving.at(time_s).project(points))
    assert reduced(far, large, 0, 2.5) == pytest.approx(points)


def far_too_close(made: MadeUp) -> Task:
    """A task whose prior has the cameras a quarter of their distance apart, and leaves the scale open."""
    true = made.parameters.build(made.truth)
    left, right = true
    turned = rotation_from_vector([0.0, 0.05, 0.0]) @ right.pose.rotation
    near = replace(right, pose=Pose(turned, left.pose.center + 0.25 * (right.pose.center - left.pose.center)))
    template = make_template((left, near), "pmb", ConstantVelocity([0.001] * 3, 12.0))
    assert isinstance(template, PmbFilter)
    parameters = ParameterSet((left, near), made.parameters.parameters)
    return Task.of(parameters, 0, template, recording_of(made), None, AnnealedSettings())


def test_a_start_finds_cameras_whose_scale_is_far_off(made: MadeUp) -> None:
    task = far_too_close(made)
    start = begun(task)
    assert start.succeeded, start.outcome
    assert start.origin.startswith(PAIRING)
    assert start.fit is not None
    assert depth_ratio(task, start.fit) == pytest.approx(4.0, rel=0.6)
    # at this scale the truth has the centre of the guess, and its turn is 0.05 rad back
    error = start.fit.adjustment.values + np.array([0.0, 0.0, 0.0, 0.0, 0.05, 0.0])
    assert (np.abs(error) < 4.0 * np.sqrt(np.diag(start.fit.adjustment.covariance))).all()


def test_a_start_without_pairs_begins_wide(made: MadeUp) -> None:
    task = far_too_close(made)
    none = np.empty(0, dtype=np.int64)
    pairs = replace(task.pairs, cameras=none.reshape(0, 2), tracks=none.reshape(0, 2), pair=none)
    start = begun(replace(task, pairs=pairs))
    assert start.origin == WIDE
