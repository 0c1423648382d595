"""Findings about estimated detectors: which noise could not be estimated, and which errors are not noise."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from stereophd.pipeline.checks.finding import Finding

# Correlation of successive residuals from which errors cannot pass for white noise.
LASTING = 0.3
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
        text = f"the estimated detectors still change after {report['passes']} passes"
        yield Finding("detector.estimate", "warning", text, cause="not_converged")
    for name, estimate in report["cameras"].items():
        correlation, points = estimate["residual_correlation"], "sigma_px" in estimate
        # beyond two standard errors; the errors of boxes last as poses of bodies do: their filter allows for that
        lasts = correlation is not None and max(correlation) - 2.0 / np.sqrt(estimate["residuals"]) > LASTING
        if points and lasts:
            text = (
                f"{name}: errors last from frame to frame (correlation {correlation[0]:.2f}, {correlation[1]:.2f} "
                "along u, v): of pose, clock or lens, or of smoothed labels; with noise estimated from them tracks "
                "will be overconfident"
            )
            yield Finding(
                "detector.estimate", "warning", text, round(max(correlation), 2), LASTING, name, cause="errors_last"
            )
        if report["noise_in_log"]:
            continue
        key, unit = ("sigma_px", " px") if points else ("box_noise", "")
        noise = " x ".join(f"{value:.3g}" for value in estimate[key]) + unit
        if not estimate["confirmed"]:
            ratio = estimate["residual_ratio"]
            seen = "no track gave residuals" if ratio is None else f"the residuals of tracks are {ratio:.2g} times it"
            text = (
                f"{name}: tracks do not confirm the estimated noise ({seen}): it stays at {noise}, what the rays and "
                "the usual noise of detectors say"
            )
            remedy = f"state cameras.{name}.detector, or look at the other settings with `check`"
            yield Finding("detector.estimate", "warning", text, ratio, 1.0, name, remedy, cause="noise_not_confirmed")
        elif (error := _unsure(estimate, key)) > UNSURE:
            text = (
                f"{name}: the estimated noise of {noise} is known to a factor of {np.exp(2.0 * error):.1f} only, from "
                f"{estimate['residuals']:.0f} detections of tracks that two cameras saw"
            )
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


def _unsure(estimate: Mapping[str, Any], key: str) -> float:
    """Return the relative standard error of an estimated noise."""
    pairs = zip(estimate[f"{key}_standard_error"], estimate[key], strict=True)
    return float(max(error / sigma for error, sigma in pairs))
