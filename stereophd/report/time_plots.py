"""OSPA and cardinality over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stereophd.metrics.assignment import FloatArray, IntArray
from stereophd.report.style import BLUE, GREY, INK, ORANGE, Pictures, bracketed, legend_right, unit_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# More than this cannot be told apart on a page, and makes the files large.
MOST_SCANS_DRAWN = 1500


def draw_ospa(pictures: Pictures) -> Figure:
    """Draw OSPA over time, and below it its two parts."""
    columns = pictures.columns
    unit = unit_text(pictures) if pictures.base == "euclidean" else ""
    figure, (whole, parts) = _time_axes(2)
    time, bins = _time_bins(columns["time_s"])
    if len(time) < len(columns["time_s"]):
        whole.fill_between(time, *_bin_ranges(columns["ospa"], bins), color=GREY, alpha=0.3, linewidth=0)
    mean = float(columns["ospa"].mean())
    whole.plot(time, _bin_means(columns["ospa"], bins), color=INK, linewidth=1.4, label="OSPA")
    whole.axhline(mean, color=INK, linewidth=1, linestyle=(0, (4, 3)), label=f"mean {mean:.3g}{unit}")
    for name, label, colour in (
        ("ospa_cardinality", "cardinality part", ORANGE),
        ("ospa_localisation", "localisation part", BLUE),
    ):
        parts.plot(time, _bin_means(columns[name], bins), color=colour, linewidth=1.4, label=label)
    for axes in (whole, parts):
        axes.set_ylim(bottom=0)
        legend_right(axes)
    figure.supylabel(f"OSPA{bracketed(unit)}", fontsize=10, color=INK)
    base = "" if pictures.base == "euclidean" else ", Mahalanobis"
    whole.set_title(f"OSPA over time  (p = {pictures.order:g}, c = {pictures.cutoff:g}{unit}{base})")
    return figure


def draw_cardinality(pictures: Pictures) -> Figure:
    """Draw the number of true objects and of estimates over time."""
    columns = pictures.columns
    figure, (axes,) = _time_axes(1)
    time, bins = _time_bins(columns["time_s"])
    if len(time) < len(columns["time_s"]):
        low, high = _bin_ranges(columns["n_estimates"], bins)
        axes.fill_between(time, low, high, step="mid", color=BLUE, alpha=0.15, linewidth=0, label="least to most")
    for name, label, colour, width in (
        ("n_truth", "truth", INK, 3.2),
        ("n_estimates", "estimates", BLUE, 1.4),
    ):
        values = _bin_means(columns[name], bins)
        axes.plot(time, values, color=colour, linewidth=width, label=label, drawstyle="steps-mid")
    axes.set_ylim(0, max(float(columns[name].max()) for name in ("n_truth", "n_estimates")) + 1)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylabel("number of objects")
    axes.set_title("Cardinality over time")
    legend_right(axes)
    return figure


def _time_axes(rows: int) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(8.5, 1.6 + 1.7 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, sharex=True, squeeze=False)[:, 0]
    axes[-1].set_xlabel("time [s]")
    axes[-1].margins(x=0.01)
    return figure, list(axes)


def _time_bins(time_s: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return mean times and first scans of bins of equally many scans; each scan by itself if few."""
    count = min(len(time_s), MOST_SCANS_DRAWN)
    bins = np.arange(count, dtype=np.int64) * len(time_s) // max(count, 1)
    return _bin_means(time_s, bins), bins


def _bin_means(values: Any, bins: IntArray) -> FloatArray:
    return np.asarray(np.add.reduceat(values, bins) / np.diff(np.append(bins, len(values))))


def _bin_ranges(values: Any, bins: IntArray) -> tuple[FloatArray, FloatArray]:
    return np.minimum.reduceat(values, bins), np.maximum.reduceat(values, bins)
