"""Results of an experiment: the summaries of every method in every case, gathered from runs, written and read."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from stereophd.config.experiment import ExperimentConfig
from stereophd.config.loading import LoadedConfig
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.summary import Summary, summarise, with_windows
from stereophd.experiments.engine.work import BOUND_METHOD, BOUND_RUN, Part, RunResult, cases_of, experiment_section
from stereophd.io.outputs.atomic import OutputFolder, output_folder
from stereophd.io.outputs.json_text import write_json
from stereophd.io.outputs.provenance import from_metadata, provenance, to_metadata
from stereophd.io.tables.reading import arrays_of, read_metadata, read_table
from stereophd.io.tables.schemas import FLOAT, INTEGER, RUNS, STRING, SUMMARY
from stereophd.io.tables.writing import TableWriter
from stereophd.pipeline.runs.unfinished import UNFINISHED_FILES, UnfinishedRun
from stereophd.wording import LOGGER

STATISTICS = ("mean", "std", "ci_low", "ci_high", "bound")
RUNS_FILE, SUMMARY_FILE, TIMING_FILE = "runs.parquet", "summary.parquet", "timing.json"


@dataclass(frozen=True)
class Results:
    """The results of an experiment."""

    name: str
    config: ExperimentConfig
    summaries: tuple[Summary, ...]  # In the order of the methods and, within a method, of the cases
    timing: dict[str, Any]  # As in ``timing.json``: it differs from call to call, and so is in no other file


def gather_results(
    loaded: LoadedConfig, settings: ExperimentConfig, parts: list[Part], results: list[RunResult]
) -> tuple[Results, list[RunResult]]:
    """Return the summaries, and all runs in their order, with their means over the windows."""
    by_part: dict[tuple[str, str], dict[int, RunResult]] = {}
    for result in results:
        by_part.setdefault((result.method, result.case), {})[result.run] = result
    bounds: Mapping[str, list[Series]] = {
        part.case: with_windows(by_part[part.method, part.case][BOUND_RUN].series, settings.windows, squares=False)
        for part in parts
        if part.method == BOUND_METHOD
    }
    names = {case: points for case, points, _ in cases_of(settings)}
    summaries, runs, cpu = list[Summary](), [], dict[str, list[float]]()
    for part in parts:
        if part.method == BOUND_METHOD:
            continue
        done = [by_part[part.method, part.case][run] for run in range(settings.runs)]
        series = [with_windows(result.series, settings.windows) for result in done]
        of_part: dict[str, Any] = {"method": part.method, "case": part.case, "settings": names[part.case]}
        summaries += [replace(each, **of_part) for each in summarise(series, bounds[part.case])]
        runs += [replace(result, series=tuple(of_run)) for result, of_run in zip(done, series, strict=True)]
        cpu.setdefault(part.method, []).extend(result.cpu_s for result in done)
    return Results(experiment_name(loaded), settings, tuple(summaries), _timing(cpu)), runs


def experiment_name(loaded: LoadedConfig) -> str:
    """Return the name of an experiment: stated, or that of its file."""
    return experiment_section(loaded).name or loaded.path.stem


def report_of(results: Results) -> dict[str, Any]:
    """Return the figures of an experiment as plain data: what does not vary with time, and the timing."""
    rows = [
        {
            "method": summary.method,
            "case": summary.case,
            "quantity": summary.quantity,
            "unit": summary.unit,
            "runs": int(summary.runs[0]),
            **{name: float(getattr(summary, name)[0]) for name in STATISTICS},
        }
        for summary in results.summaries
        if summary.times_s is None
    ]
    return {"experiment": results.name, "runs": results.config.runs, "summary": rows, "timing": results.timing}


def _timing(cpu: Mapping[str, list[float]]) -> dict[str, Any]:
    """Return the CPU time of a run of each method: the median, which the first run does not move."""
    medians = {method: float(np.median(seconds)) for method, seconds in cpu.items()}
    first = next(iter(medians.values()))
    return {
        "cpu_s_per_run": medians,
        "ratio_to_first_method": {method: m / first if first > 0 else None for method, m in medians.items()},
    }


def write_results(results: Results, runs: Sequence[RunResult], loaded: LoadedConfig, out: OutputFolder) -> None:
    """Write ``runs.parquet``, ``summary.parquet`` and ``timing.json``."""
    metadata = to_metadata(provenance("experiment", loaded.record))
    with TableWriter(out.path(RUNS_FILE), RUNS, metadata) as table:
        for run in runs:
            for series in run.series:
                values = {"run": run.run, "seed": run.seed, "value": series.values}
                table.append(_columns(results.name, run.method, run.case, series, values))
    with TableWriter(out.path(SUMMARY_FILE), SUMMARY, metadata) as table:
        for summary in results.summaries:
            # what is not defined is null
            statistics = {name: np.ma.masked_invalid(getattr(summary, name)) for name in STATISTICS}
            values = {"runs": summary.runs, **statistics}
            table.append(_columns(results.name, summary.method, summary.case, summary, values))
    write_json(out.path(TIMING_FILE), results.timing)


def read_results(loaded: LoadedConfig, settings: ExperimentConfig, out: Path) -> Results:
    """Return the results of a finished experiment from its files."""
    names = {case: points for case, points, _ in cases_of(settings)}
    texts = ("method", "case", "quantity", "unit")
    required = {**dict.fromkeys(texts, STRING), "runs": INTEGER}
    optional = dict.fromkeys(("time_s", *STATISTICS), FLOAT)
    columns = arrays_of(read_table(out / SUMMARY_FILE, required, optional, what="summary of an experiment"))
    keys = list(zip(*(columns[name].tolist() for name in texts), np.isnan(columns["time_s"]).tolist(), strict=True))
    summaries = []
    for (method, case, quantity, unit, is_whole), numbers in groupby(range(len(keys)), keys.__getitem__):
        rows = list(numbers)
        times_s = None if is_whole else columns["time_s"][rows]
        values = {name: columns[name][rows] for name in ("runs", *STATISTICS)}
        summaries.append(Summary(quantity, unit, times_s, **values, method=method, case=case, settings=names[case]))
    try:
        timing = json.loads((out / TIMING_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{out / TIMING_FILE}: cannot be read ({error}); use `force=True` to start anew") from error
    return Results(experiment_name(loaded), settings, tuple(summaries), timing)


def is_finished(store: UnfinishedRun, loaded: LoadedConfig, resume: bool, force: bool, files: Sequence[str]) -> bool:
    """Return whether the results are there already; otherwise remove what is in the way, where that is allowed.

    `files` are the names that an experiment writes. Raises InputError when the folder holds results or runs, and
    neither `resume` nor `force` (as in `stereophd.commands.experiment.experiment`) allows continuing.
    """
    out = store.out
    output_folder(out, True, [*files, *UNFINISHED_FILES])
    if (out / RUNS_FILE).exists() and not force:
        record = from_metadata(read_metadata(out / RUNS_FILE)) or {}
        if not resume:
            raise InputError(f"output folder {out} already holds {RUNS_FILE}; use `force=True` to replace it")
        if record.get("config_sha256") != loaded.sha256:
            raise InputError(f"output folder {out} holds the results of another configuration; use `force=True`")
        LOGGER.info("%s: the experiment is finished: nothing to resume", out)
        return True
    return False


def _columns(
    experiment: str, method: str, case: str, of: Series | Summary, values: Mapping[str, Any]
) -> dict[str, Any]:
    """Return rows of ``runs.parquet`` or ``summary.parquet``, which have further values."""
    times: Any = [None] if of.times_s is None else of.times_s
    key = {"experiment": experiment, "method": method, "case": case}
    return {**key, "time_s": times, "quantity": of.quantity, "unit": of.unit, **values}
