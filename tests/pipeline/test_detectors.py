"""Noise, probability of detection and clutter of cameras, estimated from logs of known ones."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from stereophd.commands.evaluate import evaluate
from stereophd.commands.simulate import simulate
from stereophd.commands.track import track
from stereophd.config.loading import load_config
from stereophd.core.disparity.events import Event
from stereophd.core.disparity.moved import IN_VIEW, room_for_moved
from stereophd.core.geometry.camera import Camera, Detector
from stereophd.core.multi.association.attribution import Claims
from stereophd.core.multi.base import Prediction
from stereophd.core.multi.births.undetected import all_undetected
from stereophd.core.multi.state.mixture import GaussianMixture
from stereophd.errors import InputError
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.build import build_labelled_filter
from stereophd.pipeline.detectors import passes
from stereophd.pipeline.detectors.passes import MOST_BOXES, estimate_detectors, stretches
from stereophd.pipeline.detectors.statistics import (
    BETWEEN_AXES,
    DetectorEstimate,
    DetectorSums,
    NoisePrior,
    estimate_detector,
    observe,
)
from stereophd.pipeline.stream import EventStream, open_stream
from tests.commands.test_track import SCENE
from tests.scenes import build_camera

pytestmark = pytest.mark.usefixtures("without_checks")

FromFarAway = Callable[[int], tuple[dict, Path]]

# what the cameras do, and where the estimation starts: far from it
TRUE = {"left": ((1.4, 1.4), 0.8, 3.0), "right": ((2.5, 0.7), 0.9, 6.0)}
START = ((5.0, 5.0), 0.95, 10.0)
SIMULATED = (
    "simulate.duration_s=40.0",
    "filter.kind=pmb",
    "filter.extraction={confirm: 0.95, release: 0.01}",
)


def detector(values: tuple[tuple[float, float], float, float]) -> str:
    sigma, p_detect, clutter = values
    return f"{{sigma_px: {list(sigma)}, p_detect: {p_detect}, clutter_per_frame: {clutter}}}"


def given(values: dict[str, tuple[tuple[float, float], float, float]]) -> tuple[str, ...]:
    return tuple(f"cameras.{name}.detector={detector(value)}" for name, value in values.items())


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three logs of three objects seen by two cameras for 40 s, and the configuration beside them."""
    folder = tmp_path_factory.mktemp("detectors")
    (folder / "scene.yaml").write_text(SCENE)
    for seed in range(3):
        simulate(load_config(folder / "scene.yaml", (*SIMULATED, *given(TRUE)), seed + 1), folder / f"log{seed}")
    return folder


def estimated(logs: Path, out: Path, number: int, *overrides: str) -> dict:
    loaded = load_config(logs / "scene.yaml", (*SIMULATED, *overrides), number + 1)
    return track(loaded, logs / f"log{number}" / "detections.parquet", out)


