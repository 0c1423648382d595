"""Where messages go, and how they and reports write counts, numbers and shares."""

import logging
import math
from collections.abc import Callable

#: The logger of every message about a run that goes on; errors end one.
LOGGER = logging.getLogger("stereophd")

#: The logger of what a run does now; its messages, stages and steps within them, become a line now and then.
PROGRESS = logging.getLogger("stereophd.progress")


class Stages(logging.Handler):
    """Shows each stage of `PROGRESS`, and the steps within one behind its name."""

    def __init__(self, show: Callable[[str], None]) -> None:
        super().__init__()
        self._show, self._stage = show, ""

    def emit(self, record: logging.LogRecord) -> None:
        """Show a message."""
        text = record.getMessage()
        if not vars(record).get("within"):
            self._stage = text
        self._show(text if self._stage == text else f"{self._stage}: {text}")


# Numbers from here on are written with powers of ten.
LARGEST_PLAIN = 1e7


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, whose plural has an s: ``1 run``, ``2 runs``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with `digits` significant digits, without powers of ten for usual sizes."""
    if value is None:
        return "-"
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in text and abs(value) < LARGEST_PLAIN else text


def instant(time_s: float, digits: int = 6) -> str:
    """Return a time of a log, s, with `digits`, or as many as show the millisecond: of times since 1970 too."""
    before = math.floor(math.log10(max(abs(time_s), 1.0))) if math.isfinite(time_s) else 0
    return f"{time_s:.{max(digits, before + 4)}g}"


def span(low: float, high: float, digits: int = 4) -> str:
    """Return a range of numbers, or one number where both look alike: ``1.1 to 1.8``, ``2.14``."""
    return " to ".join(dict.fromkeys((number(low, digits), number(high, digits))))


def percent(share: float) -> str:
    """Return a share in per cent, with a space before the sign."""
    return f"{100.0 * share:.0f} %"


def shown_unit(unit: str, length: str = "length") -> tuple[float, str]:
    """Return the factor from a unit of an unknown to the one that readers see, degrees for angles, and its name."""
    name = unit.replace("length", length)
    return (math.degrees(1.0), f"deg{name[3:]}") if unit.startswith("rad") else (1.0, name)
