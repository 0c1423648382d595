"""Where messages go, and how they and reports write counts and shares."""

import logging

#: The logger of every message about a run that goes on; errors end one.
LOGGER = logging.getLogger("stereophd")


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, whose plural has an s: ``1 run``, ``2 runs``."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def percent(share: float) -> str:
    """Return a share in per cent, with a space before the sign."""
    return f"{100.0 * share:.0f} %"