@pytest.fixture(scope="module")
def from_far_away(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> FromFarAway:
    """Report and outputs of a log, where all detectors are estimated from a start far from them; computed once."""

    @cache
    def function(number: int) -> tuple[dict, Path]:
        out = tmp_path_factory.mktemp("far-away") / "out"
        return estimated(logs, out, number, "detector=estimate", *given(dict.fromkeys(TRUE, START))), out

    return function


@pytest.fixture(scope="module")
def short(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 20 s of the three logs."""
    folder = tmp_path_factory.mktemp("short")
    shutil.copy(logs / "scene.yaml", folder)
    for log in logs.glob("log*"):
        (folder / log.name).mkdir()
        table = pq.read_table(log / "detections.parquet")
        pq.write_table(table.filter(pc.field("time_s") < 20.0), folder / log.name / "detections.parquet")
    return folder


def errors_in_deviations(found: dict, name: str) -> list[float]:
    (sigma_u, sigma_v), p_detect, clutter = TRUE[name]
    mine = found["cameras"][name]
    values = [*mine["sigma_px"], mine["p_detect"], mine["clutter_per_frame"]]
    deviations = [
        *mine["sigma_px_standard_error"],
        mine["p_detect_standard_error"],
        mine["clutter_per_frame_standard_error"],
    ]
    return list(np.subtract(values, [sigma_u, sigma_v, p_detect, clutter]) / deviations)


def test_the_true_values_are_found_from_a_start_far_away(from_far_away: FromFarAway) -> None:
    """Every value within five of its stated standard errors, and their mean over logs and cameras within five of its.

    Six estimates of each kind: the mean error is below 5 / sqrt(6) = 2.0 deviations, and the root mean square of
    all 24 between 0.4 and 1.6 (chi-square of 24 degrees of freedom, five of its deviations, for errors that are
    stated right).
    """
    errors = []
    for number in range(3):
        found, _ = from_far_away(number)
        assert found["detectors"]["converged"]
        errors += [errors_in_deviations(found["detectors"], name) for name in TRUE]
        for name in TRUE:
            mine = found["detectors"]["cameras"][name]
            assert mine["frames"] == 80
            # three objects in view of both cameras for all but the first frames
            assert 200 < mine["in_view"] < 240
            assert 0.7 < mine["residuals"] / (mine["in_view"] * TRUE[name][1]) < 1.1
            # white: five standard errors of a correlation from some 200 pairs
            assert np.abs(mine["residual_correlation"]).max() < 5.0 / np.sqrt(mine["residuals"])
            # an error of 7 to 9 % of the noise: the estimate is worth something
            assert max(np.divide(mine["sigma_px_standard_error"], mine["sigma_px"])) < 0.1
    values = np.array(errors)
    assert np.abs(values).max() < 5.0
    assert np.abs(values.mean(axis=0)).max() < 2.0
    assert 0.4 < np.sqrt((values**2).mean()) < 1.6


def test_false_detections_near_tracks_are_not_all_theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise of 40 px: what is false lies among what is not, and is a track's as probably as the track made it.

    Counted as the track's wherever that is more probable than not, 1.1 to 1.6 of 5 a frame were left in three logs. All
    tracks compete for a detection: where those that are settled did not, the probability of detection was 0.87 for 0.8.
    """
    (tmp_path / "scene.yaml").write_text(SCENE)
    true = detector(((40.0, 40.0), 0.8, 5.0))
    changes = ("simulate.frame_rate_hz=4.0", "filter.kind=pmb", "simulate.objects.count=6")
    changes += tuple(f"cameras.{name}.detector={true}" for name in TRUE)
    loaded = load_config(tmp_path / "scene.yaml", changes, 1)
    simulate(loaded, tmp_path / "log")
    parts = stretches(open_stream(loaded.config, loaded.build_cameras(), tmp_path / "log" / "detections.parquet"))
    priors = {name: NoisePrior(np.array([40.0, 40.0]), 0.2) for name in TRUE}
    started = tuple(replace(c, detector=Detector(c.detector.sigma, 0.9, 1.0)) for c in parts[0].cameras)
    doubtful: list[float] = []

    def estimate(sums: DetectorSums, present: Detector, prior: NoisePrior) -> DetectorEstimate:
        doubtful.append(sums.doubtful)
        return estimate_detector(sums, present, prior)

    monkeypatch.setattr(passes, "estimate_detector", estimate)
    found = estimate_detectors(started, priors, lambda used: build_labelled_filter(loaded.config, used, "", 1), parts)
    for entry in found[1]["cameras"].values():
        assert 2.5 < entry["clutter_per_frame"] < 7.5
        assert 0.74 < entry["p_detect"] < 0.86
    # a frame in which a track is in view adds a quarter at most: some 300 of each camera
    assert 5.0 < min(doubtful) <= max(doubtful) < 80.0


def test_tracks_with_estimated_detectors_are_as_with_the_true_ones(
    logs: Path, from_far_away: FromFarAway, tmp_path: Path
) -> None:
    """Median error of all but the first fifth: within a tenth of what the true values give. NEES within 0.5.

    From noise of 5 px, claimed where there are 1.4 and less, covariances are several times too large.
    """
    scores = {}
    outputs = {"true": tmp_path / "true", "start": tmp_path / "start", "estimated": from_far_away(0)[1]}
    estimated(logs, outputs["true"], 0, *given(TRUE))
    estimated(logs, outputs["start"], 0, *given(dict.fromkeys(TRUE, START)))
    for name, out in outputs.items():
        report = evaluate(out / "tracks.parquet", logs / "log0" / "truth.parquet", cutoff=20.0, from_s=8.0)
        scores[name] = (report["position_error"]["median"], report["nees"]["position"])
    assert scores["estimated"][0] < 1.1 * scores["true"][0]
    assert abs(scores["estimated"][1] - scores["true"][1]) < 0.5
    assert scores["start"][1] < 0.5 * scores["true"][1]


@pytest.mark.parametrize("start", [((3.0, 3.0), 1.0, 0.0), ((0.7, 0.7), 0.6, 0.5)], ids=["too good", "too sharp"])
def test_from_other_starts(short: Path, tmp_path: Path, start: tuple[tuple[float, float], float, float]) -> None:
    """Detectors said never to miss and never to be wrong, or much sharper than they are: the same values."""
    overrides = ("detector=estimate", *given(dict.fromkeys(TRUE, start)))
    found = estimated(short, tmp_path / "out", 0, *overrides)["detectors"]
    for name in TRUE:
        assert np.abs(errors_in_deviations(found, name)).max() < 5.0


def test_only_the_cameras_that_ask_for_it(short: Path, tmp_path: Path) -> None:
    overrides = (*given({"left": TRUE["left"]}), "cameras.right.detector=estimate")
    found = estimated(short, tmp_path / "out", 1, *overrides)["detectors"]
    assert list(found["cameras"]) == ["right"]
    assert np.abs(errors_in_deviations(found, "right")).max() < 5.0
    assert estimated(short, tmp_path / "given", 1, *given(TRUE))["detectors"] is None


def test_for_a_phd_filter_too_and_the_same_again(short: Path, tmp_path: Path) -> None:
    overrides = ("filter.kind=phd", "detector=estimate")
    first = estimated(short, tmp_path / "one", 2, *overrides)
    again = estimated(short, tmp_path / "two", 2, *overrides)
    assert first == again
    assert (tmp_path / "one" / "tracks.parquet").read_bytes() == (tmp_path / "two" / "tracks.parquet").read_bytes()
    assert json.loads((tmp_path / "one" / "report.json").read_text())["detectors"] == first["detectors"]


def test_noise_that_the_log_states_is_not_estimated(short: Path, tmp_path: Path) -> None:
    log = pq.read_table(short / "log2" / "detections.parquet")
    for name, k in (("sigma_u_px", 0), ("sigma_v_px", 1)):
        values = [TRUE[camera][0][k] for camera in log["camera"].to_pylist()]
        log = log.append_column(name, pa.array(values))
    pq.write_table(log, tmp_path / "log.parquet")
    loaded = load_config(short / "scene.yaml", (*SIMULATED, "detector=estimate", *given(dict.fromkeys(TRUE, START))), 4)
    found = track(loaded, tmp_path / "log.parquet", tmp_path / "out")["detectors"]["cameras"]
    for name, (_, p_detect, clutter) in TRUE.items():
        assert found[name]["residuals"] == 0.0
        assert abs(found[name]["p_detect"] - p_detect) < 5 * found[name]["p_detect_standard_error"]
        assert abs(found[name]["clutter_per_frame"] - clutter) < 5 * found[name]["clutter_per_frame_standard_error"]


def test_too_little_to_estimate_from(logs: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One camera alone: its own tracks tell its noise, and no track that two saw confirms it: a warning says so.

    The other camera, of which the log has no frame, has the noise of this one. That it has none is said elsewhere.
    """
    log = pq.read_table(logs / "log0" / "detections.parquet")
    log = log.filter(pa.array([name == "left" for name in log["camera"].to_pylist()]))
    pq.write_table(log, tmp_path / "log.parquet")
    loaded = load_config(logs / "scene.yaml", (*SIMULATED, "detector=estimate", *given(TRUE)))
    found = track(loaded, tmp_path / "log.parquet", tmp_path / "out")["detectors"]["cameras"]
    for name in TRUE:
        assert found[name]["sigma_px"] == pytest.approx(list(TRUE["left"][0]), rel=0.25)
        assert found[name]["p_detect"] == 0.9
        assert not found[name]["confirmed"]
    assert found["right"]["frames"] == 0
    text = "left: tracks do not confirm the estimated noise (0 detections of tracks that two cameras saw)"
    assert text in caplog.text
    assert text.replace("left", "right") not in caplog.text


def test_errors_that_last_are_not_taken_for_noise(
    short: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A camera that leans by 0.3 degrees sees all objects 5 px off: residuals of successive frames agree."""
    rotation = "cameras.right.pose.rotation_vector_deg=[0.3, 10.0, 0.0]"
    found = estimated(short, tmp_path / "out", 0, "detector=estimate", rotation, *given(TRUE))["detectors"]["cameras"]
    assert max(found[name]["residual_correlation"][1] for name in TRUE) > 0.5
    assert "with a correlation from frame to frame of" in caplog.text
    for name in TRUE:
        assert not found[name]["confirmed"]
        assert found[name]["sigma_px"] == found[name]["noise_of_rays_px"]


@pytest.mark.parametrize(("correlation", "confirmed"), [(0.0, True), (0.5, False), (-0.5, False)])
def test_residuals_that_are_no_white_noise_confirm_none(correlation: float, confirmed: bool) -> None:
    """Objects that sway between frames: 0.36 px along v was found for 1 px, and 1.34 px of the other camera."""
    sums = DetectorSums(pairs=900.0, residuals=np.full(2, 900.0), weights=np.full(2, 900.0), shares=np.full(2, 800.0))
    sums.products, sums.norms, sums.successions = np.array([0.0, 800.0 * correlation]), np.full(2, 800.0), 800
    found = estimate_detector(sums, Detector((1.1, 1.1), 0.9, 1.0), NoisePrior(np.full(2, 1.0), 0.3))
    assert found.confirmed == confirmed
    if not confirmed:
        assert found.noise.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("place", "weight", "counted"), [(0.5, 0.05, 0.4), (30.0, 0.05, 0.0), (30.0, 0.0, 0.4)])
def test_a_residual_is_that_of_the_component_which_made_the_detection(
    place: float, weight: float, counted: float
) -> None:
    """The other component of a label, 30 px off, claims a detection there: one such residual outweighed 300 others."""
    camera = build_camera("one")
    points = np.array([[camera.cx + place, camera.cy]])
    means = np.array([[camera.cx, camera.cy, 5.0], [camera.cx + 30.0, camera.cy, 5.0]])
    none, zero = np.zeros(2, dtype=np.int64), np.zeros(2)
    weights, shape = np.array([1.0 - weight, weight]), np.broadcast_to(0.01 * np.eye(3), (2, 3, 3)).copy()
    mixture = GaussianMixture(weights, means, shape, none, zero, none + 7, none, none.astype(np.bool_))
    moved = room_for_moved(2, 3)._replace(means=means, covariances=shape, fraction=np.ones(2), status=none + IN_VIEW)
    prediction = Prediction(mixture, moved, 0.0, all_undetected(1))
    event = Event(0.0, 0, points, np.eye(2)[None], np.ones(1))
    sums, claims = DetectorSums(), Claims(np.array([7]), np.array([0]), np.array([0.4]))
    sighting = observe(sums, prediction, event, claims, camera, np.zeros(30), np.array([7]))
    assert sums.pairs == pytest.approx(counted, abs=1e-9)
    assert sighting.detected.tolist() == [0.4]


def test_misses_of_whole_tracks_are_no_chance_of_single_frames() -> None:
    """Of three tracks one loses a fifth of its detections to others: by hand, with the prior of five frames."""
    vague, present = NoisePrior(np.array([1.0, 1.0]), 100.0), Detector((1.0, 1.0), 0.9, 1.0)
    errors = []
    for looks in ([[99.0, 1.0], [99.0, 1.0], [80.0, 20.0]], [[93.0, 7.0], [93.0, 7.0], [92.0, 8.0]]):
        found = estimate_detector(DetectorSums(looks=[np.array(one) for one in looks]), present, vague)
        assert found.detector.p_detect == pytest.approx(p := (278.0 + 4.5) / 305.0)
        errors.append(found.p_detect_error)
    assert errors[0] == pytest.approx(np.sqrt(2.0 * (99.0 - 100.0 * p) ** 2 + (80.0 - 100.0 * p) ** 2) / 305.0)
    assert errors[1] == pytest.approx(np.sqrt(p * (1.0 - p) / 305.0))


def test_values_from_sums() -> None:
    """By hand: two kinds of residuals, twice as large as expected; a quarter missed; clutter what is left over."""
    present = Detector((2.0, 3.0), 0.9, 1.0)
    sums = DetectorSums(pairs=100.0, looks=[np.array([75.0, 25.0])], frames=50, detections=200, attributed=150)
    # shares R / S of 0.8 and 0.4, fifty residuals each, e^2 = 4 S
    for share in (np.full(2, 0.8), np.full(2, 0.4)):
        sums.residuals = sums.residuals + 50 * share * 4.0
        sums.weights = sums.weights + 50 * share
        sums.shares = sums.shares + 50 * share * share
    vague = NoisePrior(np.array([1.0, 1.0]), 100.0)
    found = estimate_detector(sums, present, vague)
    # measured 4 and 6 px; axes resemble each other: a run moves them with a weight of 2 * 60, as of so much information
    kept = 120.0 / (120.0 + BETWEEN_AXES**-2)
    sigma = np.sqrt(24.0) * (2.0 / 3.0) ** (np.array([0.5, -0.5]) * kept)
    np.testing.assert_allclose(found.detector.sigma, sigma, rtol=1e-4)
    told = 2 * 50 * (0.64 + 0.16)
    variance = 0.5 / told + 0.5 / (told + BETWEEN_AXES**-2)
    np.testing.assert_allclose(found.noise_error, sigma * np.sqrt(variance), rtol=1e-4)
    assert found.residual_ratio == pytest.approx(2.0)
    assert found.detector.p_detect == pytest.approx(79.5 / 105.0)
    assert found.detector.clutter_per_frame == pytest.approx(50.5 / 50.0)
    # a prior of 5 px for both axes takes its share of the logarithm
    sure = estimate_detector(sums, present, NoisePrior(np.array([5.0, 5.0]), 0.0))
    np.testing.assert_allclose(sure.detector.sigma, 5.0 * np.array([0.8, 1.2]) ** kept)
    # and all of it where the tracks contradict it
    contradicted = estimate_detector(sums, present, NoisePrior(np.array([1.0, 1.0]), 0.0))
    assert contradicted.detector.sigma.tolist() == [1.0, 1.0]
    assert not contradicted.confirmed
    # measured 4 and 6 px, and the noise stays at 1 px
    assert contradicted.residual_ratio == pytest.approx(np.sqrt(24.0), rel=1e-4)
    nothing = estimate_detector(DetectorSums(), present, NoisePrior(np.array([1.0, 2.0]), 1.0))
    assert nothing.detector.sigma.tolist() == [1.0, 2.0]
    assert (nothing.detector.p_detect, nothing.detector.clutter_per_frame) == (0.9, 1.0)
    assert (nothing.residual_ratio, nothing.confirmed, nothing.clutter_error) == (None, False, None)
    undecided = replace(sums, undecided=100)
    assert estimate_detector(undecided, present, vague).clutter_error == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(
    ("sums", "clutter", "error"),
    [
        (DetectorSums(frames=100, detections=300, attributed=100.5), 2.0, np.sqrt(0.02)),
        (DetectorSums(frames=100, detections=300, attributed=100.5, doubtful=900.0), 2.0, np.sqrt(0.02 + 0.09)),
        # tracks claim 1.5 more in each frame than there are: that is not known to be no clutter
        (DetectorSums(frames=100, detections=300, attributed=450.0), 0.005, np.sqrt(5e-5 + 1.5**2)),
    ],
)
def test_the_stated_error_of_clutter(sums: DetectorSums, clutter: float, error: float) -> None:
    """That of a count, of what is a track's only probably, and of what several tracks claim."""
    found = estimate_detector(sums, Detector((1.0, 1.0), 0.9, 1.0), NoisePrior(np.ones(2), 1.0))
    assert (found.detector.clutter_per_frame, found.clutter_error) == pytest.approx((clutter, error))


@pytest.mark.parametrize(("ratio", "confirmed"), [(0.12, False), (1.0, True), (24.0, False)])
def test_tracks_confirm_a_noise_or_not(ratio: float, confirmed: bool) -> None:
    sums = DetectorSums(pairs=400.0)
    sums.residuals, sums.weights = np.full(2, 400.0 * ratio**2), np.full(2, 400.0)
    sums.shares = np.full(2, 400.0)
    prior = NoisePrior(np.array([1.0, 1.0]), 0.1)
    assert estimate_detector(sums, Detector((1.0, 1.0), 0.9, 1.0), prior).confirmed == confirmed


def test_few_residuals_count_for_as_much_as_they_say() -> None:
    """Two of them move the noise by a part of what they show, and its error says so."""
    sums = DetectorSums(np.full(2, 2.0 * 4.0), np.full(2, 2.0), np.full(2, 2.0), pairs=2.0)
    found = estimate_detector(sums, Detector((1.0, 1.0), 0.9, 1.0), NoisePrior(np.array([1.0, 1.0]), 0.4))
    assert (found.detector.sigma > 1.2).all()
    assert (found.detector.sigma < 1.9).all()
    assert 0.2 < float(found.noise_error[0] / found.noise[0]) < 0.4
    assert found.confirmed


@pytest.mark.parametrize(("known", "factor", "used"), [(0.1, 0.12, 1.0), (0.5, 0.12, 0.12), (0.5, 9.0, 1.0)])
def test_a_noise_that_is_only_usual_is_no_evidence_against_less(known: float, factor: float, used: float) -> None:
    """Good detectors of bodies have a fifth of the usual noise; wrong tracks make noise larger, never smaller."""
    sums = DetectorSums(np.full(2, 400.0 * factor**2), np.full(2, 400.0), np.full(2, 400.0), pairs=400.0)
    found = estimate_detector(sums, Detector((1.0, 1.0), 0.9, 1.0), NoisePrior(np.array([1.0, 1.0]), known))
    assert found.noise == pytest.approx([used] * 2, rel=0.05)


def test_a_text_that_is_not_estimate(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    with pytest.raises(InputError, match="expected estimate or sigma_px, p_detect and clutter_per_frame, found guess"):
        load_config(path, ["cameras.left.detector=guess"])


@pytest.mark.parametrize("start_px", [0.08, 30.0])
def test_a_noise_that_rays_hardly_know_is_where_the_log_is_most_probable(logs: Path, start_px: float) -> None:
    """From a noise that is wrong by two stated errors; no tracks begin with the small one."""
    loaded = load_config(logs / "scene.yaml", (*SIMULATED, *given(TRUE)), 1)
    sigma = np.full(2, start_px)
    cameras = tuple(replace(one, detector=replace(one.detector, sigma=sigma)) for one in loaded.build_cameras())
    parts = stretches(open_stream(loaded.config, cameras, logs / "log0" / "detections.parquet"))
    found, report = estimate_detectors(
        cameras, {name: NoisePrior(sigma, 1.5) for name in TRUE},
        lambda used: build_labelled_filter(loaded.config, used, "scene.yaml", 1), parts,
    )  # fmt: skip
    for camera in found:
        np.testing.assert_allclose(camera.detector.sigma, TRUE[camera.name][0], rtol=0.3)
        assert report["cameras"][camera.name]["confirmed"]


def test_boxes_count_twice_as_much_as_points() -> None:
    """Each is four numbers instead of two, and costs a filter of bodies several times the time."""
    pixels = np.full((100, 2), 50.0)
    stream = EventStream((build_camera("a"),), [Frame(0.1 * k, 0, k, pixels, None, sizes=pixels) for k in range(400)])
    assert [sum(len(part.frames) for part in stretches(stream, *taken)) for taken in ((), (MOST_BOXES,))] == [120, 60]


def test_passes_that_make_the_log_less_probable_are_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a crowd tracks take detections of neighbours, and show a larger noise and no clutter, run after run."""

    def run(_: object, __: object, cameras: tuple[Camera, ...], priors: Mapping[str, NoisePrior]) -> passes._Run:
        estimates, likelihood = {}, 0.0
        for camera in cameras:
            likelihood -= 500.0 * float((np.log(camera.detector.sigma / 2.0) ** 2).mean())
            likelihood -= 100.0 * abs(np.log(camera.detector.clutter_per_frame))
            sums = DetectorSums(pairs=400.0, frames=100, detections=100, attributed=100, looks=[np.array([90.0, 10.0])])
            sums.residuals, sums.weights = np.full(2, 400.0 * 1.3**2), np.full(2, 400.0)
            sums.shares = np.full(2, 400.0)
            estimates[camera.name] = estimate_detector(sums, camera.detector, priors[camera.name])
        return passes._Run(cameras, estimates, likelihood, False)

    monkeypatch.setattr(passes, "_run", run)
    (tmp_path / "scene.yaml").write_text(SCENE)
    cameras = load_config(tmp_path / "scene.yaml").build_cameras()
    started = tuple(replace(camera, detector=Detector((2.0, 2.0), 0.9, 1.0)) for camera in cameras)
    priors = {camera.name: NoisePrior(np.array([2.0, 2.0]), 0.6) for camera in cameras}
    found, report = estimate_detectors(started, priors, lambda _: pytest.fail("no filter"), [])
    assert report["converged"]
    for camera in found:
        np.testing.assert_allclose(camera.detector.sigma, 2.0)
        assert camera.detector.clutter_per_frame == 1.0
