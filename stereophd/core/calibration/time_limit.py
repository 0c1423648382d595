"""The stages of a calibration, and the time that it may take: every long step begins with `TimeLimit.begin`."""

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

Item = TypeVar("Item")

# Its messages, of level INFO, name the stage that begins.
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
        LOGGER.info("%s%s", stage, f" ({max(left, 0.0):.0f} s left)" if math.isfinite(left) else "")
        return left > 0.0


ENDLESS = TimeLimit()


def told(items: Sequence[Item], tell: Callable[[str], object], noun: str) -> Iterator[Item]:
    """Yield some items, and tell before each of them that it begins: ``NOUN 3 of 40``."""
    for number, item in enumerate(items, 1):
        tell(f"{noun} {number} of {len(items)}")
        yield item
