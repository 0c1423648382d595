"""The evidence of a recording under hypotheses of any quantity of the cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.recording import Scans
from stereophd.core.calibration.pairing.association import inflated, with_cameras
from stereophd.core.calibration.sampling.likelihood import ConditionalFilters, Evidence
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.problems import make_evidence, make_parameters
from tests.core.multi.scenes import BIRTHS, with_births

EVENTS = 24
STDS = {
    "center": 1.0, "rotation": 0.02, "focal": 0.02, "aspect": 0.01, "principal_point": 5.0, "distortion": 0.05,
    "clock_offset": 0.4, "clock_rate": 2e-3, "readout": 0.1, "velocity": 0.2, "rotation_rate": 0.01,
}  # fmt: skip


def one_unknown(name: str) -> ParameterSet:
    """One quantity of the right camera unknown; both cameras have a lens."""
    left, right = (replace(one, lens=Lens("brown_conrady", k1=-0.1)) for one in make_parameters().cameras)
    quantity = next(one for one in quantities() if one.name == name)
    components = quantity.available(right)
    return ParameterSet((left, right), tuple(Parameter(one, "right", 0.0, STDS[name]) for one in components))


@pytest.mark.parametrize("kind", ["phd", "pmb"])
@pytest.mark.parametrize("reference", [None, 0])
def test_neither_threads_nor_neighbours_nor_shared_events_change_a_bit(kind: str, reference: int | None) -> None:
    parameters = make_parameters()
    known = ScaleMeasurement("baseline", 40.0, 2.0, (0, 1))
    one = make_evidence(parameters, kind, EVENTS, scale_reference=reference, scale=known)
    values = np.concatenate([np.zeros((1, 6)), parameters.sample(np.random.default_rng(3), 3)])
    found = one.after(values, [7, 12, EVENTS], 2.0)
    threaded = replace(one, filters=replace(one.filters, threads=3))
    np.testing.assert_array_equal(threaded.after(values, [7, 12, EVENTS], 2.0), found)
    np.testing.assert_array_equal(one.after(values[2:3], [EVENTS], 2.0)[:, 0], found[2:, 2])
    first = replace(one, frames=one.frames[:12])
    np.testing.assert_array_equal(first.after(values, [12], 2.0)[0], found[1])
    np.testing.assert_array_equal(one(values), one.after(values, [EVENTS])[0])


def test_at_one_scale_the_evidence_does_not_depend_on_scale() -> None:
    parameters = make_parameters()
    # the right camera away from the left one, which is the reference: its distance of 40 times 0.7, 1 and 1.3
    values = np.zeros((4, 6))
    values[:, 0] = [-12.0, 0.0, 12.0, -40.0]
    one = make_evidence(parameters, "pmb", 12)
    free = one(values[:3])
    assert np.ptp(free) > 0.1
    scaled = replace(one, scale_reference=0)(values)
    np.testing.assert_allclose(scaled[:3], free[1], rtol=1e-9)
    assert scaled[3] == one(values[3:])[0]  # cameras in one place stay there


def test_a_known_baseline_is_one_more_factor() -> None:
    values = np.zeros((2, 6))
    values[1, 0] = 6.0
    nothing = make_evidence(make_parameters(), "pmb", 0)
    known = replace(nothing, scale_reference=0, scale=ScaleMeasurement("baseline", 43.0, 2.0, (0, 1)))
    # distances of 40 and 46, both one and a half standard deviations off
    expected = -0.5 * 1.5**2 - np.log(2.0 * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(known(values), expected)
    assert nothing(values).tolist() == [0.0, 0.0]


def test_components_are_moved_by_samples_whatever_the_rule() -> None:
    parameters = make_parameters()
    one = make_evidence(parameters, "phd", 6)
    ruled = replace(one.filters.template, sets=replace(one.filters.template.sets, method="linear"))
    other = replace(one, filters=ConditionalFilters(with_births(ruled, BIRTHS)))
    np.testing.assert_array_equal(other(np.zeros((1, 6))), one(np.zeros((1, 6))))


@pytest.mark.parametrize("name", sorted(STDS))
def test_a_hypothesis_is_filtered_as_if_its_cameras_were_known(name: str) -> None:
    """Events by its lens and its clock, in their order, before its own disparity spaces."""
    parameters = one_unknown(name)
    evidence = make_evidence(parameters, "pmb", EVENTS)
    values = parameters.sample(np.random.default_rng(5), 2)
    found = evidence.after(values, [11, EVENTS], 1.5)
    for row, (first, whole) in zip(values, found.T, strict=True):
        cameras = parameters.build(row)
        for count, expected in ((11, first), (EVENTS, whole)):
            assert filtered(evidence, cameras, count, 1.5) == pytest.approx(expected, rel=1e-12)


def filtered(evidence: Evidence, cameras: tuple[Camera, ...], count: int, inflation: float) -> float:
    """Log-likelihood of the first frames by the filter of cameras, with the births of the nominal ones."""
    template = evidence.filters.template
    assert isinstance(template, PmbFilter)
    one, total = with_cameras(template, cameras), 0.0
    state = one.init()
    for event in Scans.of(evidence.recording, cameras, np.arange(count)).events:
        elapsed = 0.0 if state.time_s is None else event.time_s - state.time_s
        births = template.expected_births(state.undetected, elapsed, event)
        event = inflated(event, inflation)
        state, info = one.update(state, one.predict(state, event, births), event)
        total += info.log_likelihood
    return total


@pytest.mark.parametrize(("name", "off"), [("focal", 0.06), ("velocity", 1.0), ("rotation_rate", 0.01)])
def test_the_true_cameras_are_more_likely_than_wrong_ones(name: str, off: float) -> None:
    parameters = one_unknown(name)
    size = parameters.size
    values = off * np.concatenate([np.zeros((1, size)), np.eye(size), -np.eye(size)])
    found: Array = make_evidence(parameters, "pmb", EVENTS)(values)
    assert (found[0] > found[1:] + 1.0).all(), found


def test_a_detection_that_a_lens_cannot_invert_is_clutter_under_it() -> None:
    """Its density is that of clutter; without clutter the hypothesis is unlikely, not impossible."""
    parameters = one_unknown("distortion")
    evidence = make_evidence(parameters, "pmb", EVENTS)
    strong = np.zeros((1, parameters.size))
    strong[0, 0] = -0.9
    events = Scans.of(evidence.recording, parameters.build(strong[0])).events
    lost = sum(event.not_invertible for event in events)
    assert lost > 0
    camera = parameters.cameras[1]
    assert camera.detector.clutter_per_frame > 0.0
    density = camera.detector.clutter_per_frame / (camera.width * camera.height)
    expected = filtered(evidence, parameters.build(strong[0]), EVENTS, 1.0) + lost * np.log(density)
    assert evidence(strong)[0] == pytest.approx(expected, rel=1e-12)
    clean = replace(parameters, cameras=tuple(without_clutter(one) for one in parameters.cameras))
    assert -np.inf < replace(evidence, parameters=clean)(strong)[0] < evidence(strong)[0]


def without_clutter(camera: Camera) -> Camera:
    """The camera with a detector without false detections."""
    return replace(camera, detector=replace(camera.detector, clutter_per_frame=0.0))
