"""Checks of a finished tracking run: is the log explained, by more than one camera; what was left out; detectors."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from stereophd.core.geometry.camera import Camera
from stereophd.io.logs.checks import REMEDIES, bad_rows
from stereophd.pipeline.checks.finding import (
    DO_NOT_MEET,
    ERRORS_LAST,
    LASTING_REMEDY,
    Finding,
    misleads,
    once_mended,
    warnings_of,
)
from stereophd.wording import instant, percent

# Share of the detections of objects that tracks must explain, and detections from which it is judged.
LEAST_EXPLAINED, LEAST_DETECTIONS = 0.35, 100
# Residuals over what the stated noise leads to expect, outside which the noise is wrong, and the fewest that show it;
# and from which it is too small where one-camera tracks show it too.
RESIDUAL_RATIOS, LEAST_RESIDUALS, BOTH_SHOW = (0.5, 2.0), 60, 1.4
# Share of the residuals from which it matters that these are left out as outliers.
MOST_OUTLIERS = 0.1
# Causes among those that mislead that a knock of the same camera looks like.
OF_KNOCKS = ("pose_inaccurate", "detections_shifted", "errors_last")
# Share of the rays that met before a knock which must meet again with another clock, to call it a jump of times.
MET_AGAIN = 0.7
# Squares of errors of tracks beyond those that they state, over these, and their standard errors, from which tracks are
# too sure; and what a camera shows of them by itself, over what cameras show together, from which both agree.
TOO_SURE, TOO_SURE_ERRORS, AGREE = 0.25, 4.0, 0.5
# Frames of a camera from which unexplained detections are judged: against this many times the stated clutter, so many
# standard errors, and this share of all detections, which tracks need to begin and to end.
LEAST_FRAMES, CLUTTER_FACTOR, CLUTTER_ERRORS, LEAST_UNEXPLAINED = 30, 2.0, 4.0, 0.3
# Tracks in view from which their misses are judged: against this many times the stated ones, or fewer, and this more.
LEAST_IN_VIEW, MISSES_FACTOR, LEAST_MISSES = 200, 2.0, 0.1
# Part of the variance of misses that lasts from one frame to the next, from which they are no chance of each frame.
MOST_LASTING = 0.05
# Detections that hypotheses beyond their bound would have decided, over all, from which tracks suffer.
MOST_UNDECIDED = 0.005
# A track is one camera's if this share of its detections is; reported if most estimates belong to such tracks.
ONE_CAMERA, MOST_ALONE = 0.95, 0.5
# Tracks that end together, at least; the probability of chance, ends independent, below which they do not by chance;
# and the last part of a log, in which tracks end with it.
LEAST_TOGETHER, LEAST_BY_CHANCE, LAST_PART = 3, 1e-3, 0.05


@dataclass(frozen=True)
class FinishedRun:
    """A finished run, as its checks see it."""

    summary: Mapping[str, Any]  # The figures of the run, as in ``report.json``
    counts: Mapping[str, int]  # Those of the log: ``detections``, ``frames``, ``rows``, the kinds of bad rows
    cameras: tuple[Camera, ...]
    has_noise: bool  # Whether the log states the noise of each detection
    has_boxes: bool = False  # Whether bodies were tracked
    can_estimate: bool = False  # Whether `track` can estimate the acceleration, and has not

    def checked(
        self, before: tuple[Finding, ...], since: Callable[[float], tuple[Finding, ...]]
    ) -> tuple[Finding, ...]:
        """Return what tracks show, after the checks `before` the run, which also tell what is so `since` a time."""
        summary, counts, cameras = self.summary, self.counts, self.cameras
        found = (*before, *check_tracking(summary, counts, cameras))
        if not (self.has_boxes or self.has_noise):  # the residuals of bodies are their own, and so is each noise
            found += tuple(once_mended(check_errors(summary, self.can_estimate), found))
        found += (*check_knocks(summary, found, since), *check_ends(summary))
        if not self.has_boxes:
            # the middle of a box is not the image of the middle of a body
            noise = check_noise(summary, cameras, self.has_noise, found)
            found += tuple(once_mended(noise, found, but=("detector.sigma", "tracking.errors")))
        # errors that last and are smaller than the noise take no detection from a track
        found += tuple(once_mended(check_detections(summary, cameras), found, but=(ERRORS_LAST,)))
        return (*found[len(before) :], *check_losses(summary, counts))


def check_tracking(
    summary: Mapping[str, Any], counts: Mapping[str, int], cameras: tuple[Camera, ...]
) -> Iterator[Finding]:
    """Yield findings about the tracks of a run.

    Of the figures of the run, as in ``report.json``, ``tracks.n_detections`` by camera and ``left_out`` are used. The
    counts are those of the log: ``detections``, ``frames``.
    """
    detections, frames = counts["detections"], counts["frames"]
    clutter = frames * float(np.mean([camera.detector.clutter_per_frame for camera in cameras]))
    outside = sum(camera["outside_region"] for camera in summary["cameras"].values())
    objects = detections - clutter - outside - summary["left_out"]["burst_detections"]
    tracks = summary["tracks"]
    count = len(tracks)
    if count == 0 and (objects + outside >= LEAST_DETECTIONS or not detections):
        why = (
            "although the log has detections beyond the clutter" if detections else "because the log has no detections"
        )
        why += f", {outside:,} of which see nothing of the region" if outside else ""
        remedy = "run `check` on the same configuration and log; look at filter.birth, the region and the cameras"
        yield Finding("tracking.tracks", "warning", f"no track was reported {why}", 0, None, None, remedy, "no_tracks")
        return
    if count == 0 or objects < LEAST_DETECTIONS:
        yield Finding("tracking.tracks", "not checked", "too few detections or tracks to judge the run")
        return
    own = np.array([[track["n_detections"][camera.name] for track in tracks] for camera in cameras], dtype=float)
    explained = float(own.sum()) / objects
    value, expected = round(explained, 3), float(np.mean([camera.detector.p_detect for camera in cameras]))
    text = f"tracks explain {percent(min(explained, 1.0))} of the detections that are not expected to be clutter"
    if explained < LEAST_EXPLAINED:
        remedy = "run `check` on the same configuration and log: cameras, clocks, clutter or births do not fit"
        yield Finding("tracking.explained", "warning", text, value, expected, None, remedy, "unexplained")
    else:
        yield Finding("tracking.explained", "ok", text, value)
    if sum(summary["cameras"][camera.name]["detections"] > 0 for camera in cameras) < 2:
        return
    largest = own.max(axis=0) / np.maximum(own.sum(axis=0), 1.0)
    estimates = np.array([track["n_estimates"] for track in tracks], dtype=float)
    alone = float(estimates[largest >= ONE_CAMERA].sum() / max(estimates.sum(), 1.0))
    text = f"{percent(alone)} of the estimates belong to tracks that one camera alone supports"
    if alone > MOST_ALONE:
        remedy = "check poses, intrinsics and clocks: cameras that see the same object do not agree"
        yield Finding("tracking.cameras", "warning", text, round(alone, 3), None, None, remedy, "one_camera_tracks")
    else:
        yield Finding("tracking.cameras", "ok", text, round(alone, 3))


def check_detections(summary: Mapping[str, Any], cameras: tuple[Camera, ...]) -> Iterator[Finding]:
    """Yield a warning for every camera that detects far more false objects, or far fewer tracks, than it states.

    What no track explains counts as clutter: it is compared with the clutter that the detector states.
    """
    for camera in cameras:
        figures, name = summary["cameras"][camera.name], camera.name
        frames, detections = figures["frames"], figures["detections"]
        if frames < LEAST_FRAMES or not summary["tracks"]:
            continue
        stated = camera.detector.clutter_per_frame
        unexplained = (detections - figures["outside_region"] - figures["explained_detections"]) / frames
        most = CLUTTER_FACTOR * stated + CLUTTER_ERRORS * float(np.sqrt(max(stated, 1.0 / frames) / frames))
        most += LEAST_UNEXPLAINED * detections / frames
        if unexplained > most:
            yield Finding(
                "tracking.detections", "warning",
                f"{name}: tracks leave {unexplained:.2g} detections of a frame unexplained, and clutter_per_frame is "
                f"{stated:.2g}: objects that this camera sees have no tracks, or it makes more false detections",
                round(unexplained, 3), stated, name,
                f"set cameras.{name}.detector.clutter_per_frame near {unexplained:.2g} if they are false; else look at "
                "the births and at the other cameras", "unexplained_detections",
            )  # fmt: skip
        share, promised = figures["detected_share"], camera.detector.p_detect
        if share is None or figures["in_view"] < LEAST_IN_VIEW or not detections:
            continue
        missed, again = 1.0 - share, figures["missed_again"] or 0.0
        fewer, more = sorted((1.0 - promised, missed))
        near = f"{min(max(share, 0.05), 0.99):.2g}"
        if (lasting := missed * (again - missed)) > MOST_LASTING:
            yield Finding(
                "tracking.detections", "warning",
                f"{name}: tracks in its view are missed in {percent(missed)} of its frames, and after a miss in "
                f"{percent(again)}: it does not see some of them for long, and p_detect states single misses; objects "
                "are hidden, the camera stalls or was moved, or these tracks are of no objects", round(lasting, 3), 0.0,
                name, "look at which tracks one camera supports (n_detections of each in the report): at shadows, "
                "reflections and lamps, and at what hides objects", "misses_last",
            )  # fmt: skip
        elif more > MISSES_FACTOR * fewer and more > fewer + LEAST_MISSES:
            yield Finding(
                "tracking.detections", "warning",
                f"{name}: tracks in its view are detected in {percent(share)} of its frames, and p_detect is "
                f"{promised:g}: tracks end too early if it is too large, and too late if it is too small",
                round(share, 3), promised, name,
                f"set cameras.{name}.detector.p_detect near {near}, or let track estimate it (detector: estimate)",
                "p_detect", f"cameras.{name}.detector.p_detect={near}",
            )  # fmt: skip


def check_errors(summary: Mapping[str, Any], can_estimate: bool) -> Iterator[Finding]:
    """Yield a finding on ``track_errors`` of the figures of a run: do tracks err by more than they state?

    Tracks that lag behind their objects leave residuals that agree from frame to frame and between cameras. Where the
    detections of one camera agree against those of the others, these last; where they agree between cameras alone,
    cameras share them. `can_estimate`: whether `track` can estimate the acceleration, and has not.
    """
    sums = [summary["track_errors"][key] for key in ("same_camera", "other_camera")]
    same, other = ((one["excess"] or 0.0, one["standard_errors"] or 0.0) for one in sums)
    too_sure = [excess > TOO_SURE and errors > TOO_SURE_ERRORS for excess, errors in (same, other)]
    if not any(one["pairs"] for one in sums):
        yield Finding("tracking.errors", "not checked", "no successive detections show whether tracks err")
        return
    if not any(too_sure):
        text = "successive residuals show no errors of tracks beyond those that they state"
        yield Finding("tracking.errors", "ok", text, round(max(same[0], other[0]), 3), 0.0)
        return
    most = max(excess for (excess, _), is_sure in zip((same, other), too_sure, strict=True) if is_sure)
    text, cause, change = f"tracks err by about {np.sqrt(1.0 + most):.2g} times what they state: ", ERRORS_LAST, None
    remedy = LASTING_REMEDY
    if other[0] < 0.0:
        text += "residuals of a camera agree from frame to frame, against those of the others: errors of detections "
        text += "last, or a clock or lens is off"
    elif not too_sure[0] and same[0] < AGREE * other[0]:
        text += "residuals of a camera agree with those of the others just before, but not with its own: cameras share "
        text += "their errors, as where one camera is in the log under two names"
        cause, remedy = "errors_shared", "leave out one of two cameras that have the same detections"
    else:
        text += "successive residuals agree, as of objects that turn, stop or sway more than the motion model lets them"
        cause, remedy = "acceleration_std", "state a larger motion.acceleration_std, or more noise (sigma_px)"
        if can_estimate:
            remedy = "let track estimate it (motion.acceleration_std: estimate), or state a larger one"
            change = "motion.acceleration_std=estimate"
    yield Finding("tracking.errors", "warning", text, round(most, 3), 0.0, None, remedy, cause, change)


def check_ends(summary: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a warning where all tracks end together long before the log does: no camera sees anything for a time.

    Objects come and go independently: of k tracks, that the others end within a time w of one has the probability
    (1 - exp(-r w))^(k - 1), with the rate r of ends elsewhere, and no less than a frame for w. All ends are tested.
    """
    tracks = summary["tracks"]
    first, last = (np.array([track[key] for track in tracks], dtype=np.float64) for key in ("first_s", "last_s"))
    longest_s, ends = LAST_PART * summary["duration_s"], np.sort(last)
    end_s = (summary["first_s"] or 0.0) + summary["duration_s"] - longest_s
    frame_s = summary["duration_s"] * len(summary["cameras"]) / max(summary["events"], 1)
    early = np.arange(np.searchsorted(ends, end_s))
    counts = np.searchsorted(np.sort(first), ends[early]) - early
    ending = np.searchsorted(ends, ends[early] + longest_s, side="right") - early
    enough = (ending >= counts) & (counts >= LEAST_TOGETHER)
    for at_s in ends[early[enough]].tolist():
        alive = (first < at_s) & (last >= at_s)
        count, within_s = int(alive.sum()), float(last[alive].max() - at_s)
        rate = max(len(early) - count + 1, 1) / max(float((last - first).sum()), 1e-300)
        if count < LEAST_TOGETHER or within_s > longest_s:
            continue
        if len(tracks) * (-np.expm1(-rate * (within_s + frame_s))) ** (count - 1) < LEAST_BY_CHANCE:
            yield Finding(
                "tracking.ends", "warning",
                f"all {count} tracks end at {instant(at_s)} s, and "
                + ("those after it are new ones" if (first > at_s).any() else "none comes after it")
                + ": from then on no camera sees anything for a time, or all objects leave together",
                round(at_s, 3), None, None, "look whether the detector or the recording failed then",
                "ends_together",
            )  # fmt: skip
            return


