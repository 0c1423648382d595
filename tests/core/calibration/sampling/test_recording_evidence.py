"""The evidence of a recording: that of the batch for poses, and any quantity of the cameras beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereophd.core.arrays import Array
from stereophd.core.calibration.adjustment.recording import Recording, Scans
from stereophd.core.calibration.pairing.association import inflated, with_cameras
from stereophd.core.calibration.sampling.likelihood import Evidence
from stereophd.core.calibration.sampling.recording_evidence import RecordingEvidence
from stereophd.core.calibration.unknowns.parameters import Parameter, ParameterSet
from stereophd.core.calibration.unknowns.quantities.registry import quantities
from stereophd.core.calibration.unknowns.scale import ScaleMeasurement
from stereophd.core.geometry.camera import Camera
from stereophd.core.geometry.lens import Lens
from stereophd.core.multi.camera_hypotheses.batch import FilterBatch
from stereophd.core.multi.pmb.filter import PmbFilter
from tests.core.calibration.problems import make_events, make_parameters, make_template, of_log

EVENTS = 24
STDS = {
    "center": 1.0, "rotation": 0.02, "focal": 0.02, "aspect": 0.01, "principal_point": 5.0, "distortion": 0.05,
    "clock_offset": 0.4, "clock_rate": 2e-3, "readout": 0.1, "velocity": 0.2, "rotation_rate": 0.01,
}  # fmt: skip


def make_recording(cameras: tuple[Camera, ...], count: int = EVENTS) -> Recording:
    """Raw pixels of the objects of `make_events`."""
    rows = []
    for event in make_events(cameras, count):
        assert event.pixels is not None
        rows.append((event.camera, event.time_s, event.pixels, None))
    return Recording.of(cameras, rows)


def make_evidence(parameters: ParameterSet, kind: str = "pmb") -> RecordingEvidence:
    """Evidence of a recording that the cameras of the prior mean made."""
    recording = make_recording(parameters.cameras)
    template = make_template(parameters.cameras, kind)
    return RecordingEvidence(parameters, recording, np.arange(EVENTS), template)


def one_unknown(name: str) -> ParameterSet:
    """One quantity of the right camera unknown; both cameras have a lens."""
    left, right = (replace(one, lens=Lens("brown_conrady", k1=-0.1)) for one in make_parameters().cameras)
    quantity = next(one for one in quantities() if one.name == name)
    components = quantity.available(right)
    return ParameterSet((left, right), tuple(Parameter(one, "right", 0.0, STDS[name]) for one in components))


@pytest.mark.parametrize("kind", ["phd", "pmb"])
@pytest.mark.parametrize("reference", [None, 0])
def test_poses_have_the_evidence_of_the_batch(kind: str, reference: int | None) -> None:
    parameters = make_parameters()
    known = ScaleMeasurement("baseline", 40.0, 2.0, (0, 1))
    one = replace(make_evidence(parameters, kind), threads=2, scale_reference=reference, scale=known)
    events = Scans.of(one.recording, parameters.cameras).events
    batch = Evidence(parameters, events, FilterBatch(one.template), reference, known)
    values = np.concatenate([np.zeros((1, 6)), parameters.sample(np.random.default_rng(3), 3)])
    np.testing.assert_allclose(of_log(one, values), of_log(batch, values), rtol=1e-10)
    counts = [7, 12, EVENTS]
    np.testing.assert_allclose(one.after(values, counts, 2.0), batch.after(values, counts, 2.0), rtol=1e-10)


@pytest.mark.parametrize("name", sorted(STDS))
def test_a_hypothesis_is_filtered_as_if_its_cameras_were_known(name: str) -> None:
    """Events by its lens and its clock, in their order, before its own disparity spaces."""
    parameters = one_unknown(name)
    evidence = make_evidence(parameters)
    values = parameters.sample(np.random.default_rng(5), 2)
    found = evidence.after(values, [11, EVENTS], 1.5)
    for row, (first, whole) in zip(values, found.T, strict=True):
        cameras = parameters.build(row)
        for count, expected in ((11, first), (EVENTS, whole)):
            assert filtered(evidence, cameras, count, 1.5) == pytest.approx(expected, rel=1e-12)


def filtered(evidence: RecordingEvidence, cameras: tuple[Camera, ...], count: int, inflation: float) -> float:
    """Log-likelihood of the first frames by the filter of cameras, with the births of the nominal ones."""
    template = evidence.template
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
    found: Array = of_log(make_evidence(parameters), values)
    assert (found[0] > found[1:] + 1.0).all(), found


def test_a_detection_that_a_lens_cannot_invert_is_clutter_under_it() -> None:
    """Its density is that of clutter; without clutter the hypothesis is unlikely, not impossible."""
    parameters = one_unknown("distortion")
    evidence = make_evidence(parameters)
    strong = np.zeros((1, parameters.size))
    strong[0, 0] = -0.9
    events = Scans.of(evidence.recording, parameters.build(strong[0])).events
    lost = sum(event.not_invertible for event in events)
    assert lost > 0
    camera = parameters.cameras[1]
    assert camera.detector.clutter_per_frame > 0.0
    density = camera.detector.clutter_per_frame / (camera.width * camera.height)
    expected = filtered(evidence, parameters.build(strong[0]), EVENTS, 1.0) + lost * np.log(density)
    assert of_log(evidence, strong)[0] == pytest.approx(expected, rel=1e-12)
    clean = replace(parameters, cameras=tuple(without_clutter(one) for one in parameters.cameras))
    unlikely = of_log(replace(evidence, parameters=clean), strong)[0]
    assert -np.inf < unlikely < of_log(evidence, strong)[0]


def without_clutter(camera: Camera) -> Camera:
    """The camera with a detector without false detections."""
    return replace(camera, detector=replace(camera.detector, clutter_per_frame=0.0))
