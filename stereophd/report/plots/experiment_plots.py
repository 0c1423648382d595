"""The figure of an experiment: one panel per quantity, one line per method, with confidence bands and the bound.

Of an experiment of kind move it shows the Gaussians of the methods over that of the reference.
Needs the extra ``plot``. The same results give the same files.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from stereophd.core.arrays import Array
from stereophd.experiments.engine.results import STATISTICS, Results
from stereophd.experiments.engine.summary import Summary
from stereophd.report.style import INK, STYLE, colour_of, dash_of, legend_right, new_figure, plots_named, save_figures
from stereophd.wording import counted

BOUND_LABEL = "bound"
DASHES = (0, (4, 3))

MARKERS = ("o", "s", "^", "D", "v", "P", "X")

# Small files that are still sharp enough for a page.
DPI = 100

# Decades of a logarithmic scale up to which some, and all, of the numbers between its powers are written.
MINOR_LABELS = (2.0, 0.5)

# Ratios to the bound beyond this are drawn on a logarithmic scale.
LARGEST_LINEAR_RATIO = 5.0

# Points of one case that stand side by side, as a share of the distance between cases.
SPREAD = 0.6

# The planes of the paper's Figures 4 and 7.
PLANES = (("u", "v"), ("v", "d"))

# Ellipses are drawn at this many standard deviations.
SIGMAS = 2.0
POINTS = 181


# Of each method: values along the axis of the figure (k,), and a summary of as many.
Lines = Mapping[str, tuple[Array, Summary]]


class _PlainNumbers(LogFormatter):
    """Labels the ticks that its base class chooses, without powers of ten."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def write_figure(results: Results, paths: Mapping[str, Path]) -> None:
    """Draw the figure of an experiment, once for each name that ends in ``.png`` or ``.svg`` (-> where to write)."""
    with mpl.rc_context(STYLE):
        moved = results.config.scenario.kind == "move"
        figure = _draw_moves(results) if moved else _draw(results)
        if title := results.config.figure.title:
            text = f"{title}: {counted(results.config.runs, 'run')}{'' if moved else ', 95 % intervals'}"
            figure.suptitle(text, x=0.01, ha="left", fontsize=11.5, fontweight="bold", color=INK)
        save_figures(dict.fromkeys(plots_named(paths), figure), paths, dpi=DPI)


def _draw(results: Results) -> Figure:
    settings = results.config.figure
    quantities = _quantities(results)
    varies = any(each.times_s is not None for each in results.summaries if each.quantity in quantities)
    over = settings.over or (None if varies else next(iter(results.config.cases), None))
    unit_of_axis = "" if over is None else results.config.cases[over].unit
    groups = _groups(results, over)
    panels = [(quantity, ratio) for quantity in quantities for ratio in _kinds_of_panel(results, quantity, over)]
    shape = (len(panels), len(groups))
    width = 1.8 + 4.4 * shape[1] + (2.2 if shape[1] == 1 else 0.0)
    figure = new_figure(width, 0.9 + 2.3 * shape[0])
    grid = figure.subplots(*shape, sharex="col", sharey="row", squeeze=False)
    for row, (quantity, ratio) in enumerate(panels):
        for column, (group, summaries) in enumerate(groups.items()):
            axes = grid[row, column]
            unit = _panel(axes, results, [each for each in summaries if each.quantity == quantity], over, ratio)
            if column == 0:
                bracketed = f" [{unit}]" if unit not in ("", "1") else ""
                words = re.sub(r"_([pc])(?=\d)", r", \1 ", quantity).replace("_", " ").replace("center", "centre")
                words = re.sub("ospa|rmse|nees", lambda short: short[0].upper(), words)
                axes.set_ylabel("ratio to the bound" if ratio else words + bracketed)
            if row == 0 and group:
                axes.set_title(group, fontsize=10)
            if row == shape[0] - 1:
                axes.set_xlabel("time [s]" if over is None else over + (f" [{unit_of_axis}]" if unit_of_axis else ""))
        legend = grid[row, -1]
        if row == 0:
            legend_right(legend)
    return figure


