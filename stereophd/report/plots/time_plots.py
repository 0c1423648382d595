"""OSPA and cardinality over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.report.style import BLUE, GREY, INK, ORANGE, Pictures, bracketed, legend_right, new_figure, unit_text

# More than this cannot be distinguished on a page, and makes the files large.
MOST_SCANS_DRAWN = 1500

# A run with at most this many scans gets a dot for every scan.
MOST_SCANS_MARKED = 150

# A largest value of this many times the median is a spike, if there are at least this many values.
SPIKE = 10.0
LEAST_FOR_LOG = 5

# An interval this many times the usual one between scans is a gap: scans in it were not scored.
GAP_STEPS = 10


def draw_ospa(pictures: Pictures) -> Figure:
    """Draw OSPA over time, and below it its two parts."""
    columns = pictures.columns
    unit = unit_text(pictures) if pictures.base == "euclidean" else ""
    figure, (whole, parts) = _time_axes(2)
    bins = _bins(columns["time_s"])
    if bins.count.max() > 1:
        low, high = bins.least(columns["ospa"]), bins.most(columns["ospa"])
        whole.fill_between(bins.time_s, low, high, color=GREY, alpha=0.3, linewidth=0, label="least to most")
    mean = float(columns["ospa"].mean())
    whole.plot(bins.time_s, bins.mean(columns["ospa"]), color=INK, linewidth=1.4, label="OSPA", **bins.style)
    whole.axhline(mean, color=INK, linewidth=1, linestyle=(0, (4, 3)), label=f"mean {mean:.3g}{unit}")
    for name, label, colour in (
        ("ospa_cardinality", "cardinality part", ORANGE),
        ("ospa_localisation", "localisation part", BLUE),
    ):
        parts.plot(bins.time_s, bins.mean(columns[name]), color=colour, linewidth=1.4, label=label, **bins.style)
    for axes, names in ((whole, ("ospa",)), (parts, ("ospa_cardinality", "ospa_localisation"))):
        _set_scale(axes, np.concatenate([columns[name] for name in names]))
        legend_right(axes)
    figure.supylabel(f"OSPA{bracketed(unit)}", fontsize=10, color=INK)
    base = "" if pictures.base == "euclidean" else ", Mahalanobis"
    whole.set_title(f"OSPA over time  (p = {pictures.order:g}, c = {pictures.cutoff:g}{unit}{base})")
    return figure


def _set_scale(axes: Axes, values: Array) -> None:
    """Choose a logarithmic scale where spikes would hide the rest, which then begins below most of the values."""
    positive = values[values > 0.0]
    if len(positive) < LEAST_FOR_LOG or positive.max() < SPIKE * np.median(positive):
        axes.set_ylim(bottom=0)
        return
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.7 * float(np.quantile(positive, 0.005)), top=1.4 * float(positive.max()))


def draw_cardinality(pictures: Pictures) -> Figure:
    """Draw the number of true objects and of estimates over time."""
    columns = pictures.columns
    figure, (axes,) = _time_axes(1)
    bins = _bins(columns["time_s"])
    if bins.count.max() > 1:
        low, high = bins.least(columns["n_estimates"]), bins.most(columns["n_estimates"])
        axes.fill_between(
            bins.time_s, low, high, step="mid", color=BLUE, alpha=0.15, linewidth=0, label="least to most"
        )
    for name, label, colour, width in (("n_truth", "truth", INK, 3.2), ("n_estimates", "estimates", BLUE, 1.4)):
        axes.plot(
            bins.time_s,
            bins.mean(columns[name]),
            color=colour,
            linewidth=width,
            label=label,
            drawstyle="steps-mid",
            **bins.style,
        )
    axes.set_ylim(0, max(float(columns[name].max()) for name in ("n_truth", "n_estimates")) + 1)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylabel("number of objects")
    axes.set_title("Cardinality over time")
    legend_right(axes)
    return figure


def _time_axes(rows: int) -> tuple[Figure, Sequence[Axes]]:
    figure = new_figure(8.5, 1.6 + 1.7 * rows)
    axes = figure.subplots(rows, sharex=True, squeeze=False)[:, 0]
    axes[-1].set_xlabel("time [s]")
    axes[-1].margins(x=0.01)
    return figure, list(axes)


@dataclass(frozen=True)
class _Bins:
    """Neighbouring scans that are drawn as one point; a short run has one point per scan."""

    start: Integers  # (b,) array: First scan of each bin
    count: Integers  # (b,) array: Its number of scans
    gap: Integers  # (g,) array: Bins before which nothing was scored for a while: lines break there
    time_s: Array  # Mean times, NaN at the breaks

    def mean(self, values: NDArray[Any]) -> Array:
        """Return the mean of each bin, as it is drawn over `time_s`."""
        return self._broken(np.add.reduceat(values, self.start) / self.count)

    def least(self, values: NDArray[Any]) -> Array:
        """Return the least value of each bin."""
        return self._broken(np.minimum.reduceat(values, self.start))

    def most(self, values: NDArray[Any]) -> Array:
        """Return the greatest value of each bin."""
        return self._broken(np.maximum.reduceat(values, self.start))

    def _broken(self, values: NDArray[Any]) -> Array:
        return np.insert(values.astype(np.float64), self.gap, np.nan)

    @property
    def style(self) -> dict[str, Any]:
        """Points that lines alone would not show: between two gaps, or the only one."""
        return {"marker": "."} if len(self.start) <= MOST_SCANS_MARKED else {}


def _bins(time_s: Array) -> _Bins:
    scans = len(time_s)
    step = np.diff(time_s)
    gaps = np.flatnonzero(step > GAP_STEPS * np.median(step)) + 1 if scans > 1 else np.zeros(0, dtype=int)
    drawn = min(scans, MOST_SCANS_DRAWN)
    # Bins of equally many scans, cut where there are gaps.
    start = np.union1d(np.arange(drawn) * scans // drawn, gaps).astype(np.int64)
    count = np.diff(np.append(start, scans))
    gap = np.searchsorted(start, gaps).astype(np.int64)
    return _Bins(start, count, gap, np.insert(np.add.reduceat(time_s, start) / count, gap, np.nan))
