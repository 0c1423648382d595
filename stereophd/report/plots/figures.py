"""Plots of an evaluation: OSPA and cardinality over time, the scene from above and from the side.

Needs the extra ``plot``. The same data give the same files: no dates, fixed identifiers in the SVG.
"""

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl

from stereophd.report.plots.scene_plots import draw_views
from stereophd.report.plots.time_plots import draw_cardinality, draw_ospa
from stereophd.report.style import STYLE, Pictures, save_figures

__all__ = ["Pictures", "write_plots"]


def write_plots(pictures: Pictures, paths: Mapping[str, Path]) -> None:
    """Draw all plots: ``ospa``, ``cardinality``, ``top``, ``side``, each as ``png`` and ``svg``.

    `paths` says where each goes: name such as ``ospa.svg`` -> path.
    """
    with mpl.rc_context(STYLE):
        over_time = {"ospa": draw_ospa(pictures), "cardinality": draw_cardinality(pictures)}
        save_figures({**over_time, **draw_views(pictures)}, paths)
