"""Run all checks of a log, a configuration and cameras that need no filter."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.config.loading import LoadedConfig
from stereophd.core.geometry.camera import Camera
from stereophd.io.logs.reading import LogReader
from stereophd.pipeline.checks.finding import DO_NOT_MEET, ERRORS_LAST, Finding, is_mistake, is_overstated, warnings_of
from stereophd.pipeline.checks.geometry.ray_checks import check_geometry
from stereophd.pipeline.checks.geometry.rays import measure
from stereophd.pipeline.checks.log.log_checks import check_files
from stereophd.pipeline.checks.log.sample import CameraSample, sample_log
from stereophd.pipeline.checks.residuals import check_residuals
from stereophd.pipeline.checks.run_checks import check_rows
from stereophd.pipeline.checks.settings import check_settings, expected_depths, measure_scene
from stereophd.pipeline.stream import covered
from stereophd.wording import LOGGER


# Numbers near the largest may overflow: no finding follows from what is not finite.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def check_log(
    loaded: LoadedConfig, log_path: Path | str, of_rows: bool = True, cameras: tuple[Camera, ...] | None = None,
    from_s: float = -math.inf, alone: bool = False,
) -> tuple[Finding, ...]:  # fmt: skip
    """Check whether a log fits the cameras and the settings of a configuration.

    Other cameras, such as calibrated ones, can take the place of those of the configuration. Bad rows are findings if
    `of_rows`: a run refuses or counts them itself. Nothing before the time `from_s` is read. Returns findings about the
    log alone (with `alone` only these: poses may be unknown), about the geometry and about the settings, in this order.
    Raises InputError if the configuration has no cameras, the log is not usable, or the known trajectory of a camera
    does not cover it.
    """
    config = loaded.config
    if cameras is None:
        own = loaded.cameras.items()
        cameras = tuple(one.build(name) for name, one in own) if alone else loaded.build_cameras()
    reader = LogReader(log_path, cameras, "drop", float("inf"), from_s, config.input.leave_out)
    frames = (frame for frame in covered(cameras, reader, str(log_path)) if frame.time_s >= from_s)
    samples = sample_log(frames, cameras)
    whole = next(frames, None) is None
    if config.object.shape != "point":
        samples = [one.with_noise_of_middles for one in samples]
    # read all the same, so that it shows why they lie there
    outside = sum(int((~one.camera.contains(one.pixels, config.input.image_margin_px)).sum()) for one in samples)
    looked_at = {"rows": sum(len(one.pixels) for one in samples), "outside_image": outside}
    rows = (*check_rows(reader.counts), *check_rows(looked_at)) if of_rows else ()
    findings = [*rows, *_of_files(loaded, samples, whole)]
    if alone:
        return tuple(findings)
    # a noise that is not stated, or contradicted, is what it is about one-camera tracks, whatever poses and clocks are
    doubted = any(found.name == "detector.sigma" for found in warnings_of(tuple(findings)))
    unstated = [one.camera.name for one in samples] if doubted else loaded.estimated_cameras
    noise = {one.camera.name: one.camera.detector.sigma for one in samples}
    stated = {name: sigma for name, sigma in noise.items() if name not in loaded.estimated_cameras}
    samples = [one.with_measured_noise(only_less=one.camera.name not in unstated) for one in samples]
    moving = [sample.camera.name for sample in samples if not sample.camera.pose.is_static]
    why = f"geometry and settings are checked only for cameras that stand still; moving: {', '.join(moving)}"
    if mistakes := [found.name for found in findings if is_mistake(found)]:
        why = f"rays are compared once what {mistakes[0]} warns of is corrected"
    if mistakes or moving:
        return (*findings, Finding("geometry.rays", "not checked", why))
    geometry = measure(samples, expected_depths(config, samples))
    rays = [*check_geometry(geometry)]
    named = {found.cause for found in rays if found.name == "geometry.cause"}
    if named <= {DO_NOT_MEET} and config.object.shape == "point":
        # the middle of a box is not the image of the middle of a body
        residuals = tuple(check_residuals(geometry, stated))
        if named and warnings_of(residuals):
            # of rays that nearly meet they tell more than that some turn explains them
            rays = [found for found in rays if found.name != "geometry.cause"]
        rays += residuals
    unnamed = {found.cause for found in warnings_of(tuple(rays))}
    is_asked = unnamed <= {DO_NOT_MEET, ERRORS_LAST} and not geometry.is_suspicious  # which was asked at first
    if is_asked and (DO_NOT_MEET in unnamed or geometry.is_blurred()):
        sharp = [*check_geometry(geometry, is_blurred=True)]
        # errors that last blur rays as a mistake of the list does, which explains more; that some turn explains it
        # tells no more than that rays miss each other for long
        if not unnamed or {found.cause for found in sharp if found.name == "geometry.cause"} - {DO_NOT_MEET}:
            rays = sharp
    if warnings_of(tuple(rays)):
        # more noise than about one-camera tracks may be what keeps these rays together: less would only part them
        findings = [one for one in findings if not is_overstated(one)]
    # speeds follow from the times
    if not {"geometry.cause", "log.frame_rate"} & {found.name for found in warnings_of((*findings, *rays))}:
        rays += check_settings(config, measure_scene(geometry, region=config.region), samples, whole)
    return (*findings, *rays)


def _of_files(loaded: LoadedConfig, samples: list[CameraSample], whole: bool) -> tuple[Finding, ...]:
    """Return the findings about a log alone, without those about detectors that are to be estimated.

    The noise of points is no concern of bodies, whose boxes have errors that last; their known size shows depths.
    """
    unknown_clocks = [name for name, camera in loaded.cameras.items() if camera.clock.unknown]
    unasked = () if loaded.config.object.shape == "point" else ("detector.pairs", "detector.sigma", "log.detections")
    findings = check_files(samples, whole, unknown_clocks, loaded.estimated_cameras)
    return tuple(found for found in findings if found.name not in unasked)


def report_findings(findings: tuple[Finding, ...]) -> list[dict[str, Any]]:
    """Log every warning with its remedy; return all findings for a report."""
    for found in warnings_of(findings):
        change = "" if found.change is None else f": `overrides` '{found.change}'"
        remedy = "" if found.remedy is None else f" (remedy: {found.remedy}{change})"
        LOGGER.warning("check %s: %s%s", found.name, found.message, remedy)
    return [found.as_dict() for found in findings]
