"""Plots of an evaluation: OSPA and cardinality over time, the scene from above and from the side.

Needs the extra ``plot``. The same data give the same files: no dates, fixed identifiers in the SVG.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl

from stereophd.report.plots.scene_plots import draw_views
from stereophd.report.plots.time_plots import draw_cardinality, draw_ospa
from stereophd.report.style import STYLE, Pictures

__all__ = ["Pictures", "write_plots"]


def write_plots(pictures: Pictures, paths: Mapping[str, Path]) -> None:
    """Draw all plots: ``ospa``, ``cardinality``, ``top``, ``side``, each as ``png`` and ``svg``.

    `paths` says where each goes: name such as ``ospa.svg`` -> path.
    """
    with mpl.rc_context(STYLE):
        figures = {
            "ospa": draw_ospa(pictures),
            "cardinality": draw_cardinality(pictures),
            **draw_views(pictures),
        }
        for name, path in paths.items():
            plot, kind = name.rsplit(".", 1)
            # Metadata of the files (date, program) would differ between runs.
            metadata: dict[str, Any] = {"Date": None} if kind == "svg" else {"Software": None}
            figures[plot].savefig(path, format=kind, metadata=metadata, bbox_inches="tight", pad_inches=0.15)
