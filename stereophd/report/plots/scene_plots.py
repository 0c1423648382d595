"""Plots of an evaluation: its scores over time; truth, estimates and cameras from above and from the side.

Needs the extra ``plot``. The same data give the same files: no dates, fixed identifiers in the SVG.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stereophd.core.arrays import Array, Integers
from stereophd.core.geometry.camera import Camera
from stereophd.core.metrics.scans import UNLABELLED, PointSets
from stereophd.core.metrics.truth.interpolation import in_window
from stereophd.report.plots.time_plots import draw_cardinality, draw_ospa
from stereophd.report.plots.views import SceneView, field_of_view, limits, viewing_depth, views
from stereophd.report.style import (
    BLUE,
    CAMERA_COLOUR,
    INK,
    STYLE,
    TRACK_COLOURS,
    TRACK_MARKERS,
    WRONG,
    Pictures,
    bracketed,
    legend_right,
    new_figure,
    save_figures,
    unit_text,
)

# Crosses on false tracks.
MOST_CROSSES = 40

# More than this cannot be distinguished on a page, and makes the files large.
MOST_POINTS_DRAWN = 20_000


def write_plots(pictures: Pictures, paths: Mapping[str, Path]) -> None:
    """Draw the plots ``ospa``, ``cardinality``, ``top`` and ``side`` as the files that `paths` names: png or svg."""
    with mpl.rc_context(STYLE):
        over_time = {"ospa": draw_ospa(pictures), "cardinality": draw_cardinality(pictures)}
        save_figures({**over_time, **draw_views(pictures)}, paths)


def draw_views(pictures: Pictures) -> dict[str, Figure]:
    """Draw truth, estimates and cameras from above (``top``) and from the side (``side``)."""
    time = pictures.columns["time_s"]
    rows = in_window(pictures.truth.time_s, float(time[0]), float(time[-1]))
    points = pictures.truth.position[rows]
    cameras = [camera.at(float(time[0])) for camera in pictures.cameras]
    scene = np.concatenate([points, *(camera.pose.center[None] for camera in cameras)])
    titles = {"top": "From above", "side": "From the side"}
    return {
        name: _draw_view(pictures, view, titles[name], rows, cameras, scene)
        for name, view in views(cameras, scene).items()
    }


def _draw_view(
    pictures: Pictures, view: SceneView, title: str, rows: Any, cameras: Sequence[Camera], scene: Array
) -> Figure:
    figure, axes = view_axes(view, scene, title, bracketed(unit_text(pictures)))
    draw_camera_views(axes, cameras, pictures.truth.position[rows], view)
    _draw_estimates(axes, pictures.estimates, view, *limits(view.project(scene)), pictures.false_tracks)
    _draw_truth(axes, pictures, view, rows)
    legend_right(axes, ("truth", "start", "estimates", "false", "cameras"))
    return figure


def view_axes(view: SceneView, scene: Array, title: str, unit: str) -> tuple[Figure, Axes]:
    """Return a figure with axes for a view of a scene (n, 3), to scale; `unit` follows the names of the axes."""
    across, along = limits(view.project(scene))
    width, height = across[1] - across[0], along[1] - along[0]
    scale = min(8.0 / width, 6.5 / height)
    # Space for labels and for the legend next to the axes.
    figure = new_figure(scale * width + 3.6, scale * height + 1.1)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlim(across)
    axes.set_ylim(along[::-1] if view.inverted else along)
    names = "xyz"
    axes.set_xlabel(f"{names[view.horizontal]}{unit}")
    axes.set_ylabel(f"{names[view.vertical]}{unit}{' (down)' if view.inverted else ''}")
    axes.set_title(title)
    return figure, axes


def draw_camera_views(axes: Axes, cameras: Sequence[Camera], points: Array, view: SceneView) -> None:
    """Draw cameras and what they see, past the farthest of the points (n, 3); the axes keep their limits."""
    across, along = axes.get_xlim(), axes.get_ylim()
    axes.autoscale(False)
    for camera in cameras:
        _draw_field_of_view(axes, camera, viewing_depth(camera, points), view)
    _draw_cameras(axes, cameras, view, 0.03 * max(abs(across[1] - across[0]), abs(along[1] - along[0])))


def _draw_field_of_view(axes: Axes, camera: Camera, depth: float, view: SceneView) -> None:
    if depth > 0:
        outline = field_of_view(camera, depth, view)
        axes.fill(*outline.T, facecolor=CAMERA_COLOUR, alpha=0.07, linewidth=0, zorder=1)
        axes.fill(*outline.T, fill=False, edgecolor=CAMERA_COLOUR, alpha=0.35, linewidth=0.8, zorder=1)


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
            color=CAMERA_COLOUR,
            fontsize=9,
            zorder=6,
        )
    if places:
        centers = np.array([view.project(camera.pose.center[None])[0] for camera in cameras])
        axes.plot(
            *centers.T,
            marker="s",
            markersize=6,
            color=CAMERA_COLOUR,
            linestyle="none",
            zorder=5,
            label="cameras, views",
        )


def _draw_estimates(
    axes: Axes, estimates: PointSets, view: SceneView, across: tuple[float, float], along: tuple[float, float],
    false_tracks: frozenset[int],
) -> None:  # fmt: skip
    """Draw the estimates that lie within the limits, and state how many do not."""
    drawn = view.project(estimates.position)
    low, high = np.stack([across, along], axis=1)
    inside = np.asarray(((drawn >= low) & (drawn <= high)).all(axis=1))
    rows = np.flatnonzero(inside)
    rows = rows[:: max(1, -(-len(rows) // MOST_POINTS_DRAWN))]
    labels = estimates.label[rows]
    labelled = bool((labels > UNLABELLED).any())
    # numbered in order of size, so that neighbouring tracks differ in colour
    ranks = np.unique(labels, return_inverse=True)[1] if labelled else np.zeros(len(rows), dtype=np.int64)
    colours = np.array(TRACK_COLOURS)[ranks % len(TRACK_COLOURS)] if labelled else np.full(len(rows), BLUE)
    rounds = ranks // len(TRACK_COLOURS) % len(TRACK_MARKERS)
    for number in np.unique(rounds).tolist():
        own = rounds == number
        # Thousands of points make a vector file slow to open: they are an image inside it.
        axes.scatter(
            drawn[rows[own], 0], drawn[rows[own], 1], s=9 if number == 0 else 14, c=colours[own],
            marker=TRACK_MARKERS[number],
            linewidths=0, zorder=3, rasterized=True,
        )  # fmt: skip
    _mark_false(axes, drawn[rows], labels, false_tracks)
    hidden = int(len(inside) - inside.sum())
    name = "estimates" + (",\na colour for each track" if labelled else "")
    name += " and\na mark for each round of colours" if rounds.any() else ""
    name += f",\n{hidden} outside the picture" if hidden else ""
    axes.plot([], [], marker="o", markersize=4, color=TRACK_COLOURS[0], linestyle="none", label=name)


def _mark_false(axes: Axes, points: Array, labels: Integers, false_tracks: frozenset[int]) -> None:
    """Cross out some estimates of each false track."""
    false = np.flatnonzero(np.isin(labels, np.array(sorted(false_tracks), dtype=np.int64)))
    if len(false):
        false = false[:: max(1, len(false) // MOST_CROSSES)]
        axes.plot(*points[false].T, "x", color=WRONG, markersize=7, zorder=5, label="false tracks")


def _draw_truth(axes: Axes, pictures: Pictures, view: SceneView, rows: Any) -> None:
    """Draw the true paths as lines that break at gaps, with a ring where each begins."""
    truth = pictures.truth
    time, label, points = truth.time_s[rows], truth.object_id[rows], view.project(truth.position[rows])
    first = np.append(True, np.diff(label) != 0)[: len(label)]
    step = max(1, len(label) // MOST_POINTS_DRAWN)
    keep = first | np.append(first[1:], True)[: len(label)] | (np.arange(len(label)) % step == 0)
    breaks = first | np.append(False, np.diff(time) > pictures.max_gap_s + 1e-9)[: len(label)]
    keep |= breaks
    cuts = np.flatnonzero(breaks[keep])
    path = np.insert(points[keep], cuts, np.nan, axis=0)
    axes.plot(*path.T, color=INK, linewidth=1.1, alpha=0.85, zorder=4, label="truth")
    missed = np.isin(np.insert(label[keep], cuts, -1), np.array(sorted(pictures.missed_objects), dtype=np.int64))
    if missed.any():
        lost = np.where(missed[:, None], path, np.nan)
        axes.plot(*lost.T, color=WRONG, linewidth=3.5, alpha=0.5, zorder=3.5, label="missed objects")
    axes.plot(
        *points[first].T,
        marker="o",
        markersize=5,
        markerfacecolor="white",
        markeredgecolor=INK,
        linestyle="none",
        zorder=4.5,
        label="start of a path",
    )
