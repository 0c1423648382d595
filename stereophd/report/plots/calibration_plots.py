"""Plots of a calibration: parameters over time with their bands, pairs of the posterior, residuals.

Needs the extra ``plot``. The same data give the same files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.pipeline.calibration.problem import Outcome
from stereophd.report.style import BLUE, GREY, INK, ORANGE, STYLE, TRACK_COLOURS, marker_of, plots_named, save_figures

# Half-width of a 90 % band in standard deviations.
NINETY = 1.645
# More points than this cannot be distinguished.
MOST_POINTS = 4000
# Parameters of one figure of pairs: more would be too small to read.
MOST_PAIRS = 6


@dataclass(frozen=True)
class CalibrationPictures:
    """What is drawn."""

    # `names`, `units`: Names and units of the parameters; the unit is ``length`` or ``rad``.
    names: tuple[str, ...]
    units: tuple[str, ...]
    length_unit: str
    prior_std: Array  # (m,)
    times: Array  # (t,): s
    # `means`, `stds`: arrays (t, m): Posterior given the log up to each time.
    means: Array
    stds: Array
    # `particles`, `weights`: arrays (k, m), (k,)
    particles: Array
    weights: Array
    # `residual_times`, `residual_cameras`, `residuals`: arrays (n,): Reprojection residuals in sigmas; may be empty.
    residual_times: Array
    residual_cameras: NDArray[np.int64]
    residuals: Array
    cameras: tuple[str, ...]

    def factor(self, index: int) -> float:
        """Factor from the parameter's unit to the one drawn (degrees for angles)."""
        return float(np.rad2deg(1.0)) if self.units[index].startswith("rad") else 1.0

    def label(self, index: int) -> str:
        """Name and unit of a parameter."""
        unit = self.units[index].replace("rad", "deg").replace("length", self.length_unit)
        return f"{self.names[index]} [{unit}]"


def pictures_of(outcome: Outcome, length_unit: str) -> CalibrationPictures:
    """Return what is drawn of a calibration."""
    parameters, history, fit = outcome.parameters, outcome.history, outcome.fit
    shape = (-1, parameters.size)
    return CalibrationPictures(
        names=parameters.names,
        units=tuple(p.unit for p in parameters.parameters),
        length_unit=length_unit,
        prior_std=parameters.prior_std,
        times=np.array([row.time_s for row in history]),
        means=np.array([row.mean for row in history]).reshape(shape),
        stds=np.array([np.sqrt(np.diag(row.covariance)) for row in history]).reshape(shape),
        particles=outcome.particles,
        weights=np.exp(outcome.log_weights),
        residual_times=np.empty(0) if fit is None else fit.observations.times,
        residual_cameras=np.empty(0, dtype=np.int64) if fit is None else fit.observations.cameras,
        residuals=np.empty(0) if fit is None else np.sqrt(fit.adjustment.distances),
        cameras=tuple(camera.name for camera in parameters.cameras),
    )


def write_calibration_plots(pictures: CalibrationPictures, paths: Mapping[str, Path]) -> None:
    """Draw the plots ``history``, ``posterior`` and ``residuals`` that `paths` names (as png or svg)."""
    makers = {"history": draw_history, "posterior": draw_posterior, "residuals": draw_residuals}
    with mpl.rc_context(STYLE):
        save_figures({plot: makers[plot](pictures) for plot in plots_named(paths)}, paths)


def _grid(rows: int, columns: int, width: float, height: float) -> tuple[Figure, NDArray[Any]]:
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def draw_history(pictures: CalibrationPictures) -> Figure:
    """Draw every parameter over time (the paper's Figure 13): mean, 90 % band, prior."""
    count = len(pictures.names)
    columns = 3 if count > 3 else count
    rows = -(-count // columns)
    figure, axes = _grid(rows, columns, 4.0, 2.6)
    for index in range(rows * columns):
        panel = axes[index // columns][index % columns]
        if index >= count:
            panel.set_visible(False)
            continue
        factor = pictures.factor(index)
        mean, std = factor * pictures.means[:, index], factor * pictures.stds[:, index]
        prior = NINETY * factor * pictures.prior_std[index]
        panel.fill_between(pictures.times, mean - NINETY * std, mean + NINETY * std, color=BLUE, alpha=0.2, linewidth=0)
        panel.plot(pictures.times, mean, color=BLUE, linewidth=1.4)
        for bound in (-prior, prior):
            panel.axhline(bound, color=GREY, linewidth=0.8, linestyle=(0, (4, 3)))
        panel.set_title(pictures.label(index), fontsize=9)
        if index // columns == rows - 1:
            panel.set_xlabel("time [s]")
    figure.suptitle("Offsets from the prior mean: mean and 90 % band given the log so far (dashed: 90 % of the prior)")
    return figure


def draw_posterior(pictures: CalibrationPictures) -> Figure:
    """Draw pairs of the first parameters, and the marginals on the diagonal."""
    count = min(len(pictures.names), MOST_PAIRS)
    figure, axes = _grid(count, count, 1.9, 1.7)
    rows = np.unique(np.linspace(0, len(pictures.particles) - 1, min(len(pictures.particles), MOST_POINTS)).astype(int))
    for i in range(count):
        for j in range(count):
            panel = axes[i][j]
            panel.tick_params(labelsize=6)
            if j > i:
                panel.set_visible(False)
                continue
            x = pictures.factor(j) * pictures.particles[:, j]
            if i == j:
                panel.hist(x, bins=40, weights=pictures.weights, color=BLUE, alpha=0.7)
                panel.set_yticks([])
            else:
                y = pictures.factor(i) * pictures.particles[:, i]
                panel.scatter(x[rows], y[rows], s=2, color=INK, alpha=0.25, linewidths=0, rasterized=True)
            if i == count - 1:
                panel.set_xlabel(pictures.label(j), fontsize=7)
            if j == 0 and i > 0:
                panel.set_ylabel(pictures.label(i), fontsize=7)
    figure.suptitle("Posterior of the offsets from the prior mean")
    return figure


def draw_residuals(pictures: CalibrationPictures) -> Figure:
    """Draw reprojection residuals over time, and their distribution compared with normal noise."""
    figure, axes = _grid(1, 2, 5.0, 3.0)
    over_time, distribution = axes[0][0], axes[0][1]
    for number, name in enumerate(pictures.cameras):
        here = np.flatnonzero(pictures.residual_cameras == number)
        some = here[:: max(len(here) // MOST_POINTS, 1)]
        colour = TRACK_COLOURS[number % len(TRACK_COLOURS)]
        over_time.scatter(
            pictures.residual_times[some],
            pictures.residuals[some],
            s=4,
            color=colour,
            linewidths=0,
            label=name,
            marker=marker_of(number),
        )
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("residual [sigma]")
    over_time.legend(loc="upper right", markerscale=3, fontsize=8)
    limit = 5.0
    distribution.hist(pictures.residuals, bins=60, range=(0.0, limit), density=True, color=BLUE, alpha=0.6)
    grid = np.linspace(0.0, limit, 200)
    distribution.plot(grid, grid * np.exp(-0.5 * grid**2), color=ORANGE, linewidth=1.6, label="normal noise")
    distribution.set_xlabel("residual [sigma]")
    distribution.legend(loc="upper right", fontsize=8)
    figure.suptitle("Reprojection residuals")
    return figure