def check_knocks(
    summary: Mapping[str, Any], before: tuple[Finding, ...],
    since: Callable[[float], tuple[Finding, ...]] = lambda time_s: (),
) -> Iterator[Finding]:  # fmt: skip
    """Yield a warning for a camera that was knocked during the recording (``knocks`` of the figures of the run).

    A noise stated too small, a lens or a clock of these cameras, the pose of another one, or rays that do not meet, of
    which the checks `before` the run warn, look like a knock; clutter does not. So do times that jump, as where frames
    were lost: the same checks, `since` a time, tell a clock of these cameras that is off from then on.
    """
    alike = [one for one in before if misleads(one) and one.cause != "clutter"]
    rays = [one.value for one in before if one.name == "geometry.rays" and isinstance(one.value, float)]
    met = float(np.mean(rays)) if rays else 0.0
    since = cache(since)
    for knock in summary["knocks"]:
        names, when = (knock["camera"], *knock["others"]), f"from {instant(knock['since_s'])} s on"
        doubts = tuple(
            one for one in alike
            if one.cause == DO_NOT_MEET or (one.camera in (None, *names)) != (one.cause in OF_KNOCKS)
        )  # fmt: skip
        jumped = [
            one for one in (() if doubts else warnings_of(since(knock["time_s"])))
            if one.cause == "clock_offset" and one.camera in (None, *names) and isinstance(one.expected, float)
            and (one.name == "geometry.residuals" or one.expected >= MET_AGAIN * met)
        ]  # fmt: skip
        camera, cause = names[0], "knocked"
        text = (
            f"{', or '.join(names)}: {when} its detections lie where a camera would see the tracks that is turned by "
            f"about {knock['turn_deg']:.2g} degrees (noticed at {instant(knock['time_s'])} s): it was knocked, or "
            "moved; tracks after that are doubtful"
        )
        remedy = f"calibrate cameras.{camera} anew from the log after that, and give it as poses with from_s"
        if jumped:
            camera, cause = None, "times_jump"
            text = f"the times of a camera jump {when}, as where frames were lost: after that {jumped[0].message}"
            remedy = "import with the times of the frames, or with frame numbers that count the lost ones too"
        since_s = round(knock["since_s"], 3)
        found = Finding("tracking.knocked", "warning", text, since_s, None, camera, remedy, cause)
        yield from once_mended([found], doubts)