def _quantities(results: Results) -> list[str]:
    if results.config.figure.quantities is not None:
        return list(results.config.figure.quantities)
    varying = [summary.quantity for summary in results.summaries if summary.times_s is not None]
    return list(dict.fromkeys(varying or [summary.quantity for summary in results.summaries]))


def _groups(results: Results, over: str | None) -> dict[str, list[Summary]]:
    """Return the summaries of every column of panels: cases that differ along an axis that the figure does not show."""
    axes = list(results.config.cases)
    groups: dict[str, list[Summary]] = {}
    for summary in results.summaries:
        others = [f"{axis} {name}" for axis, name in zip(axes, summary.settings, strict=True) if axis != over]
        groups.setdefault(", ".join(others), []).append(summary)
    return groups


def _kinds_of_panel(results: Results, quantity: str, over: str | None) -> tuple[bool, ...]:
    """Return whether panels of a quantity show it, or its ratio to the bound: both in a sweep with a bound."""
    if over is None or _numbers(results, over) is None:
        return (False,)
    summaries = [each for each in results.summaries if each.quantity == quantity and each.times_s is None]
    known = any(np.isfinite(summary.bound).any() for summary in summaries)
    return (False, True) if known else (False,)


def _draw_ratios(axes: Axes, lines: Lines) -> None:
    """Draw what the methods reach as multiples of the bound."""
    ratios = {}
    for method, (x, line) in lines.items():
        values: dict[str, Any] = {name: getattr(line, name) / line.bound for name in STATISTICS}
        ratios[method] = x, replace(line, **values)
    _draw_curves(axes, ratios, marked=True)
    if np.nanmax(np.concatenate([line.mean for _, line in ratios.values()])) > LARGEST_LINEAR_RATIO:
        _set_logarithmic(axes)


def _set_logarithmic(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(_PlainNumbers())
    axes.yaxis.set_minor_formatter(_PlainNumbers(minor_thresholds=MINOR_LABELS))


def _panel(axes: Axes, results: Results, summaries: Sequence[Summary], over: str | None, ratio: bool = False) -> str:
    """Draw one panel, of a quantity or of its ratio to the bound, and return the unit of the quantity."""
    unit = summaries[0].unit if summaries else ""
    if over is None:
        lines: Lines = {each.method: (each.times_s, each) for each in summaries if each.times_s is not None}
        _draw_curves(axes, lines)
    else:
        numbers = _numbers(results, over)
        lines = _lines_over(results, summaries, over)
        if ratio:
            _draw_ratios(axes, lines)
            return unit
        if numbers is None:
            _draw_points(axes, lines, [name for name, _ in results.config.cases[over].points()])
        else:
            _draw_curves(axes, lines, marked=True)
    settings = results.config.figure
    if settings.log:
        _set_logarithmic(axes)
    elif all((line.mean[np.isfinite(line.mean)] >= 0).all() for _, line in lines.values()):
        axes.set_ylim(bottom=0)
    if settings.most is not None:
        axes.set_ylim(top=settings.most)
    return unit


def _numbers(results: Results, over: str) -> Array | None:
    """Return the values of an axis as numbers, None if they are not."""
    values = results.config.cases[over].values
    if values is None or not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values):
        return None
    return np.array(values, dtype=float)


def _lines_over(results: Results, summaries: Sequence[Summary], over: str) -> Lines:
    """Return one line per method along an axis of the cases."""
    position = list(results.config.cases).index(over)
    places = {name: i for i, (name, _) in enumerate(results.config.cases[over].points())}
    numbers = _numbers(results, over)
    by_method: dict[str, list[tuple[float, Summary]]] = {}
    for summary in summaries:
        place = places[summary.settings[position]]
        if summary.times_s is None:
            x = float(place) if numbers is None else float(numbers[place])
            by_method.setdefault(summary.method, []).append((x, summary))
    lines = {}
    for method, points in by_method.items():
        values: dict[str, Any] = {name: np.array([getattr(of, name)[0] for _, of in points]) for name in STATISTICS}
        lines[method] = np.array([x for x, _ in points]), replace(points[0][1], **values)
    return lines


