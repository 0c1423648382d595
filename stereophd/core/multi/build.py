"""From settings to the filter: the module that they name (``multi/WORD/filter.py``) has it as ``FILTER``.

Settings are read without compiled code, so that they do not know their filters.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from stereophd.core.disparity.events import Rig
from stereophd.core.motion.base import Motion
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.numerics.samples import SampleSets


def make_filter(
    settings: FilterSettings, rig: Rig, motion: Motion, sets: SampleSets, threads: int = 1
) -> DisparityFilter:
    """Return the filter of these settings.

    Parameters
    ----------
    settings : FilterSettings
        Their `filter_module` has the filter.
    rig : Rig
    motion : Motion
    sets : SampleSets
        Samples that carry Gaussians between disparity spaces.
    threads : int
        Threads that carry them; the estimates do not depend on it.
    """
    module: Any = import_module(settings.filter_module)
    built: DisparityFilter = module.FILTER(rig, motion, sets, settings, threads)
    return built