def check_noise(
    summary: Mapping[str, Any], cameras: tuple[Camera, ...], noise_in_log: bool, before: tuple[Finding, ...] = ()
) -> Iterator[Finding]:
    """Yield a finding for every camera: do the residuals of the tracks have the size that the stated noise promises?

    Before it a warning where many are left out as outliers.

    Of the figures of the run, as in ``report.json``, ``cameras`` are used. With `noise_in_log` the log states the noise
    of every detection, so that the detectors state none. Tracks break where the stated noise is too small, and follow
    their detections where the motion is too free: the checks `before` the run measured it about one-camera tracks.
    """
    measured = {one.camera: one.expected for one in before if one.name == "detector.sigma" and one.expected}
    for camera in cameras:
        figures = summary["cameras"][camera.name]
        ratio, name, outliers = figures["residual_ratio"], camera.name, figures["outlier_share"] or 0.0
        if figures["residuals"] >= LEAST_RESIDUALS and outliers > MOST_OUTLIERS:
            yield Finding(
                "tracking.outliers", "warning",
                f"{name}: {percent(outliers)} of the residuals are far beyond all others, and left out of their "
                "figures: tracks take false detections, or those of other objects", round(outliers, 3), MOST_OUTLIERS,
                name, "look at the residuals in the report, at the clutter and at motion.acceleration_std", "outliers",
            )  # fmt: skip
        if noise_in_log or ratio is None or figures["residuals"] < LEAST_RESIDUALS:
            why = "the log states the noise" if noise_in_log else "too few detections of tracks"
            yield Finding("tracking.noise", "not checked", f"{name}: {why}", camera=name)
            continue
        stated = float(np.sqrt((camera.detector.sigma**2).mean()))
        text = f"{name}: residuals are {ratio:.2g} times what the stated noise of {stated:.3g} px leads to expect"
        better, doubted = measured.get(name), "poses, lenses, clocks and motion.acceleration_std"
        both_show = isinstance(better, float) and min(ratio, better / stated) > BOTH_SHOW
        if RESIDUAL_RATIOS[0] <= ratio <= RESIDUAL_RATIOS[1] and not both_show:
            yield Finding("tracking.noise", "ok", text, round(ratio, 3), 1.0, name)
            continue
        is_other = isinstance(better, float) and not both_show and (ratio > 1.0 or better > RESIDUAL_RATIOS[0] * stated)
        if ratio > 1.0:
            effect = "tracks are too sure of themselves, break and multiply; or the cameras or the motion do not fit"
        elif is_other:
            effect, doubted = "tracks follow their detections too closely", "motion.acceleration_std: too large?"
        else:
            effect = "tracks follow their detections too little, and are less sure than they could be"
            better = ratio * stated
        remedy, cause = "let track estimate it (detector: estimate)", "sigma"
        change: str | None = "detector=estimate"
        if is_other:
            cause, change, remedy = "residuals", None, f"one-camera tracks show {better:.2g} px: look at {doubted}"
        elif isinstance(better, float):
            remedy = f"set cameras.{name}.detector.sigma_px near {better:.2g}, or {remedy}"
            change = f"cameras.{name}.detector.sigma_px=[{better:.2g}, {better:.2g}]"
        yield Finding(
            "tracking.noise", "warning", f"{text}: {effect}", round(ratio, 3), 1.0, name, remedy, cause, change
        )  # fmt: skip


