"""How much the memory of this machine holds."""

from __future__ import annotations

import os

# Assumed where the system does not report it, bytes.
DEFAULT_MEMORY = 4e9


def machine_memory() -> float:
    """Return the memory of the machine, bytes."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return DEFAULT_MEMORY
