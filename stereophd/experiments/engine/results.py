"""Results of an experiment: the summaries of every method in every case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stereophd.config.experiment import ExperimentConfig
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.parts import RunResult
from stereophd.experiments.engine.plan import cases_of
from stereophd.experiments.engine.summary import Summary, summarise, with_windows
from stereophd.experiments.engine.work import BOUND_METHOD, BOUND_RUN, Part

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


@dataclass(frozen=True)
class Cell:
    """One method in one case, over all runs."""

    method: str
    case: str
    settings: tuple[str, ...]
    summaries: tuple[Summary, ...]


@dataclass(frozen=True)
class Results:
    """What an experiment found.

    Attributes
    ----------
    name : str
    config : ExperimentConfig
    cells : tuple of Cell
        In the order of the methods and, within a method, of the cases.
    timing : dict
        As in ``timing.json``: it differs from call to call, and so is in no other file.
    """

    name: str
    config: ExperimentConfig
    cells: tuple[Cell, ...]
    timing: dict[str, Any]


def gather_results(
    loaded: LoadedConfig, settings: ExperimentConfig, parts: list[Part], found: list[RunResult]
) -> tuple[Results, list[RunResult]]:
    """Return the summaries, and all runs in their order, with their means over the windows."""
    by_part: dict[tuple[str, str], dict[int, RunResult]] = {}
    for result in found:
        by_part.setdefault((result.method, result.case), {})[result.run] = result
    bounds: Mapping[str, list[Series]] = {
        part.case: with_windows(by_part[part.method, part.case][BOUND_RUN].series, settings.windows, squares=False)
        for part in parts
        if part.method == BOUND_METHOD
    }
    names = {case: points for case, points, _ in cases_of(settings)}
    cells, runs, cpu = [], [], dict[str, list[float]]()
    for part in parts:
        if part.method == BOUND_METHOD:
            continue
        own = [by_part[part.method, part.case][run] for run in range(settings.runs)]
        series = [with_windows(result.series, settings.windows) for result in own]
        summaries = summarise(series, bounds[part.case])
        cells.append(Cell(part.method, part.case, names[part.case], tuple(summaries)))
        runs += [
            RunResult(r.method, r.case, r.run, r.seed, tuple(s), r.cpu_s) for r, s in zip(own, series, strict=True)
        ]
        cpu.setdefault(part.method, []).extend(result.cpu_s for result in own)
    return Results(experiment_name(loaded), settings, tuple(cells), _timing(cpu)), runs


def experiment_name(loaded: LoadedConfig) -> str:
    """Return the name of an experiment: stated, or that of its file."""
    assert loaded.config.experiment is not None
    return loaded.config.experiment.name or loaded.path.stem


def _timing(cpu: Mapping[str, list[float]]) -> dict[str, Any]:
    """Return the processor time of a run of each method: the median, which the first run does not move."""
    medians = {method: float(np.median(seconds)) for method, seconds in cpu.items()}
    first = next(iter(medians.values()))
    return {
        "cpu_s_per_run": medians,
        "ratio_to_first_method": {method: m / first if first > 0 else None for method, m in medians.items()},
    }
