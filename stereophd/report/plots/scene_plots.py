"""Plots of an evaluation: its scores over time; truth, estimates and cameras from above and from the side.

Needs the extra ``plot``. The same data give the same files: no dates, fixed identifiers in the SVG.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.scans import UNLABELLED
from stereophd.core.metrics.truth.interpolation import Truth, in_window
from stereophd.pipeline.evaluation.scoring import Scored
from stereophd.report import style
from stereophd.report.plots.views import SceneView, field_of_view, limits, viewing_depth, views

# More than this cannot be distinguished on a page, and makes the files large.
MOST_SCANS_DRAWN = 1500

# A run with at most this many scans gets a dot for every scan.
MOST_SCANS_MARKED = 150

# A largest value of this many times the median is a spike, if there are at least this many values.
SPIKE = 10.0
LEAST_FOR_LOG = 5

# An interval this many times the usual one between scans is a gap: scans in it were not scored.
GAP_STEPS = 10


@dataclass(frozen=True)
class Pictures:
    """What is drawn of an evaluation."""

    report: Mapping[str, Any]  # As `stereophd.commands.evaluate.evaluate` returns it
    scored: Scored
    truth: Truth  # All rows; those at scored times are drawn
    cameras: Sequence[Camera] = ()

    @property
    def unit(self) -> str:
        """The unit of length as it follows a number, empty if it is not known."""
        return f" {self.report['length_unit']}" if self.report["length_unit"] else ""

    def mostly_unmatched(self, part: str, identity: str, count: str) -> Integers:
        """Return the identities in a table of the report of which less than half of the rows are matched."""
        rows = self.report[part]["table"] or ()
        return np.array([row[identity] for row in rows if 2 * row["matched"] < row[count]], dtype=np.int64)


def draw_ospa(pictures: Pictures) -> Figure:
    """Draw OSPA over time, and below it its two parts."""
    columns, ospa = pictures.scored.columns, pictures.report["ospa"]
    unit = pictures.unit if ospa["base"] == "euclidean" else ""
    figure, (whole, parts) = _time_axes(2)
    bins = _bins(columns["time_s"])
    bins.fill_range(whole, columns["ospa"], color=style.GREY, alpha=0.3)
    mean = float(columns["ospa"].mean())
    whole.plot(bins.time_s, bins.mean(columns["ospa"]), color=style.INK, linewidth=1.4, label="OSPA", **bins.style)
    whole.axhline(mean, color=style.INK, linewidth=1, linestyle=(0, (4, 3)), label=f"mean {mean:.3g}{unit}")
    for name, label, colour in (
        ("ospa_cardinality", "cardinality part", style.ORANGE),
        ("ospa_localisation", "localisation part", style.BLUE),
    ):
        parts.plot(bins.time_s, bins.mean(columns[name]), color=colour, linewidth=1.4, label=label, **bins.style)
    for axes, names in ((whole, ("ospa",)), (parts, ("ospa_cardinality", "ospa_localisation"))):
        _set_scale(axes, np.concatenate([columns[name] for name in names]))
        style.legend_right(axes)
    figure.supylabel(f"OSPA{style.bracketed(unit)}", fontsize=10, color=style.INK)
    base = "" if ospa["base"] == "euclidean" else ", Mahalanobis"
    whole.set_title(f"OSPA over time  (p = {ospa['order']:g}, c = {ospa['cutoff']:g}{unit}{base})")
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
    columns = pictures.scored.columns
    figure, (axes,) = _time_axes(1)
    bins = _bins(columns["time_s"])
    bins.fill_range(axes, columns["n_estimates"], step="mid", color=style.BLUE, alpha=0.15)
    for name, label, colour, width in (
        ("n_truth", "truth", style.INK, 3.2),
        ("n_estimates", "estimates", style.BLUE, 1.4),
    ):
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
    style.legend_right(axes)
    return figure


def _time_axes(rows: int) -> tuple[Figure, Sequence[Axes]]:
    figure = style.new_figure(8.5, 1.6 + 1.7 * rows)
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

    def fill_range(self, axes: Axes, values: NDArray[Any], **options: Any) -> None:
        """Fill the range from the least to the greatest value of each bin, where bins hold several scans."""
        if self.count.max() > 1:
            low, high = (self._broken(of.reduceat(values, self.start)) for of in (np.minimum, np.maximum))
            axes.fill_between(self.time_s, low, high, linewidth=0, label="least to most", **options)

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


# Crosses on false tracks.
MOST_CROSSES = 40

# More than this cannot be distinguished on a page, and makes the files large.
MOST_POINTS_DRAWN = 20_000


def write_plots(pictures: Pictures, paths: Mapping[str, Path]) -> None:
    """Draw the plots ``ospa``, ``cardinality``, ``top`` and ``side`` as the files that `paths` names: png or svg."""
    with mpl.rc_context(style.STYLE):
        over_time = {"ospa": draw_ospa(pictures), "cardinality": draw_cardinality(pictures)}
        style.save_figures({**over_time, **draw_views(pictures)}, paths)


def draw_views(pictures: Pictures) -> dict[str, Figure]:
    """Draw truth, estimates and cameras from above (``top``) and from the side (``side``)."""
    time = pictures.scored.columns["time_s"]
    rows = in_window(pictures.truth.time_s, float(time[0]), float(time[-1]))
    points = pictures.truth.position[rows]
    cameras = [camera.at(float(time[0])) for camera in pictures.cameras]
    scene = np.concatenate([points, *(camera.pose.center[None] for camera in cameras)])
    figures = {}
    for name, view in views(cameras, scene).items():
        figures[name], axes = view_axes(view, scene, style.bracketed(pictures.unit))
        draw_camera_views(axes, cameras, points, view)
        _draw_estimates(axes, pictures, view, scene)
        _draw_truth(axes, pictures, view, rows)
        style.legend_right(axes, ("truth", "start", "estimates", "false", "cameras"))
    return figures


def view_axes(view: SceneView, scene: Array, unit: str) -> tuple[Figure, Axes]:
    """Return a figure with axes for a view of a scene (n, 3), to scale; `unit` follows the names of the axes."""
    across, along = limits(view.project(scene))
    width, height = across[1] - across[0], along[1] - along[0]
    scale = min(8.0 / width, 6.5 / height)
    # Space for labels and for the legend next to the axes.
    figure = style.new_figure(scale * width + 3.6, scale * height + 1.1)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlim(across)
    axes.set_ylim(along[::-1] if view.inverted else along)
    names = "xyz"
    axes.set_xlabel(f"{names[view.horizontal]}{unit}")
    axes.set_ylabel(f"{names[view.vertical]}{unit}{' (down)' if view.inverted else ''}")
    axes.set_title(view.title)
    return figure, axes


def draw_camera_views(axes: Axes, cameras: Sequence[Camera], points: Array, view: SceneView) -> None:
    """Draw cameras and what they see, past the farthest of the points (n, 3); the axes keep their limits."""
    across, along = axes.get_xlim(), axes.get_ylim()
    axes.autoscale(False)
    for camera in cameras:
        if (depth := viewing_depth(camera, points)) > 0:
            outline = field_of_view(camera, depth, view)
            axes.fill(*outline.T, facecolor=style.CAMERA_COLOUR, alpha=0.07, linewidth=0, zorder=1)
            axes.fill(*outline.T, fill=False, edgecolor=style.CAMERA_COLOUR, alpha=0.35, linewidth=0.8, zorder=1)
    _draw_cameras(axes, cameras, view, 0.03 * max(abs(across[1] - across[0]), abs(along[1] - along[0])))


def _draw_cameras(axes: Axes, cameras: Sequence[Camera], view: SceneView, near: float) -> None:
    """Draw the centres; cameras that are drawn in the same place share one line of names."""
    places: list[tuple[Array, list[str]]] = []
    for camera in cameras:
        center = view.project(camera.pose.center[None])[0]
        names = next((names for place, names in places if np.hypot(*(place - center)) < near), None)
        if names is None:
            places.append((center, [camera.name]))
        else:
            names.append(camera.name)
    for place, names in places:
        axes.annotate(
            ", ".join(names),
            (float(place[0]), float(place[1])),
            (0, -15),
            textcoords="offset points",
            ha="center",
            color=style.CAMERA_COLOUR,
            fontsize=9,
            zorder=6,
        )
    if places:
        centers = np.array([view.project(camera.pose.center[None])[0] for camera in cameras])
        axes.plot(
            *centers.T,
            marker="s",
            markersize=6,
            color=style.CAMERA_COLOUR,
            linestyle="none",
            zorder=5,
            label="cameras, views",
        )


def _draw_estimates(axes: Axes, pictures: Pictures, view: SceneView, scene: Array) -> None:
    """Draw the estimates that lie within the limits of a scene (n, 3), and state how many do not."""
    estimates = pictures.scored.estimates
    drawn = view.project(estimates.position)
    low, high = np.stack(limits(view.project(scene)), axis=1)
    inside = np.asarray(((drawn >= low) & (drawn <= high)).all(axis=1))
    rows = np.flatnonzero(inside)
    rows = rows[:: max(1, -(-len(rows) // MOST_POINTS_DRAWN))]
    labels = estimates.label[rows]
    labelled = bool((labels > UNLABELLED).any())
    # numbered in order of size, so that neighbouring tracks differ in colour
    ranks = np.unique(labels, return_inverse=True)[1] if labelled else np.zeros(len(rows), dtype=np.int64)
    colours = (
        np.array(style.TRACK_COLOURS)[ranks % len(style.TRACK_COLOURS)] if labelled else np.full(len(rows), style.BLUE)
    )
    rounds = ranks // len(style.TRACK_COLOURS) % len(style.TRACK_MARKERS)
    for number in np.unique(rounds).tolist():
        own = rounds == number
        # Thousands of points make a vector file slow to open: they are an image inside it.
        axes.scatter(
            drawn[rows[own], 0], drawn[rows[own], 1], s=9 if number == 0 else 14, c=colours[own],
            marker=style.TRACK_MARKERS[number],
            linewidths=0, zorder=3, rasterized=True,
        )  # fmt: skip
    false = rows[np.isin(labels, pictures.mostly_unmatched("purity", "track_id", "estimates"))]
    if len(false):
        # some estimates of each false track
        false = false[:: max(1, len(false) // MOST_CROSSES)]
        axes.plot(*drawn[false].T, "x", color=style.WRONG, markersize=7, zorder=5, label="false tracks")
    hidden = int(len(inside) - inside.sum())
    name = "estimates" + (",\na colour for each track" if labelled else "")
    name += " and\na mark for each round of colours" if rounds.any() else ""
    name += f",\n{hidden} outside the picture" if hidden else ""
    axes.plot([], [], marker="o", markersize=4, color=style.TRACK_COLOURS[0], linestyle="none", label=name)


def _draw_truth(axes: Axes, pictures: Pictures, view: SceneView, rows: Any) -> None:
    """Draw the true paths as lines that break at gaps, with a ring where each begins."""
    truth, gap_s = pictures.truth, pictures.report["max_gap_s"]
    gap_s = np.inf if gap_s is None else gap_s
    time, label, points = truth.time_s[rows], truth.object_id[rows], view.project(truth.position[rows])
    first = np.append(True, np.diff(label) != 0)[: len(label)]
    step = max(1, len(label) // MOST_POINTS_DRAWN)
    keep = first | np.append(first[1:], True)[: len(label)] | (np.arange(len(label)) % step == 0)
    breaks = first | np.append(False, np.diff(time) > gap_s + 1e-9)[: len(label)]
    keep |= breaks
    cuts = np.flatnonzero(breaks[keep])
    path = np.insert(points[keep], cuts, np.nan, axis=0)
    axes.plot(*path.T, color=style.INK, linewidth=1.1, alpha=0.85, zorder=4, label="truth")
    missed = np.isin(np.insert(label[keep], cuts, -1), pictures.mostly_unmatched("completeness", "object_id", "scans"))
    if missed.any():
        lost = np.where(missed[:, None], path, np.nan)
        axes.plot(*lost.T, color=style.WRONG, linewidth=3.5, alpha=0.5, zorder=3.5, label="missed objects")
    axes.plot(
        *points[first].T,
        marker="o",
        markersize=5,
        markerfacecolor="white",
        markeredgecolor=style.INK,
        linestyle="none",
        zorder=4.5,
        label="start of a path",
    )
