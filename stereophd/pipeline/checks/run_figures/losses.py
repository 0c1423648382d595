"""Findings about what a run leaves out: bad rows, detections beyond the lens model, full filters."""

from collections.abc import Iterator, Mapping
from typing import Any

from stereophd.io.logs.checks import KINDS
from stereophd.pipeline.checks.finding import Finding


def check_rows(counts: Mapping[str, int]) -> Iterator[Finding]:
    """Yield a warning if rows of a log are bad, so that a run refuses the log unless it drops them.

    The counts are those of the rows that were read: ``rows`` and the kinds of bad rows.
    """
    if bad := _bad_rows(counts):
        text = f"{_rows(bad, counts)} that were read are bad ({_each(bad)}): a run refuses the log, or drops them"
        missing = "add the camera to the cameras" if "unknown_camera" in bad else "correct the rows"
        remedy = f"{missing}, or drop them (input.on_bad_row: drop)"
        yield Finding("input.rows", "warning", text, sum(bad.values()), 0, None, remedy, "bad_rows")


def _bad_rows(counts: Mapping[str, int]) -> dict[str, int]:
    return {kind: counts[kind] for kind in KINDS if counts.get(kind)}


def _rows(bad: Mapping[str, int], counts: Mapping[str, int]) -> str:
    return f"{sum(bad.values())} of {counts['rows']} rows"


def _each(bad: Mapping[str, int]) -> str:
    return ", ".join(f"{kind} {count}" for kind, count in bad.items())


def check_losses(summary: Mapping[str, Any], counts: Mapping[str, int]) -> Iterator[Finding]:
    """Yield a warning for each kind of data that a run left out.

    Of the figures of the run, as in ``report.json``, ``events`` and ``left_out`` are used. The counts are those of the
    log: ``rows``, the kinds of bad rows, ``not_invertible``.
    """
    if dropped := _bad_rows(counts):
        text = f"{_rows(dropped, counts)} dropped ({_each(dropped)})"
        yield Finding("input.rows", "warning", text, sum(dropped.values()), 0, cause="rows_dropped")
    if count := counts["not_invertible"]:
        text = f"{count} detections lie where the lens model cannot be inverted: left out"
        yield Finding("input.lens", "warning", text, count, 0, None, "check the coefficients of the lens", "lens")
    left_out, events = summary["left_out"], summary["events"]
    if cut := left_out["events"]:
        text = (
            f"after {cut} of {events} events the least probable tracks or components were left out, up to "
            f"{left_out['most']} at once"
        )
        remedy = "raise filter.max_components, or leave it to the memory (null)"
        yield Finding("filter.max_components", "warning", text, cut, 0, None, remedy, "filter_full")
    if crowded := left_out["hypothesis_events"]:
        text = (
            f"after {crowded} of {events} events the tracks had more hypotheses than filter.max_hypotheses: up to "
            f"{left_out['most_hypotheses']} of the least probable at once remain undecided, so that tracks take more "
            "events to settle"
        )
        remedy = "raise filter.max_hypotheses for fewer events, which take longer"
        yield Finding("filter.max_hypotheses", "warning", text, crowded, 0, None, remedy, "hypotheses_full")
    if bursts := left_out["burst_frames"]:
        text = (
            f"{bursts} of {events} frames have more detections beyond those of known objects than "
            f"filter.birth.max_per_frame: these {left_out['burst_detections']} count as clutter, and start no track"
        )
        remedy = "raise filter.birth.max_per_frame if they are objects"
        yield Finding("filter.bursts", "warning", text, bursts, 0, None, remedy, "burst")
