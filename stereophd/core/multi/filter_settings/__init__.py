"""Kinds of filter for many objects: one module each, found by its name, the word of ``filter.kind``.

A module holds the settings of its filter (`SETTINGS`); the filter of the same word is `multi/WORD/filter.py`. `common`
holds what all of them share.
"""

from collections.abc import Mapping

from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.settings import members


def filters() -> Mapping[str, type[FilterSettings]]:
    """Return the settings of every kind of filter by its name."""
    return members(__name__)
