"""Sentences and tables about a report."""

from __future__ import annotations

import math

from stereophd.report.summaries import fit_totals, residual_text, verdict


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


def test_a_verdict_counts_a_check_that_warns_twice() -> None:
    names = ["log.pixels", "log.pixels", "geometry.rays"]
    checks = [{"name": name, "status": "warning"} for name in names]
    report = {"status": "partly determined", "reason": "why", "checks": checks}
    assert verdict(report) == (
        "Cameras are partly determined: why; 3 checks warn: log.pixels (2 times), geometry.rays."
    )
