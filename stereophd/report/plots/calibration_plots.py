"""Plots of a calibration: parameters over time with their bands, pairs of the posterior, residuals.

Needs the extra ``plot``. The same data give the same files.
"""

from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

from stereophd.core.calibration.unknowns.parameters import ParameterSet
from stereophd.pipeline.calibration.problem import Outcome
from stereophd.report import style
from stereophd.wording import shown_unit

# Half-width of a 90 % band in standard deviations.
NINETY = 1.645
# More points than this cannot be distinguished.
MOST_POINTS = 4000
# Room to the left of each panel and below it, inches.
LEFT_IN, BELOW_IN = 0.6, 0.45
# Parameters of one figure of pairs: more would be too small to read.
MOST_PAIRS = 6


def write_calibration_plots(outcome: Outcome, length_unit: str, paths: Mapping[str, Path]) -> None:
    """Draw the plots ``history``, ``posterior`` and ``residuals`` that `paths` names (as png or svg)."""
    makers = {"history": _draw_history, "posterior": _draw_posterior, "residuals": _draw_residuals}
    with mpl.rc_context({**style.STYLE, "xtick.labelsize": 8.0, "ytick.labelsize": 8.0}):  # they fit the fixed room
        style.save_figures({plot: makers[plot](outcome, length_unit) for plot in style.plots_named(paths)}, paths)


def _drawn(parameters: ParameterSet, length_unit: str) -> list[tuple[float, str]]:
    """Return the factor from the unit of each parameter to the one drawn (degrees for angles), and its label."""
    shown = [shown_unit(parameter.unit, length_unit) for parameter in parameters.parameters]
    return [(factor, f"{name} [{unit}]") for name, (factor, unit) in zip(parameters.names, shown, strict=True)]


def _grid(rows: int, columns: int, width: float, height: float, title: str) -> tuple[Figure, GridSpec]:
    """Return a figure and its panels, which have fixed room for what is to the left of each and below it."""
    figure, inner = style.new_figure(width * columns, height * rows), (width - LEFT_IN, height - BELOW_IN)
    figure.set_layout_engine(None)
    figure.suptitle(title, y=1.0 + BELOW_IN / (height * rows), verticalalignment="bottom")
    room = {"left": LEFT_IN / (width * columns), "bottom": BELOW_IN / (height * rows), "right": 1.0, "top": 1.0}
    return figure, figure.add_gridspec(rows, columns, wspace=LEFT_IN / inner[0], hspace=BELOW_IN / inner[1], **room)


def _draw_history(outcome: Outcome, length_unit: str) -> Figure:
    """Draw every parameter over time (the paper's Figure 13): mean, 90 % band, prior."""
    parameters, times = outcome.parameters, [row.time_s for row in outcome.history]
    drawn, count = _drawn(parameters, length_unit), parameters.size
    columns = 3 if count > 3 else count
    rows = -(-count // columns)
    title = "Offsets from the prior mean: mean and 90 % band given the log so far (dashed: 90 % of the prior)"
    figure, places = _grid(rows, columns, 4.0, 2.6, title)
    axes = places.subplots(sharex=True, squeeze=False)
    for panel in axes.flat[count:]:
        panel.set_visible(False)
    for index, (panel, (factor, label)) in enumerate(zip(axes.flat, drawn, strict=False)):
        mean = factor * np.array([row.mean[index] for row in outcome.history])
        std = factor * np.sqrt(np.array([row.covariance[index, index] for row in outcome.history]))
        prior = NINETY * factor * parameters.prior_std[index]
        panel.fill_between(times, mean - NINETY * std, mean + NINETY * std, color=style.BLUE, alpha=0.2, linewidth=0)
        panel.plot(times, mean, color=style.BLUE, linewidth=1.4)
        for bound in (-prior, prior):
            panel.axhline(bound, color=style.GREY, linewidth=0.8, linestyle=(0, (4, 3)))
        panel.set_title(label, fontsize=9)
        if index + columns >= count:
            panel.tick_params(labelbottom=True)
            panel.set_xlabel("time [s]")
    return figure


def _draw_posterior(outcome: Outcome, length_unit: str) -> Figure:
    """Draw pairs of the first parameters, and the marginals on the diagonal."""
    drawn = _drawn(outcome.parameters, length_unit)[:MOST_PAIRS]
    count, particles = len(drawn), outcome.particles
    figure, places = _grid(count, count, 1.9, 1.7, "Posterior of the offsets from the prior mean")
    rows = np.unique(np.linspace(0, len(particles) - 1, min(len(particles), MOST_POINTS)).astype(int))
    panels = dict[tuple[int, int], Axes]()
    for i, (factor, label) in enumerate(drawn):
        for j in range(i + 1):
            beside = {"sharex": panels.get((j, j)), "sharey": panels.get((i, 0)) if i > j else None}
            panel = panels[i, j] = figure.add_subplot(places[i, j], **beside)
            panel.tick_params(labelsize=6, labelbottom=i == count - 1, labelleft=j == 0)
            x = drawn[j][0] * particles[:, j]
            if i == j:
                weights = np.exp(outcome.log_weights)
                panel.hist(x, bins=40, weights=weights, color=style.BLUE, alpha=0.7, histtype="stepfilled", linewidth=0)
                panel.set_yticks([])
            else:
                y = factor * particles[:, i]
                panel.scatter(x[rows], y[rows], s=2, color=style.INK, alpha=0.25, linewidths=0, rasterized=True)
            if i == count - 1:
                panel.set_xlabel(drawn[j][1], fontsize=7, labelpad=12)  # below a common exponent
            if j == 0 and i > 0:
                panel.set_ylabel(label, fontsize=7)
    return figure


def _draw_residuals(outcome: Outcome, length_unit: str) -> Figure:
    """Draw reprojection residuals over time, in sigmas, and their distribution compared with normal noise."""
    figure = style.new_figure(10.0, 3.0)
    over_time, distribution = figure.subplots(1, 2)
    assert outcome.fit is not None
    observations, residuals = outcome.fit.observations, np.sqrt(outcome.fit.adjustment.distances)
    for number, camera in enumerate(outcome.parameters.cameras):
        rows = np.flatnonzero(observations.cameras == number)
        rows = rows[:: max(len(rows) // MOST_POINTS, 1)]
        over_time.scatter(
            observations.times[rows], residuals[rows], s=4, color=style.colour_of(number), linewidths=0,
            label=camera.name, marker=style.marker_of(number),
        )  # fmt: skip
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("residual [sigma]")
    over_time.legend(loc="upper right", markerscale=3, fontsize=8)
    limit = 5.0
    distribution.hist(residuals, bins=60, range=(0.0, limit), density=True, color=style.BLUE, alpha=0.6)
    grid = np.linspace(0.0, limit, 200)
    distribution.plot(grid, grid * np.exp(-0.5 * grid**2), color=style.ORANGE, linewidth=1.6, label="normal noise")
    distribution.set_xlabel("residual [sigma]")
    distribution.legend(loc="upper right", fontsize=8)
    figure.suptitle("Reprojection residuals")
    return figure
