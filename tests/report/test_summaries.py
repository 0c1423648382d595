"""Sentences and tables about a report."""

from __future__ import annotations

import math

from stereophd.report.summaries import fit_totals, residual_text, summary_text, verdict


def test_figures_too_large_for_a_square_are_infinite() -> None:
    """Reports may be damaged: found by the fuzzer."""
    camera = {"detections": 2, "explained_detections": 2.0, "residuals": 2}
    usual = fit_totals({"cameras": {"left": {**camera, "residual_rms_px": 3.0, "residual_ratio": 1.0}}})
    assert (usual.residual_px, usual.ratio, usual.outliers) == (3.0, 1.0, 0.0)
    damaged = fit_totals({"cameras": {"left": {**camera, "residual_rms_px": 1e200, "residual_ratio": 1e200}}})
    assert (damaged.residual_px, damaged.ratio) == (math.inf, math.inf)


def test_residuals_say_where_many_are_left_out() -> None:
    assert [residual_text(1.19, share, " px") for share in (None, 0.1, 0.29)] == [
        "1.2 px",
        "1.2 px",
        "1.2 px (29 % left out)",
    ]


def test_what_the_verdict_says_is_not_said_again() -> None:
    """The reason of a calibration stood in the verdict, in the line of its status, and in a line of each part of it."""
    parts = {"calibration.noise": "residuals are large", "calibration.spread": "tracks are uncertain"}
    reason = "; ".join(parts.values())
    said = {"calibration.status": f"partly determined: {reason}", **parts, "calibration.motion": "objects are slow"}
    checks = [
        {"name": name, "status": "warning", "message": text, "camera": None, "remedy": None}
        for name, text in said.items()
    ]
    report = {"status": "partly determined", "reason": reason, "checks": checks, "provenance": {"config": {}}}
    text = summary_text(report)
    assert [text.count(part) for part in (*parts.values(), "objects are slow")] == [1, 1, 1]
    assert "0 of 4 checks passed, 4 warn" in text


def test_a_verdict_counts_a_check_that_warns_twice() -> None:
    names = ["log.pixels", "log.pixels", "geometry.rays"]
    checks = [{"name": name, "status": "warning"} for name in names]
    report = {"status": "partly determined", "reason": "why", "checks": checks}
    assert verdict(report) == (
        "Cameras are partly determined: why; 3 checks warn: log.pixels (2 times), geometry.rays."
    )