def check_rows(counts: Mapping[str, int]) -> Iterator[Finding]:
    """Yield a warning if rows of a log are bad, so that a run refuses the log unless it drops them.

    The counts are those of the rows that were looked at: ``rows`` and the kinds of bad rows.
    """
    bad, each = bad_rows(counts)
    if bad:
        text = f"{bad} of the {counts['rows']} rows looked at are bad ({each}): a run refuses the log, or drops them"
        mend = " and ".join(text for kind, text in REMEDIES.items() if counts.get(kind)) or "correct the rows"
        remedy = f"{mend}, or drop them (input.on_bad_row: drop)"
        yield Finding("input.rows", "warning", text, bad, 0, None, remedy, "bad_rows")


def check_losses(summary: Mapping[str, Any], counts: Mapping[str, int]) -> Iterator[Finding]:
    """Yield a warning for each kind of data that a run left out.

    Of the figures of the run, as in ``report.json``, ``events``, ``left_out`` and ``detections`` by camera are used.
    The counts are those of the log: ``rows``, the kinds of bad rows, ``not_invertible``.
    """
    dropped, each = bad_rows(counts)
    if dropped:
        text = f"{dropped} of {counts['rows']} rows dropped ({each})"
        yield Finding("input.rows", "warning", text, dropped, 0, cause="rows_dropped")
    if count := counts["not_invertible"]:
        text = f"{count} detections lie where the lens model cannot be inverted: left out"
        yield Finding("input.lens", "warning", text, count, 0, None, "check the coefficients of the lens", "lens")
    left_out, events = summary["left_out"], summary["events"]
    detections = sum(camera["detections"] for camera in summary["cameras"].values())
    undecided = 100.0 * left_out["undecided_detections"] / max(detections, 1)
    for count, name, text, remedy, cause in (
        (
            left_out["events"], "filter.max_components",
            f"after {{}} of {events} events the least probable tracks or components were left out, up to "
            f"{left_out['most']} at once", "raise filter.max_components, or leave it to the memory (null)",
            "filter_full",
        ),
        (
            left_out["hypothesis_events"] if undecided > 100.0 * MOST_UNDECIDED else 0, "filter.max_hypotheses",
            f"after {{}} of {events} events the tracks had more hypotheses than filter.max_hypotheses, up to "
            f"{left_out['most_hypotheses']} more: these would have decided {undecided:.1f} % of all detections, so "
            "that tracks take more events to settle, and are less accurate until then",
            "raise filter.max_hypotheses; events take longer then", "hypotheses_full",
        ),
        (
            left_out["burst_frames"], "filter.bursts",
            f"{{}} of {events} frames have more detections beyond those of known objects than "
            f"filter.birth.max_per_frame: these {left_out['burst_detections']} count as clutter, and start no track",
            "raise filter.birth.max_per_frame if they are objects", "burst",
        ),
    ):  # fmt: skip
        if count:
            yield Finding(name, "warning", text.format(count), count, 0, None, remedy, cause)


