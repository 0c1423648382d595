"""The figure of an experiment of kind move: the Gaussians of the methods over that of the reference.

Needs the extra ``plot``.
"""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stereophd.core.arrays import Array
from stereophd.experiments.engine.results import Cell, Results
from stereophd.report.style import INK, TRACK_COLOURS, legend_right

# The planes of the paper's Figures 4 and 7.
PLANES = (("u", "v"), ("v", "d"))

# Ellipses are drawn at this many standard deviations.
SIGMAS = 2.0
POINTS = 181


def draw_moves(results: Results) -> Figure:
    """Draw the Gaussian of each method (its moments' means over the runs) in two planes, one row per case."""
    cases = list(dict.fromkeys(cell.case for cell in results.cells))
    figure = Figure(figsize=(10.5, 0.9 + 3.2 * len(cases)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(cases), len(PLANES), squeeze=False)
    for row, case in enumerate(cases):
        cells = [cell for cell in results.cells if cell.case == case]
        for axes, plane in zip(grid[row], PLANES, strict=True):
            for number, cell in enumerate(cells):
                colour = TRACK_COLOURS[number % len(TRACK_COLOURS)]
                label = f"{cell.method} ({_value(cell, 'divergence', 'mean'):.2g} nat)"
                axes.plot(*_ellipse(cell, plane, "mean"), color=colour, linewidth=1.4, label=label)
            axes.plot(*_ellipse(cells[0], plane, "bound"), color=INK, linewidth=1.8, linestyle=":", label="reference")
            axes.set_xlabel(f"{plane[0]} [px]")
            axes.set_ylabel(f"{plane[1]} [px]")
            if len(cases) > 1:
                axes.set_title(case, fontsize=10)
        legend_right(grid[row, -1])
    return figure


def _value(cell: Cell, quantity: str, statistic: str) -> float:
    summary = next(summary for summary in cell.summaries if summary.quantity == quantity)
    return float(getattr(summary, statistic)[0])


def _ellipse(cell: Cell, plane: tuple[str, str], statistic: str) -> Array:
    """Return the points (2, n) of the ellipse at `SIGMAS` in a plane."""
    first, second = plane
    mean = np.array([_value(cell, f"mean_{axis}", statistic) for axis in plane])
    pairs = (first + first, first + second, second + second)
    xx, xy, yy = (_value(cell, f"covariance_{pair}", statistic) for pair in pairs)
    covariance = np.array([[xx, xy], [xy, yy]])
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(mean[:, None] + SIGMAS * (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle)
