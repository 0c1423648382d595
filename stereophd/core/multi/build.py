"""From settings to the filter: the module of their word (``multi/WORD/filter.py``) has it as ``FILTER``.

Of a plug-in it is the module ``filter`` inside the package that holds the settings. Settings are read without compiled
code, so that they do not know their filters.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from stereophd.core.disparity.events import Rig
from stereophd.core.motion.base import Motion
from stereophd.core.multi.base import DisparityFilter
from stereophd.core.multi.filter_settings.common import FilterSettings
from stereophd.core.numerics.samples import SampleSets
from stereophd.plugins import module_names

SETTINGS = "stereophd.core.multi.filter_settings"


def make_filter(
    settings: FilterSettings, rig: Rig, motion: Motion, sets: SampleSets, threads: int = 1
) -> DisparityFilter:
    """Return the filter that the `kind` of the settings names.

    `sets` hold the samples that carry Gaussians between disparity spaces. The threads share this work; the estimates do
    not depend on their number.
    """
    home = module_names(SETTINGS)[settings.kind]
    home = home.replace(SETTINGS, "stereophd.core.multi", 1) if home.startswith(f"{SETTINGS}.") else home
    module: Any = import_module(f"{home}.filter")
    built: DisparityFilter = module.FILTER(rig, motion, sets, settings, threads)
    return built