# Relative standard error from which an estimated noise is unsure: two of them are a factor of 1.5.
UNSURE = 0.2
# Standard error of the clutter, over it and in detections of a frame, from which it is unsure.
UNSURE_CLUTTER, LEAST_UNSURE = 0.5, 0.5


def check_estimated_detectors(report: Mapping[str, Any] | None) -> Iterator[Finding]:
    """Yield a warning for each estimate that must be used with care.

    The report is that of `stereophd.pipeline.detectors.passes.estimate_detectors`; None: nothing was estimated.
    """
    if report is None:
        return
    if not report["converged"]:
        text = f"the estimated detectors still change after {report['passes']} runs of the filter"
        yield Finding("detector.estimate", "warning", text, cause="not_converged")
    for name, estimate in report["cameras"].items():
        # that the log has no frame of a camera is a warning of its own
        if report["noise_in_log"] or not estimate.get("frames", 1):
            continue
        key, unit = ("sigma_px", " px") if "sigma_px" in estimate else ("box_noise", "")
        noise = " x ".join(f"{value:.3g}" for value in estimate[key]) + unit
        error = float(max(np.divide(estimate[f"{key}_standard_error"], estimate[key])))
        factor = f"known to a factor of {np.exp(2.0 * error):.1f} only"
        seen = f"{estimate['residuals']:.0f} detections of tracks that two cameras saw"
        if not estimate["confirmed"]:
            ratio, correlation = estimate["residual_ratio"], estimate["residual_correlation"]
            seen += "" if ratio is None else f", whose residuals are {ratio:.2g} times it"
            # no white noise: of pose, clock, lens or smoothed labels, or of a motion that the model does not follow
            lasting = "" if correlation is None else ", ".join(f"{value:.2f}" for value in correlation)
            seen += f", with a correlation from frame to frame of {lasting}" if lasting else ""
            text = f"{name}: tracks do not confirm the estimated noise ({seen}): it is {noise}, {factor}"
            remedy = f"state cameras.{name}.detector, or look at the other settings with `check`"
            yield Finding("detector.estimate", "warning", text, ratio, 1.0, name, remedy, cause="noise_not_confirmed")
        elif error > UNSURE:
            text = f"{name}: the estimated noise of {noise} is {factor}, from {seen}"
            remedy = f"state cameras.{name}.detector.{key} if you know it, or take a longer log"
            yield Finding(
                "detector.estimate", "warning", text, round(error, 2), UNSURE, name, remedy, "too_few_detections"
            )
        clutter, error = estimate["clutter_per_frame"], estimate["clutter_per_frame_standard_error"]
        if error is not None and error > max(UNSURE_CLUTTER * clutter, LEAST_UNSURE):
            text = (
                f"{name}: the estimated clutter of {clutter:.2g} detections of a frame is known to {error:.2g} only: "
                "few frames, or objects that tracks do not settle"
            )
            remedy = f"state cameras.{name}.detector.clutter_per_frame if you know it, or take a longer log"
            yield Finding("detector.estimate", "warning", text, round(error, 2), None, name, remedy, "clutter_unsure")