def _draw_curves(axes: Axes, lines: Lines, marked: bool = False) -> None:
    for number, (method, (x, line)) in enumerate(lines.items()):
        colour, marker = colour_of(number), MARKERS[number % len(MARKERS)] if marked else None
        axes.fill_between(x, line.ci_low, line.ci_high, color=colour, alpha=0.2, linewidth=0)
        axes.plot(
            x,
            line.mean,
            color=colour,
            linewidth=1.4,
            linestyle=dash_of(number),
            label=method,
            marker=marker,
            markersize=4,
        )
    for x, line in [(x, line) for x, line in lines.values() if np.isfinite(line.bound).any()][:1]:
        axes.plot(x, line.bound, color=INK, linewidth=1.2, linestyle=DASHES, label=BOUND_LABEL)
    axes.margins(x=0.02)


def _draw_points(axes: Axes, lines: Lines, names: Sequence[str]) -> None:
    """Draw methods side by side at each case, and the bound across them."""
    for i, (method, (x, line)) in enumerate(lines.items()):
        colour, marker = colour_of(i), MARKERS[i % len(MARKERS)]
        beside = x + SPREAD * ((i + 0.5) / len(lines) - 0.5)
        errors = np.abs(np.array([line.mean - line.ci_low, line.ci_high - line.mean]))
        axes.errorbar(
            beside, line.mean, yerr=errors, color=colour, marker=marker, markersize=5, linestyle="none", label=method
        )
    for x, line in [(x, line) for x, line in lines.values() if np.isfinite(line.bound).any()][:1]:
        half = 0.5 * SPREAD + 0.08
        axes.hlines(line.bound, x - half, x + half, color=INK, linewidth=1.2, linestyle=DASHES, label=BOUND_LABEL)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.6, len(names) - 0.4)


def _draw_moves(results: Results) -> Figure:
    """Draw the Gaussian of each method (its moments' means over the runs) in two planes, one row per case."""
    cases = list(dict.fromkeys(summary.case for summary in results.summaries))
    figure = new_figure(10.5, 0.9 + 3.2 * len(cases))
    grid = figure.subplots(len(cases), len(PLANES), squeeze=False)
    for row, case in enumerate(cases):
        methods: dict[str, dict[str, Summary]] = {}
        for summary in results.summaries:
            if summary.case == case:
                methods.setdefault(summary.method, {})[summary.quantity] = summary
        for axes, plane in zip(grid[row], PLANES, strict=True):
            for number, (method, found) in enumerate(methods.items()):
                colour = colour_of(number)
                label = f"{method} ({found['divergence'].mean[0]:.2g} nat)"
                axes.plot(*_ellipse(found, plane, "mean"), color=colour, linewidth=1.4, label=label)
            reference = _ellipse(next(iter(methods.values())), plane, "bound")
            axes.plot(*reference, color=INK, linewidth=1.8, linestyle=":", label="reference")
            axes.set_xlabel(f"{plane[0]} [px]")
            axes.set_ylabel(f"{plane[1]} [px]")
            if len(cases) > 1:
                axes.set_title(case, fontsize=10)
        legend_right(grid[row, -1])
    return figure


def _ellipse(summaries: Mapping[str, Summary], plane: tuple[str, str], statistic: str) -> Array:
    """Return the points (2, n) of the ellipse at `SIGMAS` in a plane."""
    first, second = plane
    mean = np.array([getattr(summaries[f"mean_{axis}"], statistic)[0] for axis in plane])
    pairs = (first + first, first + second, second + second)
    xx, xy, yy = (getattr(summaries[f"covariance_{pair}"], statistic)[0] for pair in pairs)
    covariance = np.array([[xx, xy], [xy, yy]])
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(mean[:, None] + SIGMAS * (vectors * np.sqrt(np.maximum(values, 0.0))) @ circle)
