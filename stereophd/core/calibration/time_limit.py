"""The stages of a calibration, and the time that it may take: every long step begins with `TimeLimit.begin`."""

import logging
import math
import time
from dataclasses import dataclass

# Its messages name the stage that begins (level INFO), or a step of it (DEBUG, with the attribute ``within``).
LOGGER = logging.getLogger("stereophd.progress")

TIME_OVER = "the time was over"


@dataclass(frozen=True)
class TimeLimit:
    """When a calibration has to end: a time of `time.monotonic`, which all processes of a machine share."""

    ends: float = math.inf

    @property
    def is_over(self) -> bool:
        """Whether the time is over: the best so far is the answer."""
        return time.monotonic() >= self.ends

    def begin(self, stage: str) -> bool:
        """Tell that a stage begins; return whether there is time for it."""
        left = self.ends - time.monotonic()
        LOGGER.info("%s%s", stage, f" (begun with {max(left, 0.0):.0f} s left)" if math.isfinite(left) else "")
        return left > 0.0


def within(step: str) -> None:
    """Tell which step of the stage begins, with the work that is done if that is known."""
    LOGGER.debug(step, extra={"within": True})


ENDLESS = TimeLimit()
