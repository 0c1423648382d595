"""Counts of what a filter discarded at its limits during a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stereophd.pipeline.tracking.loop import Record


@dataclass
class Losses:
    """Events after which a bound left something out, and the most that it left out at once."""

    cut: int = 0
    most_left_out: int = 0
    bursts: int = 0
    burst_detections: int = 0
    crowded: int = 0
    most_hypotheses: int = 0

    def add(self, record: Record) -> None:
        """Take in a record."""
        if not record.is_event:
            return
        info = record.info
        self.cut += info.left_out > 0
        self.most_left_out = max(self.most_left_out, info.left_out)
        self.bursts += info.burst > 0
        self.burst_detections += info.burst
        self.crowded += info.hypotheses_left_out > 0
        self.most_hypotheses = max(self.most_hypotheses, info.hypotheses_left_out)

    def report(self) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        return {
            "events": self.cut,
            "most": self.most_left_out,
            "burst_frames": self.bursts,
            "burst_detections": self.burst_detections,
            "hypothesis_events": self.crowded,
            "most_hypotheses": self.most_hypotheses,
        }
