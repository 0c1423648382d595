"""Plots of a tracking run without truth: views, timelines of tracks, residuals by camera.

Needs the extra ``plot``. The same run gives the same files.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from stereophd.errors import InputError
from stereophd.pipeline.inspection.runs import Run
from stereophd.report import style
from stereophd.report.page.columns import Paths
from stereophd.report.page.frames import camera_residuals, paths_of_run
from stereophd.report.plots.scene_plots import draw_camera_views, view_axes
from stereophd.report.plots.views import views

# Points of one track, and residuals of one camera, that are drawn.
MOST_ROWS = 2000
MOST_RESIDUALS = 3000
# Tracks that are labelled.
MOST_LABELS = 60


def write_track_plots(run: Run, paths: Mapping[str, Path]) -> None:
    """Draw the plots that `paths` names: ``top``, ``side``, ``timelines`` and ``residuals``, as png or svg."""
    with mpl.rc_context(style.STYLE):
        style.save_figures({plot: draw_track_plot(run, plot) for plot in style.plots_named(paths)}, paths)


def draw_track_plot(run: Run, plot: str) -> Figure:
    """Return the plot ``top``, ``side``, ``timelines`` or ``residuals`` of a run; InputError for another name."""
    tracks = paths_of_run(run)
    makers: dict[str, Callable[[], Figure]] = {
        "top": lambda: _draw_view(run, tracks, "top"),
        "side": lambda: _draw_view(run, tracks, "side"),
        "timelines": lambda: _draw_timelines(tracks),
        "residuals": lambda: _draw_residuals(run, tracks),
    }
    if plot not in makers:
        raise InputError(f"plot: expected one of {', '.join(makers)}, found {plot}")
    with mpl.rc_context(style.STYLE):
        return makers[plot]()


def _draw_view(run: Run, tracks: Paths, name: str) -> Figure:
    """Draw tracks as lines with their numbers, and the cameras, from above or from the side."""
    points = np.stack([tracks.columns[axis] for axis in "xyz"], axis=1)
    time = float(tracks.times.min()) if len(tracks.times) else 0.0
    cameras = [camera.at(time) for camera in run.cameras]
    scene = np.concatenate([points, *(camera.pose.center[None] for camera in cameras)])
    view = views(cameras, scene)[name]
    figure, axes = view_axes(view, scene, f" [{run.length_unit}]" if run.length_unit else "")
    draw_camera_views(axes, cameras, points, view)
    drawn = view.project(points)
    for number, track_id in enumerate(tracks.ids.tolist()):
        rows = np.arange(tracks.starts[number], tracks.starts[number + 1])
        rows = np.append(rows[: -1 : max(1, len(rows) // MOST_ROWS)], rows[-1])
        colour = style.colour_of(number)
        axes.plot(*drawn[rows].T, color=colour, linestyle=style.dash_of(number), linewidth=1.3, zorder=3)
        axes.plot(
            *drawn[rows[0]], color=colour, marker=style.marker_of(number), markersize=5, linestyle="none", zorder=4
        )
        if number < MOST_LABELS:
            place = (float(drawn[rows[0], 0]), float(drawn[rows[0], 1]))
            axes.annotate(
                str(track_id), place, (4, 4), textcoords="offset points", fontsize=8, color=colour, zorder=5,
                annotation_clip=True,
            )  # fmt: skip
    return figure


def _draw_timelines(tracks: Paths) -> Figure:
    """Draw when each track was reported, and below it which camera detected how many of all detections of tracks."""
    count = len(tracks.ids)
    figure = style.new_figure(9.0, 1.4 + min(0.22 * count, 8.0))
    axes = figure.subplots()
    for number in range(count):
        rows = slice(int(tracks.starts[number]), int(tracks.starts[number + 1]))
        times = tracks.times[rows]
        colour = style.colour_of(number)
        axes.plot(
            [times[0], times[-1]], [number, number], color=colour, linestyle=style.dash_of(number),
            linewidth=float(np.clip(240.0 / max(count, 1), 1.0, 4.0)), marker=style.marker_of(number), markersize=3,
        )  # fmt: skip
    step = -(-count // 40) or 1
    axes.set_yticks(range(0, count, step), [str(i) for i in tracks.ids[::step].tolist()])
    axes.set_ylim(count - 0.4, -0.6)
    axes.set_ylabel("track")
    axes.set_xlabel("time [s]")
    axes.set_title("When each track was reported")
    return figure


def _draw_residuals(run: Run, tracks: Paths) -> Figure:
    """Draw detection minus reprojected track over time, one panel per camera, with means."""
    by_camera = camera_residuals(run, tracks, MOST_RESIDUALS) or []
    figure = style.new_figure(9.0, 0.9 + 1.7 * max(len(by_camera), 1))
    grid = figure.subplots(max(len(by_camera), 1), 1, sharex=True, squeeze=False)[:, 0]
    for axes, camera, (times, values, _, outliers) in zip(grid, run.cameras, by_camera, strict=False):
        order = np.argsort(times, kind="stable")
        parts = [part for part in np.array_split(order, max(1, min(40, len(order) // 15))) if len(part)]
        middle = [float(times[part].mean()) for part in parts]
        for axis, (name, colour) in enumerate((("u", style.BLUE), ("v", style.ORANGE))):
            axes.scatter(times, values[:, axis], s=3, color=colour, linewidths=0, alpha=0.4, rasterized=True)
            mean = [float(values[part, axis].mean()) for part in parts]
            axes.plot(middle, mean, color=colour, linewidth=1.6, label=f"mean along {name}")
        axes.legend(loc="upper right", fontsize=7, ncols=2)
        rms = float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
        beyond = f", {outliers} far larger ones not shown" if outliers else ""
        axes.set_title(f"{camera.name}: root mean square {rms:.2f} px{beyond}", fontsize=10)
        axes.set_ylabel("px")
    grid[-1].set_xlabel("time [s]")
    if not by_camera:
        grid[-1].text(0.5, 0.5, "no associations were kept", transform=grid[-1].transAxes, ha="center")
    return figure
