"""Settings that fit a log: each estimated where the log is informative, and otherwise the usual value of a kind.

First rays of different cameras that meet, and one-camera tracks, give depths and speeds roughly, wide enough to track
with (`stereophd.pipeline.checks`). Then the filter runs over stretches of the log: its likelihood gives the
acceleration, its tracks give depths, speeds and births, and its residuals the detectors that are unknown.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig, make_config
from stereophd.core.disparity.events import Event
from stereophd.core.geometry.camera import Camera
from stereophd.errors import InputError
from stereophd.io.cameras.models import DetectorConfig
from stereophd.pipeline.build import build_labelled_filter
from stereophd.pipeline.checks.finding import CHECK_CAMERAS, DO_NOT_MEET, Finding, is_mistake
from stereophd.pipeline.checks.geometry.ray_checks import check_geometry
from stereophd.pipeline.checks.geometry.rays import measure
from stereophd.pipeline.checks.log.log_checks import check_files
from stereophd.pipeline.checks.log.sample import CameraSample, sample_log
from stereophd.pipeline.checks.run_checks import check_estimated_detectors
from stereophd.pipeline.checks.settings import expected_depths, measure_scene
from stereophd.pipeline.detectors.displacements import WIDER, usual_motion
from stereophd.pipeline.detectors.passes import MOST_BOXES, estimate_detectors, stretches
from stereophd.pipeline.detectors.ray_noise import are_compared, starting_detectors
from stereophd.pipeline.detectors.statistics import NoisePrior
from stereophd.pipeline.initial.acceleration import LEAST_GAIN, estimate_acceleration, log_likelihoods
from stereophd.pipeline.initial.measured import SceneFigures, measure_with_filter, shared_depths
from stereophd.pipeline.initial.template import Choice, Draft, rounded
from stereophd.pipeline.stream import EventStream, open_log, open_stream
from stereophd.pipeline.tracking.tracking_run import with_detectors
from stereophd.wording import PROGRESS, counted, number, percent

# Score from which rays of two cameras meet. It is lower than in a check, because the filter runs afterwards.
MEETING_SCORE = 2.5
# Frames of all cameras from which a filter shows anything, and the log-odds at which stated cameras are believed.
LEAST_FRAMES, BELIEVED = 4, float(np.log(1000.0))
# Margins of what is written about what was seen.
NEARER, FARTHER, SPREAD, FASTER = 0.7, 1.5, 1.3, 2.5
# Standard deviations of one component of the velocity that nearly all speeds are within.
SPREADS = 3.0
REGION_NEARER, REGION_FARTHER = 0.4, 2.5
# Largest standard deviation of a reported position, and the cutoff of scores, over the middle depth.
UNCERTAIN, CUTOFF = 0.2, 0.1
CAUSES_OF_DETECTORS = ("clutter", "sigma")
# Steps that a run shows; the check of the log is the last of them.
STEPS = 6
# What the depths of tracks say, which several cameras must have seen: objects that one alone sees may be elsewhere.
OF_DEPTH = "region.depth", "filter.birth.depth_range"
# Figures of a filter that concern points only.
UNUSED_BY_BODIES = {"region.depth", "report.max_position_std", "evaluation.cutoff"}


def draft_from_log(draft: Draft, log_path: Path | str) -> Draft:
    """Return a draft whose values follow from a log, where it is informative.

    The given draft has the cameras of the log, and the usual values of a kind of object. Raises InputError if the log
    is not usable, or is one of other cameras.
    """
    begin(1, "detections of one camera and rays of several are compared")
    bare = loaded_draft(draft, str(log_path))
    cameras = tuple(camera.build(name) for name, camera in draft.cameras.items())
    reader = open_log(bare.config.input, cameras, log_path)
    samples = sample_log(reader, cameras)
    if not any(len(sample.pixels) for sample in samples):
        frames = sum(len(sample.times) for sample in samples)
        raise InputError(f"{log_path}: expected detections, found none in {counted(frames, 'frame')} of all cameras")
    draft, unknown = _with_known_detectors(draft, samples)
    only_boxes, is_placed = all(sample.box_height_px is not None for sample in samples), not draft.is_unplaced
    bodies = _with_bodies(draft, samples, unknown, log_path) if only_boxes and is_placed else None
    if bodies is not None:
        return bodies
    cause, seeing = "poses or focal lengths are unknown", [one.camera.name for one in samples if len(one.pixels)]
    if is_placed and len(seeing) < 2:
        cause = f"only {seeing[0]} has detections"
    elif is_placed:
        started, priors = starting_detectors(cameras, unknown, samples)
        placed = [sample.with_camera(camera) for sample, camera in zip(samples, started, strict=True)]
        doubt = _mistake([one.with_measured_noise() if one.camera.name in unknown else one for one in placed])
        if doubt is None:
            tracked, why = _with_tracks(_with_cameras(draft, started, unknown), placed, priors, log_path)
            if why is None:
                return tracked
            *others, last = draft.cameras
            text = f"{', '.join(others)} and {last} do not agree: {why}"
            doubt = Finding("geometry.rays", "warning", text, remedy=CHECK_CAMERAS, cause=DO_NOT_MEET)
        draft, cause = replace(draft, findings=(doubt,)), doubt.message
    # rays and tracks of wrong cameras say nothing of the noise either
    cameras, priors = starting_detectors(cameras, unknown, samples, are_placed=False)
    if len(samples) > 1:
        why = f"detector: the noise about one-camera tracks and in displacements, because rays show none: {cause}"
        draft = _with_note(draft, unknown, why)
    samples = [sample.with_camera(camera) for sample, camera in zip(samples, cameras, strict=True)]
    # everything else follows from rays; tracks estimate the detectors once there are any
    draft = _with_cameras(draft, cameras, unknown, estimate=draft.must_be_calibrated)
    return draft.with_choices(_rough(draft, samples, priors) or {})


def _with_tracks(
    draft: Draft, samples: list[CameraSample], priors: Mapping[str, NoisePrior], log_path: Path | str
) -> tuple[Draft, str | None]:
    """Return the draft with what rays and the filter show, and why the cameras are wrong, if they are.

    They are if the log is more probable, 1,000 to 1, with the same settings where each camera has objects of its own,
    both at the acceleration that is enough for every turn and at the most probable one.
    Cameras that move are not calibrated, and so not wrong either.
    """
    rough, name, is_compared = _rough(draft, samples, priors), str(log_path), are_compared(samples)
    if rough is None:
        return draft, "no two cameras have a view in common" if is_compared else None
    parts = stretches(open_stream(loaded_draft(draft, name).config, [sample.camera for sample in samples], log_path))
    found = _with_filter(draft.with_choices(rough), draft, priors, parts, name)
    begin(5, "cameras are compared by their tracks")
    # with more acceleration than they have, or less than they turn with, tracks of two cameras wander from one another
    every, gain = range(len(samples)), -np.inf
    written, usual = found.choices["motion.acceleration_std"].value, found.usual_acceleration
    for value in [written] if usual in (None, written) else [written, usual]:
        loaded = loaded_draft(found.with_choices({"motion.acceleration_std": Choice(value, "")}), name)
        events = [list(part.with_cameras(loaded.build_cameras())) for part in parts]
        alone = sum(_log_likelihood(loaded, events, [k]) for k in every)
        gain = max(gain, _log_likelihood(loaded, events, every) - alone)
        if gain > -BELIEVED:
            break
    why = f"the log is more probable (by {-gain:,.0f} of the logarithm) if each sees objects of its own"
    return found, why if is_compared and gain <= -BELIEVED else None


def _log_likelihood(loaded: LoadedConfig, parts: list[list[Event]], group: Sequence[int]) -> float:
    """Return the log-likelihood of what these cameras alone detect, given by their numbers.

    Frames without any detection do not count: something may cover what the camera sees for a while, or nobody has
    looked there. As misses of its own each, they outweighed all that a hundred frames of another camera show.
    """
    cameras = loaded.build_cameras()
    seen = [[one for one in part if one.camera in group and len(one.points)] for part in parts]
    own = [[replace(one, camera=group.index(one.camera)) for one in part] for part in seen]
    return float(log_likelihoods(loaded, own, tuple(cameras[k] for k in group)).sum())


def begin(step: int, what: str) -> None:
    """Tell which step begins."""
    PROGRESS.info("%s, step %d of %d", what, step, STEPS)


def _mistake(samples: list[CameraSample]) -> Finding | None:
    """Return the mistake in times or pixels, or in cameras or clocks by which far fewer rays meet; None without one."""
    if (mistake := next(filter(is_mistake, check_files(samples, whole=False)), None)) is not None:
        return mistake
    if any(sample.box_height_px is not None or not sample.camera.pose.is_static for sample in samples):
        return None
    geometry = measure(samples, expected_depths(None, samples))
    return next((found for found in check_geometry(geometry) if found.name == "geometry.cause"), None)


def _with_bodies(
    draft: Draft, samples: list[CameraSample], unknown: Collection[str], log_path: Path | str
) -> Draft | None:
    """Return the draft for objects whose boxes the log has; None if the user states points, or it shows no size."""
    # imported here: what it needs of SciPy is costly to import
    from stereophd.pipeline.detectors.bodies import starting_box_detectors
    from stereophd.pipeline.initial.bodies import measure_bodies, refine_bodies

    stated, values = any(key.split(".")[0] == "object" for key in draft.given), draft.values()
    points = values["filter"]["kind"] != "pmb" or values.get("object") == {"shape": "point"}
    if points or not all(sample.camera.pose.is_static for sample in samples):
        return None
    cameras, priors = starting_box_detectors([sample.camera for sample in samples], unknown)
    name = str(log_path)
    parts = stretches(open_stream(loaded_draft(draft, name).config, cameras, log_path), MOST_BOXES)
    events = [list(part) for part in parts]
    usual = draft = _with_cameras(draft, cameras, unknown)
    if not stated:
        bodies = measure_bodies(cameras, events)
        if bodies is None:
            return None
        draft = draft.with_choices(bodies.choices(draft.unit))
        bodies = refine_bodies(bodies, loaded_draft(draft, name), cameras, events)
        draft = draft.with_choices(bodies.choices(draft.unit))
    begin(2, "the boxes of cameras are compared")
    strangers = tuple(_strangers(loaded_draft(draft, name), events))
    if strangers:  # whose noise would be that of their clocks or poses
        draft = _with_note(draft, unknown, "detector: what is usual, because the boxes of the cameras do not agree")
    elif priors:
        draft = _with_detectors(draft, loaded_draft(draft, name), priors, parts)
        estimated = zip(samples, loaded_draft(draft, name).build_cameras(), strict=True)
        # sigma_px is for what takes boxes for points
        noisy = tuple(sample.with_camera(camera).with_noise_of_middles.camera for sample, camera in estimated)
        draft = _with_cameras(draft, noisy, unknown)
        events = [list(part.with_cameras(noisy)) for part in parts]
    draft = _with_acceleration(replace(draft, findings=(*draft.findings, *strangers)), events, name, 4)
    figures = measure_with_filter(loaded_draft(draft, name), events)
    if figures is None:
        return draft
    # bodies are where their region says, and their boxes tell their depth
    final = _final(figures, usual, draft.unit)
    return draft.with_choices({key: choice for key, choice in final.items() if key not in UNUSED_BY_BODIES})


def _with_note(draft: Draft, cameras: Collection[str], note: str) -> Draft:
    notes = {name: (*draft.camera_notes.get(name, ()), note) for name in cameras}
    return replace(draft, camera_notes=draft.camera_notes | notes)


def _strangers(loaded: LoadedConfig, parts: list[list[Event]]) -> Iterator[Finding]:
    """Yield a warning of each camera whose boxes are more probably of objects of its own than of those of the others.

    The rays of boxes miss by too much to tell wrong clocks, and a noise that is estimated from boxes that do not agree
    would hide them: the cameras have the usual one. Beside a wrong camera the others do not agree with it either, so
    that one after the other is taken out, of which this is most probable; of two it may be either. Where none agrees
    with another, poses are no better than guesses, as where no rays of points meet. What drifts apart is wrong at the
    beginning or at the end: where all agree in the first stretch and in the last, the others are not looked at.
    """
    names, alike, strange = list(loaded.cameras), list(range(len(loaded.cameras))), dict[int, float]()

    @cache
    def likelihood_in(part: int, *group: int) -> float:
        return _log_likelihood(loaded, [parts[part]], group)

    def strangest(among: Sequence[int]) -> tuple[int, float]:
        """Return the camera whose boxes are least those of the others, and the log-likelihood that they are."""

        def likelihood(*group: int) -> float:
            return sum(likelihood_in(part, *group) for part in among)

        apart = {k: likelihood(k) + likelihood(*(other for other in alike if other != k)) for k in alike}
        worst = max(alike, key=lambda k: apart[k])
        return worst, likelihood(*alike) - apart[worst]

    if len(parts) > 2 and len(alike) > 1 and all(strangest([end])[1] > BELIEVED for end in (0, len(parts) - 1)):
        return
    while len(alike) > 1:
        worst, gain = strangest(range(len(parts)))
        if gain > -BELIEVED:
            break
        strange |= dict.fromkeys(alike if len(alike) == 2 else [worst], gain)
        alike = [k for k in alike if k not in strange]
    remedy, cause = (
        ("check its frame rate, clock and pose", "boxes_disagree") if alike else (CHECK_CAMERAS, DO_NOT_MEET)
    )
    for k, gain in strange.items():
        text = f"{names[k]}: its boxes are more probably (by {-gain:,.0f} of the logarithm) of objects of its own"
        yield Finding("geometry.boxes", "warning", text, round(gain, 1), 0.0, names[k], remedy, cause)


def _with_cameras(draft: Draft, cameras: tuple[Camera, ...], unknown: Collection[str], estimate: bool = False) -> Draft:
    """Return the draft with unknown detectors as these cameras have them; whether `track` is to `estimate` them."""
    described = dict(draft.cameras)
    for name, camera in with_detectors(draft.cameras, [c for c in cameras if c.name in unknown]).items():
        known = camera.detector
        detector = DetectorConfig(
            sigma_px=(rounded(known.sigma_px[0], 3), rounded(known.sigma_px[1], 3)),
            p_detect=rounded(min(max(known.p_detect, 0.05), 0.995), 3),
            clutter_per_frame=rounded(max(known.clutter_per_frame, 1e-3), 3),
            box_noise=None if known.box_noise is None else tuple(map(rounded, known.box_noise)),
            estimate=estimate,
        )
        described[name] = camera.model_copy(update={"detector": detector})
    return replace(draft, cameras=described)


def loaded_draft(draft: Draft, name: str) -> LoadedConfig:
    """Return the draft as a loaded configuration."""
    cameras = {key: camera.model_dump(mode="json", exclude_none=True) for key, camera in draft.cameras.items()}
    return make_config({**draft.values(), "cameras": cameras}, name)


def _with_known_detectors(draft: Draft, samples: list[CameraSample]) -> tuple[Draft, list[str]]:
    """Return the draft with comments on its detectors, and the cameras whose detectors are to be estimated."""
    contradicted = {
        finding.camera: finding.message
        for finding in check_files(samples, whole=False)
        if finding.status == "warning" and finding.cause in CAUSES_OF_DETECTORS
    }
    unknown = []
    for name, camera in draft.cameras.items():
        is_given = draft.is_given(f"cameras.{name}.detector")
        if not camera.detector.estimate and (is_given or name not in contradicted):
            said = "as given" if is_given else "as the file of cameras states it"
            draft = _with_note(draft, [name], f"detector: {said}")
            continue
        unknown.append(name)
        if not camera.detector.estimate:
            draft = _with_note(draft, [name], f"detector: the log contradicts the file: {contradicted[name]}")
    return draft, unknown


def _rough(draft: Draft, samples: list[CameraSample], priors: Mapping[str, NoisePrior]) -> dict[str, Choice] | None:
    """Return settings from rays and displacements, wide enough to track with; None where cameras share nothing."""
    scene, usual = None, draft.choices["filter.birth.depth_range"].value
    if not draft.must_be_calibrated:
        scene = measure_scene(measure(samples, expected_depths(None, samples)), MEETING_SCORE)
    if draft.is_unplaced:
        # turns show at what ratio to the depths objects move, and nothing shows the depths
        if not isinstance(usual, list):
            return None
        middle, choices = 2.0 / sum(1.0 / depth for depth in usual), dict[str, Choice]()  # of the mean disparity
    else:
        if scene is not None and scene.depths is not None and scene.depths[0] > 0.0:
            near, middle, far = scene.depths.tolist()
            why = "from the depths at which rays of different cameras meet"
        else:
            shared = shared_depths([sample.camera for sample in samples])
            if shared is None:
                return None
            near, middle, far = shared.tolist()
            why = "not from the log, in which too few rays meet: the depths that two cameras have in view"
        choices = {
            "filter.birth.depth_range": Choice([rounded(0.5 * near), rounded(2.0 * far)], why),
            "evaluation.cutoff": Choice(rounded(CUTOFF * middle, 1), "a tenth of the middle depth"),
        }
    spread, acceleration = (middle * one for one in usual_motion(samples, priors))
    fastest, tracks = SPREADS * spread, "from displacements between frames at these depths"
    if scene is not None and scene.speed is not None:
        (spread, fastest), tracks = scene.speed[:2].tolist(), "from one-camera tracks at these depths"
    choices["filter.birth.velocity_std"] = Choice(rounded(max(WIDER * spread, 1e-3 * middle)), tracks)
    choices["motion.max_speed"] = Choice(rounded(max(5.0 * fastest, 0.02 * middle)), tracks)
    how = "from how far one-camera tracks swerve at these depths"
    choices["motion.acceleration_std"] = Choice(rounded(max(acceleration, 1e-4 * middle)), how)
    return choices


def _with_filter(
    draft: Draft, usual: Draft, priors: Mapping[str, NoisePrior], parts: Sequence[EventStream], name: str
) -> Draft:
    """Return the draft with what the filter finds in stretches of the log of this name."""
    events = [list(part) for part in parts]
    if sum(map(len, events)) < LEAST_FRAMES:
        return draft
    draft = _with_acceleration(draft, events, name, 2)
    if priors:
        draft = _with_detectors(draft, loaded_draft(draft, name), priors, parts)
        cameras = loaded_draft(draft, name).build_cameras()
        events = [list(part.with_cameras(cameras)) for part in parts]
    figures = measure_with_filter(loaded_draft(draft, name), events)
    if figures is None:
        return _with_acceleration(draft, events, name, 4) if priors else draft
    final = _final(figures, usual, draft.unit)
    anywhere = draft.with_choices({key: choice for key, choice in final.items() if key not in OF_DEPTH})
    draft = _more_probable(draft.with_choices(final), anywhere, events, name)
    # where tracks were lost by other settings, their acceleration was too large
    draft = _with_acceleration(draft, events, name, 4)
    return _with_damping(draft, figures.speed_std, events, name)


def _more_probable(first: Draft, second: Draft, parts: list[list[Event]], name: str) -> Draft:
    """Return the draft with which the log is more probable, clearly if it is the second."""
    if first.choices == second.choices:
        return first
    before, after = (log_likelihoods(loaded_draft(one, name), parts).sum() for one in (first, second))
    return second if after > before + LEAST_GAIN else first


def _with_acceleration(draft: Draft, parts: list[list[Event]], name: str, step: int) -> Draft:
    """Return the draft with the acceleration that the log shows, from that of the draft on, unless it is given."""
    begin(step, "the acceleration is estimated")
    if draft.is_given("motion.acceleration_std"):
        return draft
    start = float(draft.usual_acceleration or draft.choices["motion.acceleration_std"].value)
    found = estimate_acceleration(loaded_draft(draft, name), parts, start)
    why = f"from the likelihood of {len(found.tried)} values over {found.events} events"
    why += f", to {percent(found.error)}" if found.error else ""
    if found.value > found.usual:
        why += f" ({found.usual:g} for most of them, more where objects turn)"
    chosen = Choice(found.value, f"{why}; {draft.unit}/s^2")
    return replace(draft.with_choices({"motion.acceleration_std": chosen}), usual_acceleration=found.usual)


def _with_damping(draft: Draft, speed_std: float, parts: list[list[Event]], name: str) -> Draft:
    """Return the draft with velocities that decay, where that is more probable than that they last.

    They decay in the time in which the acceleration of the draft holds the speeds at those of the tracks.
    """
    if draft.is_given("motion.model") or draft.is_given("motion.acceleration_std"):
        return draft
    settling = 2.0 * (speed_std / float(draft.choices["motion.acceleration_std"].value)) ** 2
    changes = {
        "motion.model": Choice("damped_velocity", "the log is more probable than with constant_velocity"),
        "motion.time_constant_s": Choice(
            rounded(settling), "in which this acceleration and the decay hold the speeds at those of the tracks; s"
        ),
    }
    return _more_probable(draft, draft.with_choices(changes), parts, name)


def _with_detectors(
    draft: Draft, loaded: LoadedConfig, priors: Mapping[str, NoisePrior], parts: Sequence[EventStream]
) -> Draft:
    begin(3, "the detectors are estimated")
    config, path = loaded.config, loaded.path
    cameras, report = estimate_detectors(
        parts[0].cameras, priors, lambda used: build_labelled_filter(config, used, path, 1), parts
    )
    for name, entry in report["cameras"].items():
        draft = _with_note(draft, [name], _source_of_detector(entry))
    draft = replace(draft, findings=tuple(check_estimated_detectors(report)))
    return _with_cameras(draft, cameras, priors)


def _source_of_detector(entry: Mapping[str, Any]) -> str:
    tracks = f"{entry['residuals']:.0f} detections of tracks that two cameras saw"
    if not entry["confirmed"]:
        before = "rays and one-camera tracks alone" if "sigma_px" in entry else "what is usual"
        return f"detector: noise from {before}, {tracks} did not confirm it; look at it"
    if "box_noise" in entry:
        return f"detector: from {tracks}; the noise is that of all cameras, sigma_px that of the middles of boxes"
    text = f"detector: from the rays and {tracks}"
    if (error := entry["clutter_per_frame_standard_error"]) is not None:
        share = float(np.divide(entry["sigma_px_standard_error"], entry["sigma_px"]).max())
        errors = 100.0 * share, entry["p_detect_standard_error"], error
        text += "; standard errors: noise {:.0f} %, p_detect {:.2g}, clutter_per_frame {:.2g}".format(*errors)
    return text


def _final(figures: SceneFigures, usual: Draft, unit: str) -> dict[str, Choice]:
    """Return the settings that the tracks of the filter give."""
    near, far = figures.depths.tolist()
    middle = float(np.sqrt(near * far))
    seen = f"from {counted(figures.objects, 'piece')} of tracks at depths of {number(near)} to {number(far)} {unit}"
    fastest = number(figures.fastest, 2)
    speed = f"from their speeds: {number(figures.speed_std, 2)} {unit}/s per axis, at most {fastest} {unit}/s"
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
            rounded(UNCERTAIN * middle), "a fifth of the middle depth: new tracks appear once two cameras locate them"
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
