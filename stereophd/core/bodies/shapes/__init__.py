"""Shapes of objects: one module each, found by its name, the word of ``object.shape``.

A module holds the settings of its shape (`SETTINGS`).
"""

from collections.abc import Mapping
from typing import Any

from stereophd.core.settings import members

# The shape of a configuration that names none.
DEFAULT = "point"


def shapes() -> Mapping[str, Any]:
    """Return the settings of every shape by its word."""
    return members(__name__)
