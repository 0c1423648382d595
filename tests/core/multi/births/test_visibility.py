"""Existence outside every view: against the cameras' own projection, and in the filters."""

from __future__ import annotations

import numpy as np
import pytest

from stereophd.core.disparity.events import make_event, make_rig
from stereophd.core.disparity.moved import IN_VIEW, OUT_OF_VIEW, room_for_moved
from stereophd.core.disparity.space import DisparitySpace
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.multi.base import FilterState
from stereophd.core.multi.births.survival import keep_surviving_weights
from stereophd.core.multi.state.inputs import EventNumbers
from stereophd.core.multi.state.mixture import GaussianMixture
from tests.core.disparity.cases import make_camera
from tests.core.multi.scenes import make_filter, make_mixture

NO_DETECTIONS = np.empty((0, 2))


def test_it_fades_where_no_camera_has_the_mean_in_view() -> None:
    """States all about two cameras, moved on for two seconds, against `Camera.project`."""
    cameras = [make_camera((0.0, -0.26, 0.0), (-20.0, 0.0, 0.0)), make_camera((0.0, 0.26, 0.0), (20.0, 0.0, 0.0))]
    rng = np.random.default_rng(3)
    space = DisparitySpace(cameras[0], 1.0)
    points = np.array([0.0, 0.0, 120.0]) + rng.normal(0.0, 60.0, (200, 3)) * [1.0, 1.0, 0.6]
    velocities = rng.normal(0.0, 20.0, (200, 3))
    ahead = cameras[0].pose.to_camera(points)[:, 2] > 5.0
    points, velocities = points[ahead], velocities[ahead]
    means = space.from_world(np.concatenate([points, velocities], axis=1))
    later = points + 2.0 * velocities
    seen = np.zeros(len(points), dtype=bool)
    for camera in cameras:
        seen |= np.asarray(camera.in_view(later))
    assert 0.2 < seen.mean() < 0.8
    packed = make_rig(cameras, 1.0, "horizontal").packed
    weights = np.ones(len(points))
    homes, motion = (
        np.repeat(packed[:1], len(points), axis=0),
        ConstantVelocity([0.0] * 3).arrays(np.full(len(points), 2.0)),
    )
    names = np.zeros(len(points), dtype=np.int64)
    mixture = GaussianMixture(
        weights, means, np.empty((len(points), 6, 6)), names, np.zeros(len(points)), names, names, names > 0
    )
    moved = room_for_moved(len(points), 6)._replace(status=np.full(len(points), OUT_OF_VIEW))
    numbers = EventNumbers(1, 1.5, 1.5, 0, 0, 0.9, 0.0, 1.0, 1.0, 5.0, 0.0, 0.0)
    keep_surviving_weights(weights, mixture, moved, homes, motion, packed, numbers)
    np.testing.assert_allclose(weights, np.where(seen, 1.0, np.exp(-1.5 / 5.0)), rtol=1e-12)
    weights = np.ones(len(points))
    seen_moved = moved._replace(status=np.full(len(points), IN_VIEW))
    keep_surviving_weights(weights, mixture, seen_moved, homes, motion, packed, numbers)
    np.testing.assert_array_equal(weights, 1.0)
    keep_surviving_weights(weights, mixture, moved, homes, motion, packed, numbers._replace(out_of_view_s=np.inf))
    np.testing.assert_array_equal(weights, 1.0)


@pytest.mark.parametrize("time_constant", [5.0, np.inf])
def test_an_object_between_two_views_keeps_its_identity(time_constant: float) -> None:
    """Two cameras side by side whose views leave a gap: the object crosses it in some four seconds."""
    cameras = [make_camera((0.0, 0.0, 0.0), (x, 0.0, 0.0), clutter=0.01) for x in (0.0, 120.0)]
    multi_filter = make_filter(cameras, ConstantVelocity([0.01] * 3, 10.0), out_of_view_s=time_constant)
    space = DisparitySpace(cameras[0], 1.0)
    truth = np.array([40.0, 0.0, 112.0, 5.0, 0.0, 0.0])
    mean = space.from_world(truth[None])[0]
    mixture = make_mixture([0.99], [mean], [np.diag([0.5, 0.5, 0.01, 0.01, 0.01, 1e-4])], tracks=[7], reported=[True])
    state, unseen, weights = FilterState(mixture, 0.0, 1, 1, 8), 0, []
    for second in range(1, 12):
        position = truth[None, :3] + second * truth[3:]
        views = [bool(camera.in_view(position)[0]) for camera in cameras]
        unseen += not any(views)
        for index, camera in enumerate(cameras):
            pixels = camera.project(position) if views[index] else NO_DETECTIONS
            state, _, estimates = multi_filter.step(state, make_event(camera, index, float(second), pixels))
        weights.append(state.mixture.weights[state.mixture.tracks == 7].sum())
    assert 3 <= unseen <= 5
    ratios = np.array(weights[1:]) / weights[:-1]
    assert np.abs(ratios - 0.99 * np.exp(-1.0 / time_constant)).min() < 1e-9
    assert estimates.track_ids.tolist() == [7]
    assert weights[-1] > 0.95
