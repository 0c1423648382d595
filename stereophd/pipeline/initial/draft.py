"""Settings that fit a log: each estimated where the log is informative, and otherwise the usual value of a kind.

First rays of different cameras that meet, and one-camera tracks, give depths and speeds roughly, wide enough to track
with (`stereophd.pipeline.checks`). Then the filter runs over stretches of the log: its likelihood gives the
acceleration, its tracks give depths, speeds and births, and its residuals the detectors that are unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig, make_config
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.io.cameras.models import CameraConfig, DetectorConfig
from stereophd.io.logs.reading import LogReader
from stereophd.pipeline.build import build_labelled_filter
from stereophd.pipeline.checks.geometry.measure import measure
from stereophd.pipeline.checks.log.findings import check_files
from stereophd.pipeline.checks.log.sample import CameraSample, sample_log
from stereophd.pipeline.checks.run_figures.estimated_detectors import LASTING
from stereophd.pipeline.checks.settings import expected_depths, measure_scene
from stereophd.pipeline.detectors.passes import estimate_detectors
from stereophd.pipeline.initial.acceleration import LEAST_EVENTS, estimate_acceleration, stretches
from stereophd.pipeline.initial.measured import SceneFigures, measure_with_filter
from stereophd.pipeline.initial.template import Choice, Draft, rounded
from stereophd.pipeline.stream import EventStream, open_stream

# Frames of each camera that the first look takes.
SAMPLE_FRAMES = 1500
# Score from which rays of two cameras meet. It is lower than in a check, because the filter runs afterwards.
MEETING_SCORE = 2.5
# Relative standard errors up to which an estimated detector is written down: of sigma, and of p_detect itself.
SIGMA_ERROR, P_DETECT_ERROR = 0.15, 0.05
# Least clutter to begin with: no detector is free of it, and births need some to compete with.
LEAST_CLUTTER = 0.02
# Noise of a detection to begin with, px: errors of lens and pose count as noise, and are rarely below it.
USUAL_SIGMA_PX = 0.5
# Margins of what is written about what was seen.
NEARER, FARTHER, SPREAD, FASTER = 0.7, 1.5, 1.3, 2.5
REGION_NEARER, REGION_FARTHER = 0.4, 2.5
# Largest standard deviation of a reported position, and the cutoff of scores, over the middle depth.
UNCERTAIN, CUTOFF = 0.1, 0.1
CAUSES_OF_DETECTORS = ("clutter", "sigma")


def draft_from_log(draft: Draft, log_path: Path | str) -> Draft:
    """Return a draft whose values follow from a log, where it is informative.

    Parameters
    ----------
    draft : Draft
        With cameras and the usual values of a kind of object.
    log_path : path
        Detection log of these cameras.

    Raises
    ------
    InputError
        The log is not usable, or is one of other cameras.
    """
    bare = make_config({"units": {"length": draft.unit}, "cameras": _plain(draft.cameras)}, str(log_path))
    cameras = bare.build_cameras()
    reader = LogReader(log_path, cameras, bare.config.input.on_bad_row, bare.config.input.image_margin_px)
    samples = sample_log(reader, cameras, SAMPLE_FRAMES)
    draft = _with_frame_rates(_with_known_detectors(draft, samples), samples)
    rough = _rough(draft, samples)
    if rough is None:
        return replace(
            draft,
            head=(
                "The rays of different cameras do not meet, so the log shows no depths: values marked 'not measured' "
                "are guesses. `stereophd check` looks for the reason.",
            ),
        )
    return _with_filter(draft.with_choices(rough), draft, log_path)


def _plain(cameras: Mapping[str, CameraConfig]) -> dict[str, Any]:
    return {name: camera.model_dump(mode="json", exclude_none=True) for name, camera in cameras.items()}


def loaded_draft(draft: Draft, name: str) -> LoadedConfig:
    """Return the draft as a loaded configuration."""
    return make_config({**draft.values(), "cameras": _plain(draft.cameras)}, name)


def _with_frame_rates(draft: Draft, samples: list[CameraSample]) -> Draft:
    """State the frame rates of the log where the cameras have none."""
    cameras, notes = dict(draft.cameras), dict(draft.camera_notes)
    for sample in samples:
        name = sample.camera.name
        if cameras[name].frame_rate_hz is None and len(sample.times) > 1 and sample.interval_s > 0.0:
            rate = rounded(1.0 / sample.interval_s, 6)
            cameras[name] = cameras[name].model_copy(update={"frame_rate_hz": rate})
            notes[name] = (*notes.get(name, ()), f"frame_rate_hz: {len(sample.times)} frames of the log")
    return replace(draft, cameras=cameras, camera_notes=notes)


def _with_known_detectors(draft: Draft, samples: list[CameraSample]) -> Draft:
    """Let detectors be estimated that the log contradicts, and give those that are unknown values to begin with."""
    contradicted = {
        found.camera: found.message
        for found in check_files(samples, whole=False)
        if found.status == "warning" and found.cause in CAUSES_OF_DETECTORS
    }
    cameras, notes = dict(draft.cameras), dict(draft.camera_notes)
    for sample in samples:
        name = sample.camera.name
        detector = cameras[name].detector
        if name in contradicted:
            notes[name] = (*notes.get(name, ()), f"detector: the log contradicts the file: {contradicted[name]}")
        if name not in contradicted and not detector.estimate:
            notes[name] = (*notes.get(name, ()), "detector: as the file of cameras states it")
            continue
        noise = 2 * (rounded(max(sample.noise_px or 0.0, USUAL_SIGMA_PX), 3),)
        clutter = rounded(max(sample.isolated_per_frame, LEAST_CLUTTER), 3)
        unknown = DetectorConfig(sigma_px=noise, p_detect=0.9, clutter_per_frame=clutter, estimate=True)
        cameras[name] = cameras[name].model_copy(update={"detector": unknown})
    return replace(draft, cameras=cameras, camera_notes=notes)


def _rough(draft: Draft, samples: list[CameraSample]) -> dict[str, Choice] | None:
    """Return settings from rays and one-camera tracks, wide enough to track with; None where no rays meet."""
    bare = make_config({"units": {"length": draft.unit}, "cameras": _plain(draft.cameras)})
    cameras = bare.build_cameras()
    samples = [replace(sample, camera=camera) for sample, camera in zip(samples, cameras, strict=True)]
    geometry = measure(samples, expected_depths(bare.config, samples))
    scene = measure_scene(geometry, MEETING_SCORE)
    if scene.depths is None or scene.depths[0] <= 0.0:
        return None
    near, middle, far = scene.depths.tolist()
    pairs = sum(given.score >= MEETING_SCORE for given in geometry.given)
    why = f"from the depths at which rays of {pairs} pair{'s' * (pairs != 1)} of cameras meet"
    choices = {
        "filter.birth.depth_range": Choice([rounded(0.5 * near), rounded(2.0 * far)], why),
        "evaluation.cutoff": Choice(rounded(CUTOFF * middle, 1), "a tenth of the middle depth"),
    }
    # without tracks: a scene is crossed in a few seconds
    spread, fastest = (0.2 * middle, 2.0 * middle) if scene.speed is None else scene.speed.tolist()
    tracks = "from one-camera tracks at these depths"
    choices["filter.birth.velocity_std"] = Choice(rounded(max(2.0 * spread, 1e-3 * middle)), tracks)
    choices["motion.max_speed"] = Choice(rounded(max(5.0 * fastest, 0.02 * middle)), tracks)
    choices["motion.acceleration_std"] = Choice(rounded(max(0.5 * spread, 1e-4 * middle)), tracks)
    return choices


def _with_filter(draft: Draft, usual: Draft, log_path: Path | str) -> Draft:
    """Return the draft with what the filter finds in the log."""
    loaded = loaded_draft(draft, str(log_path))
    stream = open_stream(loaded.config, loaded.build_cameras(), log_path)
    parts = stretches(stream)
    if sum(map(len, parts)) < LEAST_EVENTS:
        return draft
    draft = _with_acceleration(draft, stream.cameras, parts, str(log_path))
    if any(camera.detector.estimate for camera in draft.cameras.values()):
        draft = _with_detectors(draft, loaded_draft(draft, str(log_path)), stream)
        stream = stream.with_cameras(loaded_draft(draft, str(log_path)).build_cameras())
        parts = stretches(stream)
        draft = _with_acceleration(draft, stream.cameras, parts, str(log_path))
    figures = measure_with_filter(loaded_draft(draft, str(log_path)), stream.cameras, parts)
    return draft if figures is None else draft.with_choices(_final(figures, usual, draft.unit))


def _with_acceleration(draft: Draft, cameras: tuple[Camera, ...], parts: list[list[Event]], name: str) -> Draft:
    """Return the draft with the acceleration that the log shows, from that of the draft on."""
    start = float(draft.choices["motion.acceleration_std"].value)
    found = estimate_acceleration(loaded_draft(draft, name), cameras, parts, start)
    why = f"from the likelihood of {len(found.tried)} values over {found.events} events"
    if found.value > found.usual:
        why += f" ({found.usual:g} for most of them, more where objects turn)"
    return draft.with_choices({"motion.acceleration_std": Choice(found.value, f"{why}; {draft.unit}/s^2")})


def _with_detectors(draft: Draft, loaded: LoadedConfig, stream: EventStream) -> Draft:
    """Estimate the detectors that are unknown; those that the log leaves uncertain stay to be estimated by `track`."""
    unknown = [name for name, camera in draft.cameras.items() if camera.detector.estimate]
    config, path = loaded.config, loaded.path
    _, report = estimate_detectors(
        stream.cameras, unknown, lambda used: build_labelled_filter(config, used, path, 1), stream
    )
    cameras, notes = dict(draft.cameras), dict(draft.camera_notes)
    for name, entry in report["cameras"].items():
        detector, text = _detector(cameras[name].detector, entry)
        cameras[name] = cameras[name].model_copy(update={"detector": detector})
        notes[name] = (*notes.get(name, ()), text)
    return replace(draft, cameras=cameras, camera_notes=notes)


def _detector(begun: DetectorConfig, entry: Mapping[str, Any]) -> tuple[DetectorConfig, str]:
    """Return the detector that an estimate gives, and its comment."""
    errors, p_error = entry["sigma_px_standard_error"], entry["p_detect_standard_error"]
    lasting = entry["residual_correlation"] is not None and max(entry["residual_correlation"]) > LASTING
    certain = errors is not None and max(e / s for e, s in zip(errors, entry["sigma_px"], strict=True)) < SIGMA_ERROR
    text = f"detector: from {entry['residuals']:.0f} detections of tracks that two cameras saw"
    sigma = begun.sigma_px
    if certain and not lasting:
        sigma = (rounded(entry["sigma_px"][0], 3), rounded(entry["sigma_px"][1], 3))
    elif lasting:
        text += "; their errors last from frame to frame, so sigma_px is that of the change between frames"
    else:
        text += "; too few to be sure of sigma_px, which is that of the change between frames"
    p_detect = begun.p_detect
    if p_error is not None and p_error < P_DETECT_ERROR:
        p_detect = rounded(min(max(entry["p_detect"], 0.05), 0.995), 3)
    clutter = rounded(max(entry["clutter_per_frame"], 1e-3), 3)
    return DetectorConfig(sigma_px=sigma, p_detect=p_detect, clutter_per_frame=clutter), text


def _final(figures: SceneFigures, usual: Draft, unit: str) -> dict[str, Choice]:
    """Return the settings that the tracks of the filter give."""
    near, far = figures.depths.tolist()
    middle = float(np.sqrt(near * far))
    seen = f"from {figures.objects} tracks at depths of {near:.3g} to {far:.3g} {unit}"
    speed = f"from their speeds: {figures.speed_std:.2g} {unit}/s per axis, at most {figures.fastest:.2g} {unit}/s"
    births = max(figures.births, 1) / max(figures.duration_s, 1e-9)
    if figures.births:
        why = f"{figures.births} new tracks in {figures.duration_s:.3g} s"
    else:
        births = min(births, usual.choices["filter.birth.per_s"].value)
        why = f"no new track in {figures.duration_s:.3g} s: at most one in that time"
    choices = {
        "motion.max_speed": Choice(rounded(max(FASTER * figures.fastest, 0.02 * middle)), speed),
        "region.depth": Choice(
            [rounded(REGION_NEARER * near), rounded(REGION_FARTHER * far)],
            f"where objects can be, {seen}; it bounds the depth while only one camera sees an object",
        ),
        "filter.birth.per_s": Choice(rounded(births), why),
        "filter.birth.depth_range": Choice([rounded(NEARER * near), rounded(FARTHER * far)], seen),
        "filter.birth.velocity_std": Choice(rounded(max(SPREAD * figures.speed_std, 1e-3 * middle)), speed),
        "report.max_position_std": Choice(
            rounded(UNCERTAIN * middle), "a tenth of the middle depth: new tracks appear once two cameras locate them"
        ),
        "evaluation.cutoff": Choice(
            rounded(CUTOFF * middle, 1),
            "a tenth of the middle depth: the largest error at which an object still counts as found",
        ),
    }
    if figures.deaths > 1:
        lost = 1.0 - figures.deaths / max(figures.seen_s, 1e-9)
        choices["filter.survival_per_s"] = Choice(
            rounded(min(max(lost, 0.8), 0.99)), f"{figures.deaths} tracks ended in {figures.seen_s:.3g} s of all tracks"
        )
    return choices
