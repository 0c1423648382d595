"""Cameras of one instant, and false objects that one camera goes on to see."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stereophd.core.bodies.filter import BodyFilter
from stereophd.core.bodies.hypotheses import Hypotheses, reassociate
from stereophd.core.bodies.outline import outline_boxes
from stereophd.core.disparity.events import make_event, make_rig
from stereophd.core.geometry.camera import Camera
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.filter_settings.common import BirthPrior
from stereophd.core.multi.filter_settings.pmb import PmbSettings
from stereophd.core.multi.state.estimates import Estimates
from tests.core.bodies.cameras import camera_at, people, standing

CAMERAS = (
    camera_at([-1.0, -1.0, 2.8], [5.0, 4.0, 0.9], "a"),
    camera_at([11.0, -1.0, 2.8], [5.0, 4.0, 0.9], "b"),
    camera_at([5.0, 9.0, 2.8], [5.0, 4.0, 0.9], "c"),
)


def test_rounds_over_cameras_converge_to_the_sum_over_joint_associations() -> None:
    """Two tracks that both claim box 0 of camera 0, one of which has a box of its own in camera 1."""
    owners, boxes = np.array([0, 0, 0, 1, 1]), np.array([[-1, -1], [0, -1], [0, 0], [-1, -1], [0, -1]])
    odds, rest = np.array([0.1, 3.0, 9.0, 0.2, 6.0]), np.array([0.05, 0.3])
    totals, evidence = np.zeros(5), 0.0
    for first, second in itertools.product([-1, 0, 1, 2], [-1, 3, 4]):
        if first >= 1 and second == 4:
            continue
        weight = (odds[first] if first >= 0 else rest[0]) * (odds[second] if second >= 0 else rest[1])
        totals[[row for row in (first, second) if row >= 0]] += weight
        evidence += weight
    weights = odds / (rest + np.bincount(owners, odds))[owners]
    hypotheses = Hypotheses(
        owners, weights, np.zeros((5, 8)), np.tile(np.eye(8), (5, 1, 1)), boxes, np.ones((5, 2)), np.full(5, -1)
    )
    for camera in (0, 1, 0):
        hypotheses = reassociate(hypotheses, camera, 2, 1)
    assert hypotheses.weights == pytest.approx(totals / evidence)


def run(
    seen: dict[int, list[np.ndarray]], order: tuple[int, ...], instant_s: float = 0.02, instants: int = 12
) -> Estimates:
    """Return what is reported after people stood before the cameras of a rig, each with those that it sees."""
    cameras: tuple[Camera, ...] = tuple(CAMERAS[k] for k in sorted(seen))
    settings = PmbSettings(birth=BirthPrior(per_s=0.1, velocity_std=0.7))
    shape = people(instant_s=instant_s)
    body_filter = BodyFilter(make_rig(cameras, 1.0, "horizontal"), ConstantVelocity(0.8), shape, settings)
    state = body_filter.init()
    generator = np.random.default_rng(1)
    for step in range(instants):
        noise = {k: 4.0 * generator.standard_normal((len(seen[k]), 4)) for k in sorted(seen)}
        for k in order:
            boxes, _ = outline_boxes(np.reshape(seen[k], (-1, 8)), cameras[k], shape.direction)
            boxes = boxes + noise[k]
            middles = np.stack([boxes[:, 0], (boxes[:, 1] + boxes[:, 2]) / 2], axis=1)
            sizes = np.stack([boxes[:, 3], boxes[:, 2] - boxes[:, 1]], axis=1)
            state, _, estimates = body_filter.step(
                state, make_event(cameras[k], k, 0.25 * step, middles, None, step, sizes)
            )
    return estimates


def test_what_one_camera_alone_goes_on_to_see_is_no_body() -> None:
    person, poster = standing(4.0, 3.0), standing(6.0, 5.0, height=1.5)
    estimates = run({0: [person, poster], 1: [person], 2: [person]}, (0, 1, 2))
    assert len(estimates.states) == 1
    assert estimates.states[0, :2] == pytest.approx([4.0, 3.0], abs=0.2)
    # where no other camera looks, it is one
    assert len(run({0: [person, poster]}, (0,), instants=40).states) == 2


def test_the_order_of_the_cameras_of_an_instant_does_not_matter() -> None:
    people_there = [standing(4.0, 3.0), standing(4.6, 3.3), standing(5.0, 2.6)]
    seen = dict.fromkeys(range(3), people_there)
    results = [run(seen, order) for order in ((0, 1, 2), (2, 0, 1), (1, 2, 0))]
    places = [result.states[np.argsort(result.states[:, 0]), :2] for result in results]
    assert [len(place) for place in places] == [3, 3, 3]
    for other in places[1:]:
        assert other == pytest.approx(places[0], abs=0.02)


def test_frames_are_associated_one_by_one_where_that_is_stated() -> None:
    person = standing(4.0, 3.0)
    seen = {0: [person], 1: [person], 2: [person]}
    together, apart = run(seen, (0, 1, 2)), run(seen, (0, 1, 2), instant_s=0.0)
    assert together.states == pytest.approx(apart.states, abs=0.01)
    assert together.existence == pytest.approx(apart.existence, abs=0.01)
