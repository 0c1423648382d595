"""Conditional filters side by side: the same as one filter for each hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.sampling.likelihood import Evidence, at_nominal_scale, hypothesis_spaces
from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.disparity.events import make_rig
from stereophd.core.disparity.moved import OUT_OF_VIEW
from stereophd.core.geometry.pose import Pose
from stereophd.core.motion.base import Motion
from stereophd.core.motion.constant_velocity import ConstantVelocity
from stereophd.core.motion.static import Static
from stereophd.core.multi.base import FilterState
from stereophd.core.multi.camera_hypotheses.batch import BatchState, FilterBatch
from stereophd.core.multi.phd.filter import PhdFilter
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.problems import make_events, make_parameters, make_template, of_log
from tests.core.multi.scenes import BIRTHS, make_mixture, with_births

REGION = np.array([-60.0, 60.0, -50.0, 50.0, 20.0, 260.0, 10.0, 300.0])


@pytest.fixture
def parameters() -> ParameterSet:
    return make_parameters()


def with_cameras(template: PhdFilter | PmbFilter, parameters: ParameterSet, values: Array) -> PhdFilter | PmbFilter:
    """The filter of one hypothesis."""
    rig = make_rig(parameters.build(values), 1.0, "horizontal", template.rig.region)
    multi_filter = type(template)(rig, template.motion, template.sets, template.settings)  # type: ignore[arg-type]
    return with_births(multi_filter, BIRTHS)


@pytest.mark.parametrize(
    ("kind", "motion", "region", "settings"),
    [
        ("phd", None, None, {}),
        ("phd", None, REGION, {"merge_moments": "intensity"}),
        ("phd", Static(), None, {"max_components": 12, "missed": "keep"}),
        ("pmb", None, None, {}),
        ("pmb", ConstantVelocity([0.3, 0.3, 0.3]), REGION, {"max_components": 8}),
    ],
)
def test_a_batch_is_one_filter_for_each_hypothesis(
    parameters: ParameterSet, kind: str, motion: Motion | None, region: Array | None, settings: dict[str, object]
) -> None:
    events = make_events(parameters.cameras, 30)
    template = make_template(parameters.cameras, kind, motion, 64, region, **settings)
    # in a region, births have the depths along the rays of the template: only hypotheses equal to it have these
    drawn = parameters.sample(np.random.default_rng(1), 3)
    values = np.concatenate([np.zeros((1, 6)), drawn if region is None else np.zeros((1, 6))])
    batch = FilterBatch(template)
    spaces = hypothesis_spaces(parameters, values, template.rig)
    single = [with_cameras(template, parameters, row) for row in values]
    states = [one.init() for one in single]
    state = batch.init(len(values))
    for event in events:
        state, log_likelihoods = batch.step(state, event, spaces)
        for h, one in enumerate(single):
            states[h], info = one.update(states[h], one.predict(states[h], event), event)
            # sums in another order: 1e-11, grown by thirty updates
            np.testing.assert_allclose(log_likelihoods[h], info.log_likelihood, rtol=1e-8, atol=1e-8)
    for h, expected in enumerate(states):
        found = state.of(h)
        np.testing.assert_array_equal(found.labels, expected.mixture.labels)
        np.testing.assert_array_equal(found.cameras, expected.mixture.cameras)
        np.testing.assert_array_equal(found.times, expected.mixture.times)
        np.testing.assert_allclose(found.weights, expected.mixture.weights, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(found.means, expected.mixture.means, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.covariances, expected.mixture.covariances, rtol=1e-5, atol=1e-6)
    assert state.next_label == states[0].next_label


@pytest.mark.parametrize("kind", ["phd", "pmb"])
def test_a_batch_prunes_as_the_filter_does_where_cameras_take_frames_at_one_time(
    parameters: ParameterSet, kind: str
) -> None:
    events = make_events(parameters.cameras, 12)
    wrapped = make_template(parameters.cameras, kind)
    template = (PmbFilter if kind == "pmb" else PhdFilter)(wrapped.rig, wrapped.motion, wrapped.sets, wrapped.settings)  # type: ignore[arg-type]
    spaces = hypothesis_spaces(parameters, np.zeros((1, 6)), template.rig)
    batch = FilterBatch(template)
    one, state = template.init(), batch.init(1)
    for event in events:
        state, log_likelihoods = batch.step(state, event, spaces)
        one, info = template.update(one, template.predict(one, event), event)
        np.testing.assert_allclose(log_likelihoods[0], info.log_likelihood, rtol=1e-8)
        np.testing.assert_array_equal(state.of(0).labels, one.mixture.labels)


def test_a_corner_of_the_view_is_looked_at_again(parameters: ParameterSet) -> None:
    # components of the left camera, their depth hardly known, of which the right one sees tails of many sizes
    event = make_events(parameters.cameras, 2)[1]
    template = make_template(parameters.cameras, merge_distance=0.0)
    count = 60
    means = np.zeros((count, 6))
    means[:, 0], means[:, 1], means[:, 2] = np.linspace(0.0, 790.0, count), 300.0, 7.0
    covariances = np.broadcast_to(np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 0.2]) ** 2, (count, 6, 6)).copy()
    spaces = hypothesis_spaces(parameters, np.zeros((1, 6)), template.rig)
    looked_at = []
    for weight in (0.5, 0.05):
        mixture = make_mixture(np.full(count, weight), means, covariances)
        before = FilterState(mixture, 0.0, 1, count, 0)
        prediction = template.predict(before, event)
        looked_at.append(prediction.moved.status != OUT_OF_VIEW)
        after, info = template.update(before, prediction, event)
        state = BatchState(np.array([0]), np.array([count]), mixture, 0.0, 1, count)
        state, log_likelihoods = FilterBatch(template).step(state, event, spaces)
        np.testing.assert_allclose(log_likelihoods[0], info.log_likelihood, rtol=1e-12)
        np.testing.assert_allclose(state.of(0).means, after.mixture.means, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(state.of(0).weights, after.mixture.weights, rtol=1e-9)
    # some are in view only for having been looked at again
    assert (looked_at[0] & ~looked_at[1]).sum() >= 3


@pytest.mark.parametrize("kind", ["phd", "pmb"])
def test_neither_threads_nor_neighbours_change_a_bit(parameters: ParameterSet, kind: str) -> None:
    events = make_events(parameters.cameras, 12)
    template = make_template(parameters.cameras, kind)
    values = parameters.sample(np.random.default_rng(2), 21)
    one = of_log(Evidence(parameters, events, FilterBatch(template, 1)), values)
    two = of_log(Evidence(parameters, events, FilterBatch(template, 3)), values)
    np.testing.assert_array_equal(one, two)
    alone = of_log(Evidence(parameters, events, FilterBatch(template)), values[13:14])
    np.testing.assert_array_equal(alone, one[13:14])


def test_resampled_hypotheses_go_on_like_those_they_were_copied_from(parameters: ParameterSet) -> None:
    events = make_events(parameters.cameras, 8)
    template = make_template(parameters.cameras)
    values = parameters.sample(np.random.default_rng(3), 4)
    spaces = hypothesis_spaces(parameters, values, template.rig)
    batch = FilterBatch(template)
    state = batch.init(4)
    for event in events[:6]:
        state, _ = batch.step(state, event, spaces)
    chosen = np.array([2, 2, 0, 3, 2])
    state_all, all_likelihoods = batch.step(state, events[6], spaces)
    taken, likelihoods = batch.step(state.take(chosen), events[6], spaces[chosen])
    np.testing.assert_array_equal(likelihoods, all_likelihoods[chosen])
    np.testing.assert_array_equal(taken.counts, state_all.counts[chosen])
    np.testing.assert_array_equal(taken.of(4).means, state_all.of(2).means)


def test_more_components_than_there_was_room_for(parameters: ParameterSet) -> None:
    events = make_events(parameters.cameras, 2, clutter=400.0)
    template = make_template(parameters.cameras, prune_weight=1e-12, merge_distance=0.0)
    batch = FilterBatch(template)
    state, _ = batch.step(batch.init(2), events[0], hypothesis_spaces(parameters, np.zeros((2, 6)), template.rig))
    assert state.counts.tolist() == [len(events[0].points)] * 2
    assert state.counts[0] > 300
    np.testing.assert_array_equal(state.of(0).means, state.of(1).means)


def test_spaces_of_hypotheses_are_those_of_their_cameras(parameters: ParameterSet) -> None:
    rig = make_rig(parameters.cameras, 1.0, "vertical")
    for known in (parameters, ParameterSet(parameters.cameras, parameters.parameters[1:5])):
        values = np.concatenate([np.zeros((1, known.size)), known.sample(np.random.default_rng(4), 5)])
        values[1] *= 1e-9
        expected = [make_rig(known.build(row), 1.0, "vertical").packed for row in values]
        np.testing.assert_allclose(hypothesis_spaces(known, values, rig), expected, rtol=1e-14, atol=1e-14)


def test_at_one_scale_the_evidence_does_not_depend_on_scale(parameters: ParameterSet) -> None:
    events = make_events(parameters.cameras, 12)
    batch = FilterBatch(make_template(parameters.cameras, "pmb"))
    # the right camera away from the left one, which is the reference: its distance of 40 times 0.7, 1 and 1.3
    values = np.zeros((3, 6))
    values[:, 0] = [-12.0, 0.0, 12.0]
    free = of_log(Evidence(parameters, events, batch), values)
    assert np.ptp(free) > 0.1
    nominal = of_log(Evidence(parameters, events, batch, scale_reference=0), values)
    np.testing.assert_allclose(nominal, free[1], rtol=1e-9)
    spaces = hypothesis_spaces(parameters, values, batch.template.rig)
    np.testing.assert_allclose(at_nominal_scale(spaces, spaces[1], 0), spaces[[1, 1, 1]], atol=1e-12)
    # cameras in one place stay there
    together = spaces[:1].copy()
    together[0, 1] = together[0, 0]
    np.testing.assert_array_equal(at_nominal_scale(together, spaces[1], 0), together)


def test_a_known_baseline_is_one_more_factor(parameters: ParameterSet) -> None:
    batch = FilterBatch(make_template(parameters.cameras, "pmb"))
    values = np.zeros((2, 6))
    values[1, 0] = 6.0
    known = Evidence(parameters, [], batch, 0, ScaleMeasurement("baseline", 43.0, 2.0, (0, 1)))
    # distances of 40 and 46, both one and a half standard deviations off
    expected = -0.5 * 1.5**2 - np.log(2.0 * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(of_log(known, values), expected)
    assert of_log(Evidence(parameters, [], batch), values).tolist() == [0.0, 0.0]


def test_moments_by_a_rule_are_taken_from_samples_and_moving_cameras_refused(parameters: ParameterSet) -> None:
    events = make_events(parameters.cameras, 6)
    template = make_template(parameters.cameras)
    ruled = make_template(parameters.cameras)
    object.__setattr__(ruled, "sets", replace(ruled.sets, method="linear"))
    expected = of_log(Evidence(parameters, events, FilterBatch(template)), np.zeros((1, 6)))
    found = of_log(Evidence(parameters, events, FilterBatch(ruled)), np.zeros((1, 6)))
    np.testing.assert_array_equal(found, expected)
    pose = parameters.cameras[0].pose
    moving = replace(parameters.cameras[0], pose=Pose(pose.rotation, pose.center, velocity=(1.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="stand still"):
        FilterBatch(make_template((moving, parameters.cameras[1])))
