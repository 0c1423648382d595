"""Counts of what a filter discarded at its limits during a run, and the warnings that report them."""

from __future__ import annotations

import logging
from typing import Any

from stereophd.pipeline.tracking.loop import Record

LOGGER = logging.getLogger("stereophd")


class Losses:
    """Events after which a bound left something out, and the most that it left out at once."""

    def __init__(self) -> None:
        self._cut, self._most_left_out = 0, 0
        self._bursts, self._burst_detections, self._largest_burst = 0, 0, 0

    def add(self, record: Record) -> None:
        """Take in a record."""
        if not record.is_event:
            return
        info = record.info
        self._cut += info.left_out > 0
        self._most_left_out = max(self._most_left_out, info.left_out)
        self._bursts += info.burst > 0
        self._burst_detections += info.burst
        self._largest_burst = max(self._largest_burst, info.burst)

    def report(self) -> dict[str, Any]:
        """Return the figures for ``report.json``."""
        return {
            "events": self._cut,
            "most": self._most_left_out,
            "burst_frames": self._bursts,
            "burst_detections": self._burst_detections,
        }

    def warn(self, events: int) -> None:
        """Warn of what was left out in a run of `events` events."""
        if self._cut:
            LOGGER.warning(
                "filter.max_components: after %d of %d events the least probable tracks or components were left out, "
                "up to %d at once: raise it, or leave it to the memory (null)",
                self._cut,
                events,
                self._most_left_out,
            )
        if self._bursts:
            LOGGER.warning(
                "filter.birth.max_per_frame: %d of %d frames have more detections than that beyond those of known "
                "objects, up to %d: they count as clutter, and no track begins there. If they are objects, raise it",
                self._bursts,
                events,
                self._largest_burst,
            )
