"""Counts of what a filter discarded at its limits during a run."""

from __future__ import annotations

from typing import Any

from stereophd.pipeline.tracking.loop import Record


class Losses:
    """Events after which a bound left something out, and the most that it left out at once."""

    def __init__(self) -> None:
        self._cut, self._most_left_out = 0, 0
        self._bursts, self._burst_detections = 0, 0
        self._crowded, self._most_hypotheses = 0, 0

    def add(self, record: Record) -> None:
        """Take in a record."""
        if not record.is_event:
            return
        info = record.info
        self._cut += info.left_out > 0
        self._most_left_out = max(self._most_left_out, info.left_out)
        self._bursts += info.burst > 0
        self._burst_detections += info.burst
        self._crowded += info.hypotheses_left_out > 0
        self._most_hypotheses = max(self._most_hypotheses, info.hypotheses_left_out)

    def report(self) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        return {
            "events": self._cut,
            "most": self._most_left_out,
            "burst_frames": self._bursts,
            "burst_detections": self._burst_detections,
            "hypothesis_events": self._crowded,
            "most_hypotheses": self._most_hypotheses,
        }
