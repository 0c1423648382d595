"""Monte Carlo experiments: many runs of a scenario, several methods and cases, on one machine or a cluster.

Every run has random numbers of its own, from the seed and its number: the results are the same to the bit
whatever the number of workers, and methods see the same data. Finished runs are kept in the output folder
until all are done.
"""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from stereophd.config.experiment import ExperimentConfig
from stereophd.errors import InputError
from stereophd.experiments.engine.execution import execute
from stereophd.experiments.engine.parts import PATTERN, PartStore, RunResult, parquet_metadata
from stereophd.experiments.engine.plan import cases_of, plan_parts
from stereophd.experiments.engine.quantities import QuantityCheck
from stereophd.experiments.engine.results import Cell, Results, experiment_name, gather_results
from stereophd.experiments.engine.summary import Summary
from stereophd.experiments.engine.tables import columns_of, columns_of_summary, read_summaries
from stereophd.experiments.engine.work import BOUND_METHOD, BOUND_RUN
from stereophd.io.atomic import OutputFolder, output_folder, output_lock
from stereophd.io.json_text import write_json
from stereophd.io.provenance import from_metadata, provenance, to_metadata
from stereophd.io.tables import RUNS, SUMMARY, TableWriter
from stereophd.pipeline.progress import Progress
from stereophd.report.installed import can_draw

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig

RUNS_FILE, SUMMARY_FILE, TIMING_FILE = "runs.parquet", "summary.parquet", "timing.json"
FIGURE_FILES = ("figure.png", "figure.svg")
FILES = (RUNS_FILE, SUMMARY_FILE, TIMING_FILE, *FIGURE_FILES)

LOGGER = logging.getLogger("stereophd")


def experiment(
    loaded: LoadedConfig,
    out_dir: Path | str,
    jobs: int = 1,
    dask: str | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Results:
    """Run an experiment, and write ``runs.parquet``, ``summary.parquet``, ``timing.json`` and the figure.

    Parameters
    ----------
    loaded : LoadedConfig
        With an ``experiment`` section.
    out_dir : path
        Output folder. Finished runs are kept there until all are done.
    jobs : int
        Processes on this machine; 1: this one.
    dask : str, optional
        Address of a Dask scheduler whose workers do the runs instead.
    resume : bool
        Whether runs that an earlier call finished are taken over; only those missing are done.
    force : bool
        Whether results of an earlier experiment may be replaced.
    progress : callable, optional
        Called with the runs done and their total.

    Returns
    -------
    Results

    Raises
    ------
    InputError
        The configuration lacks something, a setting of a method or case is wrong, the output folder cannot
        be used, or no scheduler answers.
    StereophdError
        A run failed again and again; finished runs are kept.
    """
    settings = loaded.config.experiment
    if settings is None:
        raise InputError(f"{loaded.path}: experiment: expected a section `experiment`, found none")
    if jobs < 1:
        raise InputError(f"`jobs`: expected at least 1, found {jobs}")
    parts = plan_parts(loaded, settings)
    out = Path(out_dir)
    store = PartStore(out, loaded)
    with output_lock(out):
        try:
            if _is_finished(store, out, loaded, resume, force):
                return _read_results(loaded, settings, out)
            bound_runs = range(BOUND_RUN, BOUND_RUN + 1)
            wanted = [(part, bound_runs if part.method == BOUND_METHOD else range(settings.runs)) for part in parts]
            check = QuantityCheck(loaded, [(part.method, part.case) for part in parts if part.method != BOUND_METHOD])
            execute(wanted, store, jobs, dask, progress, check.see)
            results, runs = gather_results(loaded, settings, parts, store.read())
            with OutputFolder(out, [*FILES, PATTERN], force=True) as files:
                _write(results, runs, loaded, files)
        except BaseException:
            # finished runs stay; a folder that holds none does not
            with contextlib.suppress(OSError):
                store.folder.rmdir()
            raise
    return results


def finished_runs(loaded: LoadedConfig, out_dir: Path | str) -> int:
    """Return the number of finished runs that wait in an output folder for ``resume``."""
    return sum(result.method != BOUND_METHOD for result in PartStore(Path(out_dir), loaded).read())


def _is_finished(store: PartStore, out: Path, loaded: LoadedConfig, resume: bool, force: bool) -> bool:
    """Check the output folder; remove what is in the way, where that is allowed. Return if there is nothing to do."""
    output_folder(out, True, [*FILES, PATTERN])
    if (out / RUNS_FILE).exists() and not force:
        record = from_metadata(parquet_metadata(out / RUNS_FILE)) or {}
        if not resume:
            raise InputError(f"output folder {out} already holds {RUNS_FILE}; use `force=True` to replace it")
        if record.get("config_sha256") != loaded.sha256:
            raise InputError(f"output folder {out} holds the results of another configuration; use `force=True`")
        LOGGER.info("%s: the experiment is finished: nothing to resume", out)
        return True
    if not resume and not force and (store.exists() or store.others()):
        raise InputError(
            f"output folder {out} holds runs of an unfinished experiment; use `resume=True` or `force=True`"
        )
    if store.others() and not force:
        raise InputError(
            f"output folder {out} holds runs of another configuration ({store.others()[0].name}): nothing to resume; "
            "use `force=True` to remove them"
        )
    store.remove(others_only=resume)
    return False


def _read_results(loaded: LoadedConfig, settings: ExperimentConfig, out: Path) -> Results:
    """Return the results of a finished experiment from its files."""
    names = {case: points for case, points, _ in cases_of(settings)}
    found: dict[tuple[str, str], list[Summary]] = {}
    for method, case, summary in read_summaries(out / SUMMARY_FILE):
        found.setdefault((method, case), []).append(summary)
    cells = tuple(Cell(*key, names[key[1]], tuple(summaries)) for key, summaries in found.items())
    try:
        timing = json.loads((out / TIMING_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{out / TIMING_FILE}: cannot be read ({error}); use `force=True` to start anew") from error
    return Results(experiment_name(loaded), settings, cells, timing)


def _write(results: Results, runs: list[RunResult], loaded: LoadedConfig, out: OutputFolder) -> None:
    metadata = to_metadata(provenance("experiment", loaded.record))
    with TableWriter(out.path(RUNS_FILE), RUNS, metadata) as table:
        for run in runs:
            for series in run.series:
                table.append(columns_of(results.name, run.method, run.case, run.run, run.seed, series))
    with TableWriter(out.path(SUMMARY_FILE), SUMMARY, metadata) as table:
        for cell in results.cells:
            for summary in cell.summaries:
                table.append(columns_of_summary(results.name, cell.method, cell.case, summary))
    write_json(out.path(TIMING_FILE), results.timing)
    if not can_draw():
        LOGGER.info("no figure: it needs matplotlib (pip install 'stereophd[plot]')")
        return
    # Costly to import, and matplotlib is an extra.
    from stereophd.report.experiment_plots import write_figure

    write_figure(results, {name: out.path(name) for name in FIGURE_FILES})
